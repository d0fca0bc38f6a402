"""HTTP POST from a trial server without a DNS name: orders a certificate for the server's IPv4 address."""

from typing import TYPE_CHECKING, Any

from hippodrome.control.certificates.accounts import account_key
from hippodrome.control.certificates.rules import PRODUCTION
from hippodrome.control.ports import Platform
from hippodrome.control.servers.certifying import Certifying
from hippodrome.functions import installed, web

if TYPE_CHECKING:
    from hippodrome.control.certificates.addresses import AddressAuthority


def handler(event: dict[str, Any], context: object) -> dict[str, Any]:
    """Respond to a request of API Gateway's HTTP API: place a server's order, or take its next step."""
    return web.respond(event, lambda request: installed.shared(_certifying).respond(request))


def _certifying(platform: Platform) -> Certifying:
    def open_authority() -> AddressAuthority:
        from hippodrome.control.certificates.addresses import AddressAuthority  # noqa: PLC0415 - its import is slow

        return AddressAuthority(PRODUCTION, account_key(platform.documents, PRODUCTION))

    return Certifying(platform, open_authority)
