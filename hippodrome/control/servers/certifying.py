"""`certify_server`: a server without a DNS name gets a certificate for its own IPv4 address, whose key never leaves it.

The server shows its credential, first to place an order, then again and again until the certificate is there:

    {"server": "s…-1", "credential": "…"}
    {"address": "203.0.113.7", "order": "https://…", "token": "…", "proof": "…"}

    {"server": "s…-1", "credential": "…", "order": "https://…", "csr": "-----BEGIN CERTIFICATE …", "answer": true}
    {} or {"unseen": true} or {"certificate": "-----BEGIN CERTIFICATE-----…"}

The first of these has `answer`: the server shows the proof now. `unseen`: `task_changed` has not seen the task yet, for
which the order waits, however long. Instead, `{"failed": "…"}` says that another order is needed, and
`{"refused": "…"}` that none may be placed for this address now. Status 429: ask again.

The address is the one that the request comes from, so no server gets a certificate for an address that is not its own.
The certificate is handed out once `task_changed` has seen the task's address, and makes the server `ready`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec

from hippodrome.control.certificates.rules import (
    ADDRESS_ORDERS,
    MAX_ORDERS,
    MAX_ORDERS_OF_SERVER,
    AddressOrders,
    FailureReason,
    Limit,
    OrderFailed,
    limit_in,
)
from hippodrome.control.http import Refusal, Request, Response
from hippodrome.control.log import logger
from hippodrome.control.model.messages import DnsChanged, ServerAttempt, to_message
from hippodrome.control.model.server import Server, ServerState
from hippodrome.control.ports import Platform
from hippodrome.control.servers.credentials import answer_of, read_request, record_of
from hippodrome.control.storage.compare_and_swap import SharedDocuments
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache

if TYPE_CHECKING:
    from hippodrome.control.certificates.addresses import AddressAuthority

MAX_BODY = 16 * 1024  # bytes
_WAITING = (ServerState.STARTING, ServerState.NAMING, ServerState.READY)  # READY: it asks again if an answer was lost


class CertificateRequest(msgspec.Struct, frozen=True):
    """What a server sends: without an `order` it wants to place one."""

    server: str
    credential: str
    order: str = ""
    csr: str = ""
    answer: bool = False  # the CA may look at the address now


class Certifying:
    """Answers the requests of servers. Each running function has one `Certifying`."""

    def __init__(self, platform: Platform, open_authority: Callable[[], AddressAuthority]) -> None:
        """`open_authority` returns the client of the authority, and may raise OrderFailed."""
        self._platform = platform
        self._repository = Repository(platform.documents)
        self._secrets = SecretCache(platform.documents)
        self._shared = SharedDocuments(platform.documents)
        self._open_authority = open_authority
        self._authority: AddressAuthority | None = None

    def respond(self, request: Request) -> Response:
        """Place an order, or take its next step.

        AWS calls: one read of the server's record; one more if it is a warm server that was assigned; three for a new
        order; one message once the certificate is issued.
        """
        try:
            certificate_request = read_request(
                request, CertificateRequest, MAX_BODY, "server and credential, or with order and csr too"
            )
            record = record_of(
                certificate_request.server, certificate_request.credential, self._repository, self._secrets
            )
            if record.assigned_to and (owner := self._repository.server(record.assigned_to)):
                record = owner.server
            if record.dns or not record.owns(certificate_request.server) or record.state not in _WAITING:
                raise Refusal(409, "This server needs no certificate now.")
            if record.host and record.host != request.source:
                raise Refusal(409, "The request does not come from the address of the server's task.")
            if certificate_request.order:
                answer = self._advance(record, certificate_request, request.source)
            else:
                answer = self._place(certificate_request.server, request.source)
        except Refusal as refusal:
            return answer_of(refusal.status, {"message": refusal.text})
        except OrderFailed as failed:
            about = {"server": certificate_request.server, "why": failed.reason.value, "text": str(failed)}
            logger.warning("a certificate was not issued", extra=about)
            return self._failed(failed)
        return answer_of(200, answer)

    def _place(self, server: str, address: str) -> dict[str, str | bool]:
        now, orders = self._platform.now(), self._shared.read(ADDRESS_ORDERS, AddressOrders)
        if not orders.allows(now, MAX_ORDERS):
            return {"refused": "the limit of certificates is reached"}
        if orders.count(now, server) >= MAX_ORDERS_OF_SERVER:  # else one server could keep all others from starting
            return {"refused": "the limit of this server"}
        order = self._client().order(address)
        # Not before: while the CA is away, servers ask each second, which would use up three hours' orders in vain.
        self._shared.change(ADDRESS_ORDERS, AddressOrders, lambda orders: orders.with_order(now, server))
        return {"address": address, "order": order.url, "token": order.token, "proof": order.proof}

    def _advance(self, record: Server, certificate_request: CertificateRequest, address: str) -> dict[str, str | bool]:
        task_seen = record.host == address
        try:
            chain = self._client().advance(
                certificate_request.order,
                address,
                certificate_request.csr,
                answer=certificate_request.answer,
                may_issue=task_seen,
            )
        except PermissionError:
            raise Refusal(403, "That order is for another address.") from None
        except ValueError:
            raise Refusal(400, "That is no order's address.") from None
        if not chain:
            return {} if task_seen else {"unseen": True}
        if record.state is ServerState.NAMING:
            issued = DnsChanged("", [ServerAttempt(record.label, record.attempt)])
            self._platform.bus.send_delayed(to_message(issued), 0)
        return {"certificate": chain}

    def _failed(self, failed: OrderFailed) -> Response:
        """The answer after a failure: only a limit of our account keeps other servers from ordering, too.

        Addresses are used again, by AWS's other customers as well, so any of them may have used up its own limit.
        """
        limit = limit_in(str(failed)) if failed.reason is FailureReason.RATE_LIMITED else None
        if failed.reason is FailureReason.UNREACHABLE or limit is Limit.REQUESTS:
            self._authority = None  # perhaps its connection is broken
            # Not 5xx: the authority's troubles are no errors of ours, which the alarm `site-errors` tells.
            return answer_of(429, {"message": "The certificate authority does not answer now."})
        if limit is None:
            return answer_of(200, {"failed": failed.reason.value})
        if limit is Limit.ACCOUNT:
            until = failed.until
            self._shared.change(
                ADDRESS_ORDERS, AddressOrders, lambda orders: msgspec.structs.replace(orders, until=until)
            )
        return answer_of(200, {"refused": f"the limit of this {limit.value}"})

    def _client(self) -> AddressAuthority:
        self._authority = self._authority or self._open_authority()
        return self._authority
