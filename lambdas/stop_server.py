"""Stop topic → queue: stop the task, delete the DNS record and the schedule, close the record."""

from typing import Any

from hippodrome.model import messages
from hippodrome.servers.service import Servers
from lambdas import installed, queue


def handler(event: dict[str, Any], context: object) -> queue.Failures:
    """SQS batch of stop messages → the ones that should come again."""
    found = queue.read(event, messages.stop_server)
    return queue.failures(queue.all_at_once(found, installed.one(Servers).stop))
