"""Start topic → queue: starts servers, each with its shutdown timer, and keeps the pools of warm servers filled."""

from typing import Any

from hippodrome.control.model import messages
from hippodrome.control.model.messages import KeepWarm, StartServer
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.start import Start
from hippodrome.functions import installed, queue


def handler(event: dict[str, Any], context: object) -> queue.BatchResponse:
    """Handle the start messages of an SQS batch, or of an event that SNS sends to the function itself.

    Returns the partial batch response with the messages that SQS must deliver again.
    """
    found: list[tuple[str, StartServer | KeepWarm]] = queue.read(event, messages.parse_start_server)
    services = installed.shared(ServerServices)
    failed = queue.one_by_one(found, Start(services).handle)
    queue.report_failures(services)
    return queue.response(event, failed)
