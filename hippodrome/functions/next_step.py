"""HTTP GET and POST: shows the page of the due step, stores answers, and publishes start and stop messages."""

from typing import Any

from hippodrome.control.participants.journey import Journey
from hippodrome.functions import installed, web


def handler(event: dict[str, Any], context: object) -> dict[str, Any]:
    """Respond to a request of API Gateway's HTTP API: show the due step's page, or store an answer."""
    return web.respond(event, lambda request: installed.shared(Journey).respond(request))
