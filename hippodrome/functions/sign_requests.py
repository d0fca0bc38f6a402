"""HTTP POST from a trial server: returns presigned requests for that server's own documents."""

from typing import Any, cast

from hippodrome.control.ports import Platform
from hippodrome.control.servers.signing import Signing, SigningPlatform
from hippodrome.functions import installed, web


def handler(event: dict[str, Any], context: object) -> dict[str, Any]:
    """Respond to a request of API Gateway's HTTP API: return presigned requests to a server with its own credential."""
    return web.respond(event, lambda request: installed.shared(_signing).respond(request))


def _signing(platform: Platform) -> Signing:
    return Signing(cast(SigningPlatform, platform))  # AWS's platform, since this function runs on AWS only
