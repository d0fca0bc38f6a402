"""Stop topic → queue: stops the task, deletes the DNS record and the timer, closes the server's record."""

from typing import Any

from hippodrome.control.model import messages
from hippodrome.control.model.messages import StopServer, StopUser
from hippodrome.control.servers.services import ServerServices
from hippodrome.control.servers.stops import Stops
from hippodrome.functions import installed, queue


def handler(event: dict[str, Any], context: object) -> queue.BatchResponse:
    """Handle the stop messages of an SQS batch, or of an event that SNS sends to the function itself.

    Returns the partial batch response with the messages that SQS must deliver again.
    """
    found: list[tuple[str, StopServer | StopUser]] = queue.read(event, messages.parse_stop_server)
    return queue.response(event, queue.all_at_once(found, Stops(installed.shared(ServerServices)).handle))
