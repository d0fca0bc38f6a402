"""HTTP POST or GET: publishes a participant's stop message to the stop topic, after a delay if the request has one."""

from typing import Any

from hippodrome.control.participants.relays import Relays
from hippodrome.functions import installed, web


def handler(event: dict[str, Any], context: object) -> dict[str, Any]:
    """Respond to a request of API Gateway's HTTP API: publish a participant's stop message, now or after a delay."""
    return web.respond(event, lambda request: installed.shared(Relays).stop(request))
