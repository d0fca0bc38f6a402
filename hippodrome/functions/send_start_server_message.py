"""HTTP POST or GET: publishes a participant's start message to the start topic."""

from typing import Any

from hippodrome.control.participants.relays import Relays
from hippodrome.functions import installed, web


def handler(event: dict[str, Any], context: object) -> dict[str, Any]:
    """Respond to a request of API Gateway's HTTP API: publish a participant's start message."""
    return web.respond(event, lambda request: installed.shared(Relays).start(request))
