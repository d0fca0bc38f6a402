"""Stop topic → queue: stops the task, deletes the DNS record and the timer, closes the server's record."""

from typing import Any

from hippodrome.model import messages
from hippodrome.model.messages import StopServer, StopUser
from hippodrome.servers.services import ServerServices
from hippodrome.servers.stops import Stops
from lambdas import installed, queue


def handler(event: dict[str, Any], context: object) -> queue.BatchResponse:
    """SQS batch of stop messages, or an event of SNS → partial batch response."""
    found: list[tuple[str, StopServer | StopUser]] = queue.read(event, messages.parse_stop_server)
    return queue.response(event, queue.all_at_once(found, Stops(installed.shared(ServerServices)).handle))
