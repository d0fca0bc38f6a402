"""Orders one certificate at an ACME certificate authority (CA, RFC 8555) by DNS-01, with the library `acme`.

This module neither stores anything nor decides whether to order; `renewal.py` does both. Importing it loads `acme` and
`cryptography` (0.2 s and more), so other modules import it only when they need it.
"""

from __future__ import annotations

import itertools
import re
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

import requests
from acme import challenges as acme_challenges
from acme import client, crypto_util, errors, messages
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec
from josepy.errors import Error as JoseError
from josepy.jwa import ES256
from josepy.jwk import JWKEC

from hippodrome.control.certificates.rules import FailureReason, OrderFailed, OrderStage, StoredCertificate, names_of

REQUEST_SECONDS = 20  # for one response of the CA
NONCE_ROUNDS = 4  # rounds of two attempts if the CA refuses a nonce; each refusal brings a new nonce
MAX_WAIT = timedelta(days=8)  # the longest Retry-After accepted: Let's Encrypt's windows have 7 days
DEFAULT_WAIT = timedelta(hours=1)  # if a CA refuses with `rateLimited` and sends no Retry-After

_RETRY_AFTER = re.compile(r"retry after (\d{4}-\d\d-\d\d)[ T](\d\d:\d\d:\d\d)", re.IGNORECASE)
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


@dataclass(frozen=True)
class OrderRequest:
    """One order: the certificate's domain, the ACME directory, and the account."""

    directory: str
    domain: str  # the certificate is for its wildcard, `*.domain`
    account: Mapping[str, Any] = field(repr=False)  # the JWK of the account key
    email: str = ""
    trusted: str = ""  # the root certificates (PEM) to trust at the directory's HTTPS address; "": the public ones
    seconds: float = 300.0  # for the whole order


def new_account_key() -> dict[str, Any]:
    """Return a new account key (P-256), as a JWK."""
    jwk: dict[str, Any] = JWKEC(key=ec.generate_private_key(ec.SECP256R1())).to_json()
    return jwk


def txt_name(domain: str) -> str:
    """Return the name of the TXT record that proves control of `domain` and `*.domain`."""
    return f"{acme_challenges.DNS01.LABEL}.{domain}"


def order(
    request: OrderRequest, publish: Callable[[list[str], float], None], tell: Callable[[OrderStage], None]
) -> Issued:
    """Place the order, prove control of the domain, fetch the certificate and verify it.

    Calls `tell` at each stage, and `publish` with the values of the TXT record and the seconds within which they must
    be visible. The caller must remove these values afterwards, also if the order fails. Raises OrderFailed, and the
    exceptions of `publish`.
    """
    deadline = time.monotonic() + request.seconds
    names = names_of(request.domain)
    key_pem = ec.generate_private_key(ec.SECP256R1()).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with _network(request) as (network, retry_after):
        tell(OrderStage.ACCOUNT)
        with _errors_translated(retry_after):
            authority = _authority(request, network)
        tell(OrderStage.ORDER)
        with _errors_translated(retry_after):
            ordered = authority.new_order(crypto_util.make_csr(key_pem, list(names)))
            answers = _pending_challenges(ordered, request.domain)
            values = [challenge.validation(network.key) for challenge in answers]
        if answers:
            tell(OrderStage.PUBLISH)
            publish(values, deadline - time.monotonic())
            tell(OrderStage.VALIDATE)
            with _errors_translated(retry_after):
                for challenge in answers:
                    authority.answer_challenge(challenge, challenge.response(network.key))
                ordered = authority.poll_authorizations(ordered, _acme_deadline(deadline))
        tell(OrderStage.ISSUE)
        with _errors_translated(retry_after):
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


def chain_of(privkey: bytes) -> bytes:
    """Return the chain of certificates (PEM) in `privkey.pem`."""
    return privkey[privkey.index(b"-----BEGIN CERTIFICATE") :]


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


# ---- the ACME session


class _Network(client.ClientNetwork):
    """Retries more often after a refused nonce than `acme`, which does so once: a CA may refuse several in a row."""

    def post(self, *args: Any, **kwargs: Any) -> requests.Response:
        for _ in range(NONCE_ROUNDS - 1):
            try:
                return super().post(*args, **kwargs)
            except messages.Error as error:
                if error.code != "badNonce":
                    raise
        return super().post(*args, **kwargs)


@contextmanager
def _network(request: OrderRequest) -> Iterator[tuple[_Network, dict[str, datetime]]]:
    """The connection, and a dict whose `until` is the time of the last Retry-After, which `acme` does not expose."""
    retry_after: dict[str, datetime] = {}

    def note(response: requests.Response, *_: Any, **__: Any) -> None:
        if response.status_code in {429, 503} and (
            until := _parse_retry_after(response.headers.get("Retry-After", ""))
        ):
            retry_after["until"] = until

    with tempfile.TemporaryDirectory() as folder:
        network = _Network(
            JWKEC.from_json(dict(request.account)),
            alg=ES256,
            user_agent="hippodrome",
            timeout=REQUEST_SECONDS,
        )
        if request.trusted:
            roots = Path(folder, "roots.pem")
            roots.write_text(request.trusted)
            network.verify_ssl = str(roots)  # type: ignore[assignment]  # it goes to requests, which takes a path
        network.session.hooks["response"].append(note)
        try:
            yield network, retry_after
        finally:
            network.session.close()


def _authority(request: OrderRequest, network: _Network) -> client.ClientV2:
    """The client of the CA, with our account: opened now, or found by its key."""
    authority = client.ClientV2(client.ClientV2.get_directory(request.directory, network), network)
    if authority.external_account_required():
        raise OrderFailed(
            FailureReason.REFUSED, "it only takes accounts that were opened on its website (external account binding)"
        )
    wanted = messages.NewRegistration.from_data(email=request.email or None, terms_of_service_agreed=True)
    try:
        authority.new_account(wanted)
    except errors.ConflictError as known:
        found = messages.RegistrationResource(body=messages.Registration(), uri=known.location)
        network.account = found
        if request.email:
            authority.update_registration(found, messages.Registration.from_data(email=request.email))
    return authority


def _pending_challenges(ordered: messages.OrderResource, domain: str) -> list[messages.ChallengeBody]:
    """The challenges to answer; none if the CA still accepts an earlier proof."""
    pending = [one for one in ordered.authorizations if one.body.status != messages.STATUS_VALID]
    if any(one.body.identifier.value != domain for one in pending):
        raise OrderFailed(FailureReason.BROKEN, "it wants a proof for another name than the one ordered")
    return [_dns01(one) for one in pending]


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


# ---- errors


@contextmanager
def _errors_translated(retry_after: Mapping[str, datetime]) -> Iterator[None]:
    """Translate the errors of `acme`, `josepy` and `requests` to OrderFailed."""
    try:
        yield
    except messages.Error as error:
        raise _refusal(error, retry_after) from error
    except errors.IssuanceError as error:
        raise _refusal(error.error, retry_after) from error
    except errors.ValidationError as error:
        raise _invalid(error, retry_after) from error
    except errors.TimeoutError as error:
        raise OrderFailed(FailureReason.TIMEOUT, "it did not finish in time") from error
    except requests.exceptions.JSONDecodeError as error:
        raise OrderFailed(FailureReason.BROKEN, "its answer is not JSON") from error
    except requests.exceptions.SSLError as error:
        raise OrderFailed(
            FailureReason.UNREACHABLE, "the certificate of its own HTTPS address is not trusted here"
        ) from error
    except requests.exceptions.RequestException as error:
        raise OrderFailed(FailureReason.UNREACHABLE, f"it cannot be reached ({type(error).__name__})") from error
    except (errors.Error, JoseError, KeyError, AttributeError, TypeError, ValueError) as error:
        answer = error.args[0] if error.args else None
        if isinstance(answer, requests.Response) and answer.status_code >= 500:
            raise OrderFailed(FailureReason.UNREACHABLE, f"it answers HTTP {answer.status_code}") from error
        raise OrderFailed(
            FailureReason.BROKEN, f"its answer is not the expected one ({type(error).__name__})"
        ) from error


def _refusal(error: messages.Error, retry_after: Mapping[str, datetime]) -> OrderFailed:
    text = _text(error)
    match error.code:
        case "rateLimited":
            until = retry_after.get("until") or _retry_after_in(text) or datetime.now(UTC) + DEFAULT_WAIT
            return OrderFailed(FailureReason.RATE_LIMITED, text, until)
        case "caa":
            return OrderFailed(FailureReason.CAA, text)
        case "serverInternal" | "badNonce":
            return OrderFailed(FailureReason.UNREACHABLE, text, retry_after.get("until"))
        case _:
            return OrderFailed(FailureReason.REFUSED, text)


def _invalid(error: errors.ValidationError, retry_after: Mapping[str, datetime]) -> OrderFailed:
    reasons = [
        challenge.error
        for authorization in error.failed_authzrs
        for challenge in authorization.body.challenges
        if challenge.error is not None
    ]
    for reason in reasons:
        if reason.code in {"caa", "rateLimited"}:
            return _refusal(reason, retry_after)
    return OrderFailed(FailureReason.VALIDATION, "; ".join(map(_text, reasons)) or "it gave no reason")


def _text(error: messages.Error) -> str:
    """The CA's message in one line, without control characters, since it may be printed in a terminal."""
    sentences = [error.detail or error.title or str(error.typ or "no reason given")]
    sentences += [problem.detail for problem in error.subproblems or () if problem.detail]
    return " ".join("".join(c if c.isprintable() else " " for c in " ".join(sentences)).split())[:1000]


def _parse_retry_after(header: str) -> datetime | None:
    """The time in a Retry-After header (seconds, or a date), at most `MAX_WAIT` from now; None if it is neither."""
    now = datetime.now(UTC)
    if header.strip().isdecimal():
        return now + min(timedelta(seconds=int(header.strip()[:9])), MAX_WAIT)
    try:
        at = parsedate_to_datetime(header)
    except ValueError:
        return None
    return min(at if at.tzinfo else at.replace(tzinfo=UTC), now + MAX_WAIT)


def _retry_after_in(text: str) -> datetime | None:
    """The time in Let's Encrypt's message, such as "retry after 2026-11-22 10:00:00 UTC"; None if there is none."""
    if found := _RETRY_AFTER.search(text):
        with suppress(ValueError):
            return min(datetime.fromisoformat(f"{found[1]}T{found[2]}+00:00"), datetime.now(UTC) + MAX_WAIT)
    return None
