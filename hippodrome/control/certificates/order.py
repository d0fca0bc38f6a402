"""Orders one certificate at an ACME certificate authority (CA, RFC 8555) by DNS-01, with the library `acme`.

This module neither stores anything nor decides whether to order; `renewal.py` does both. Importing it loads `acme` and
`cryptography` (0.2 s and more), so other modules import it only when they need it.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

from acme import challenges as acme_challenges
from acme import crypto_util, messages
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from hippodrome.control.certificates.rules import (
    FailureReason,
    OrderFailed,
    OrderStage,
    RenewalRequest,
    StoredCertificate,
    names_of,
)
from hippodrome.control.certificates.session import errors_translated, open_account, open_network

_LONG_AGO = datetime(1970, 1, 1, tzinfo=UTC)
_ORIGIN = "Hippodrome: ordered at "


@dataclass(frozen=True)
class Issued:
    """A new certificate: its private key and its chain (PEM), and the names and dates of its first certificate."""

    key: str = field(repr=False)
    chain: str
    stored: StoredCertificate

    @property
    def document(self) -> bytes:
        """The content of `privkey.pem`: a line with the ACME directory (readers of PEM skip it), the key, the chain."""
        return f"{_ORIGIN}{self.stored.directory}\n{self.key}{self.chain}".encode()


def order(
    request: RenewalRequest,
    account: Mapping[str, Any],
    publish: Callable[[list[str], float], None],
    tell: Callable[[OrderStage], None],
) -> Issued:
    """Place the order, prove control of the domain, fetch the certificate and verify it.

    `account` is the JWK of the account key. Calls `tell` at each stage, and `publish` with the values of the TXT record
    and the seconds within which they must be visible. The caller must remove these values afterwards, also if the order
    fails. Raises OrderFailed, and the exceptions of `publish`.
    """
    deadline = time.monotonic() + request.seconds
    names = names_of(request.domain)
    key_pem = ec.generate_private_key(ec.SECP256R1()).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with open_network(account, request.trusted) as (network, retry_after):
        tell(OrderStage.ACCOUNT)
        with errors_translated(retry_after):
            authority = open_account(request.directory, network, request.email)
        tell(OrderStage.ORDER)
        with errors_translated(retry_after):
            ordered = authority.new_order(crypto_util.make_csr(key_pem, list(names)))
            # Without any, the CA still accepts an earlier proof.
            answers = [_dns01(one) for one in ordered.authorizations if one.body.status != messages.STATUS_VALID]
            values = [challenge.validation(network.key) for challenge in answers]
        if answers:
            tell(OrderStage.PUBLISH)
            publish(values, deadline - time.monotonic())
            tell(OrderStage.VALIDATE)
            with errors_translated(retry_after):
                for challenge in answers:
                    authority.answer_challenge(challenge, challenge.response(network.key))
                ordered = authority.poll_authorizations(ordered, _acme_deadline(deadline))
        tell(OrderStage.ISSUE)
        with errors_translated(retry_after):
            done = authority.finalize_order(ordered, _acme_deadline(deadline))
    issued = Issued(key_pem.decode(), done.fullchain_pem, read_chain(done.fullchain_pem.encode(), request.directory))
    _verify(issued, names)
    return issued


def read_stored(privkey: bytes) -> StoredCertificate | None:
    """Return the certificate in `privkey.pem`; None if Hippodrome did not order it.

    If it cannot be read, return what `read_or_expired` returns.
    """
    origin, _, rest = privkey.partition(b"\n")
    directory = origin.decode(errors="replace").strip()
    if not directory.startswith(_ORIGIN):
        return None
    return read_or_expired(rest, directory.removeprefix(_ORIGIN))


def read_or_expired(chain: bytes, directory: str = "") -> StoredCertificate:
    """Return the names and dates of the first certificate of the chain.

    If it cannot be read, return a certificate without names that expired long ago, so that a new one is ordered.
    """
    try:
        return read_chain(chain, directory)
    except OrderFailed:
        return StoredCertificate((), "", _LONG_AGO, _LONG_AGO, directory)


def read_chain(pem: bytes, directory: str = "") -> StoredCertificate:
    """Return the names and dates of the first certificate in this PEM. Raises OrderFailed (WRONG) if there is none."""
    try:
        first = x509.load_pem_x509_certificate(pem)
        names = first.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except (ValueError, x509.ExtensionNotFound) as error:
        raise OrderFailed(FailureReason.WRONG, "the certificate cannot be read") from error
    return StoredCertificate(
        names=tuple(sorted(names.get_values_for_type(x509.DNSName))),
        serial=f"{first.serial_number:x}",
        not_before=first.not_valid_before_utc,
        not_after=first.not_valid_after_utc,
        directory=directory,
    )


def _dns01(authorization: messages.AuthorizationResource) -> messages.ChallengeBody:
    for challenge in authorization.body.challenges:
        if isinstance(challenge.chall, acme_challenges.DNS01):
            found: messages.ChallengeBody = challenge
            return found
    raise OrderFailed(FailureReason.REFUSED, "it does not offer the challenge dns-01 for this name")


def _acme_deadline(deadline: float) -> datetime:
    """This deadline, a `time.monotonic` value, as `acme` wants it: local time without a time zone."""
    return datetime.now() + timedelta(seconds=deadline - time.monotonic())


def _verify(issued: Issued, names: Sequence[str]) -> None:
    """Check that the certificate is the one ordered. Raises OrderFailed (WRONG) otherwise."""
    key = serialization.load_pem_private_key(issued.key.encode(), None)
    chain = x509.load_pem_x509_certificates(issued.chain.encode())
    if chain[0].public_key() != key.public_key():
        raise OrderFailed(FailureReason.WRONG, "the new certificate is for another key")
    if list(issued.stored.names) != sorted(names):
        raise OrderFailed(FailureReason.WRONG, f"the new certificate is for {', '.join(issued.stored.names)}")
    if issued.stored.not_after <= datetime.now(UTC):
        raise OrderFailed(FailureReason.WRONG, "the new certificate has expired")
    for below, above in itertools.pairwise(chain):
        try:
            below.verify_directly_issued_by(above)
        except (ValueError, TypeError, InvalidSignature) as error:
            raise OrderFailed(FailureReason.WRONG, "the chain of the new certificate is not valid") from error
