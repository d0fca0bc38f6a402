"""Orders certificates for servers' IPv4 addresses at an ACME certificate authority, by HTTP-01, in short calls.

Each call sends a few requests and waits for nothing: the server itself asks again. So an order holds no function's
execution while the CA works. Nothing is kept between the calls, except the client with our account.

Facts of Let's Encrypt (its pages "Profiles", 8 September 2026, "Rate Limits", 12 June 2025, and its announcement of 15
January 2026; read November 2026): certificates for addresses come with the profile `shortlived` alone, live for 160
hours, and need HTTP-01 or TLS-ALPN-01. An account may place 300 orders in 3 hours, one more every 36 seconds; an
address gets 5 certificates in 7 days, over all accounts, and 5 failed validations an hour. A failed order cannot be
repeated: each try is a new one. Each answer to a challenge starts a validation, also while another one runs, and each
counts if it fails (boulder's `PerformValidation`, August 2026), so a challenge is answered once.
"""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

from acme import challenges, client, messages
from cryptography import x509

from hippodrome.control.certificates.rules import FailureReason, OrderFailed
from hippodrome.control.certificates.session import errors_translated, open_account, open_network, text_of

PROFILE = "shortlived"


@dataclass(frozen=True)
class AddressOrder:
    """A new order: its URL, and the challenge's token and key authorization, which the address must serve.

    Token and proof are "" if the CA still accepts an earlier proof.
    """

    url: str
    token: str = ""
    proof: str = ""


class AddressAuthority:
    """A CA with our account. Its connection stays open as long as the process lives."""

    def __init__(self, directory: str, account: Mapping[str, Any], trusted: str = "") -> None:
        """Open the account, or find it. `trusted` is as in `open_network`. Raises OrderFailed."""
        self._directory = directory
        self._stack = ExitStack()
        self._network, self._retry_after = self._stack.enter_context(open_network(account, trusted))
        with errors_translated(self._retry_after):
            self._authority: client.ClientV2 = open_account(directory, self._network)

    def order(self, address: str) -> AddressOrder:
        """Place an order for this IPv4 address. Raises OrderFailed."""
        with errors_translated(self._retry_after):
            identifier = messages.Identifier(typ=messages.IDENTIFIER_IP, value=address)
            wanted = messages.NewOrder(identifiers=[identifier], profile=PROFILE)
            response = self._post(self._authority.directory["newOrder"], wanted)
            url = response.headers["Location"]
            challenge = self._challenge(messages.Order.from_json(response.json()))
            if challenge is None:
                return AddressOrder(url)
            return AddressOrder(
                url, challenge.chall.encode("token"), challenge.chall.key_authorization(self._network.key)
            )

    def advance(self, url: str, address: str, csr: str, *, answer: bool, may_issue: bool) -> str:
        """Take the order's next step; return the chain of certificates (PEM) once it is issued, else "".

        With `answer` the CA is asked to look at the address. Without `may_issue` the order stops before its
        certificate. Raises OrderFailed if the order has failed, and
        PermissionError if it is no order for this address at this authority.
        """
        if urlsplit(url)[:2] != urlsplit(self._directory)[:2]:
            raise PermissionError("the order is at another authority")
        with errors_translated(self._retry_after):
            order = messages.Order.from_json(self._post(url).json())
            named = [(identifier.typ, identifier.value) for identifier in order.identifiers]
            if named != [(messages.IDENTIFIER_IP, address)]:
                raise PermissionError("the order is for another address")
            if order.status == messages.STATUS_PENDING and answer:
                self._answer(order)
            elif order.status == messages.STATUS_READY and may_issue:
                wanted = messages.CertificateRequest(csr=_request(csr))
                order = messages.Order.from_json(self._post(order.finalize, wanted).json())
            if order.status == messages.STATUS_INVALID:
                raise self._failure(order)
            if order.status == messages.STATUS_VALID and may_issue:
                return str(self._post(order.certificate).text)
        return ""

    def _answer(self, order: messages.Order) -> None:
        """Ask the CA to look at the address."""
        challenge = self._challenge(order)
        if challenge is not None and challenge.status == messages.STATUS_PENDING:
            self._authority.answer_challenge(challenge, challenge.response(self._network.key))

    def _failure(self, order: messages.Order) -> OrderFailed:
        """Why this order is invalid: the challenge says it, or the order if its certificate was refused."""
        challenge = self._challenge(order)
        if challenge is not None and challenge.error is not None:
            return OrderFailed(FailureReason.VALIDATION, text_of(challenge.error))
        return OrderFailed(FailureReason.REFUSED, text_of(order.error) if order.error else "it gave no reason")

    def _challenge(self, order: messages.Order) -> messages.ChallengeBody | None:
        """The order's HTTP-01 challenge; None if the address is proven. Raises OrderFailed if there is none."""
        (url,) = order.authorizations
        authorization = messages.Authorization.from_json(self._post(url).json())
        if authorization.status == messages.STATUS_VALID:
            return None
        for challenge in authorization.challenges:
            if isinstance(challenge.chall, challenges.HTTP01):
                found: messages.ChallengeBody = challenge
                return found
        raise OrderFailed(FailureReason.REFUSED, "it does not offer the challenge http-01 for this address")

    def _post(self, url: str, body: Any = None) -> Any:
        """Send a signed request; without a body, it reads the resource (RFC 8555, 6.3)."""
        return self._network.post(url, body, new_nonce_url=self._authority.directory["newNonce"])


def _request(csr: str) -> x509.CertificateSigningRequest:
    return x509.load_pem_x509_csr(csr.encode())
