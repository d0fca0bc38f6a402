"""Stop topic → queue: stops the task, deletes the DNS record and the timer, closes the server's record."""

from typing import Any

from hippodrome.model import messages
from hippodrome.servers.services import ServerServices
from hippodrome.servers.termination import Termination
from lambdas import installed, queue


def handler(event: dict[str, Any], context: object) -> queue.BatchResponse:
    """SQS batch of stop messages → partial batch response."""
    found = queue.read(event, messages.parse_stop_server)
    return queue.batch_response(queue.all_at_once(found, Termination(installed.shared(ServerServices)).stop))
