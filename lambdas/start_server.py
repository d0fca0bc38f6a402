"""Start topic → queue: schedule the shutdown, RunTask on Fargate Spot, record it; keep as many in waiting as wanted."""

from typing import Any

from hippodrome.model import messages
from hippodrome.model.messages import KeepWarm, StartServer
from hippodrome.servers.service import Servers
from lambdas import installed, queue


def handler(event: dict[str, Any], context: object) -> queue.BatchResponse:
    """SQS batch of start messages → the ones that should come again."""
    found: list[tuple[str, StartServer | KeepWarm]] = queue.read(event, messages.parse_start_server)
    servers = installed.shared(Servers)
    failed = queue.one_by_one(found, servers.start)
    queue.report_failures(servers)
    return queue.batch_response(failed)
