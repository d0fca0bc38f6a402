"""The session with an ACME certificate authority (CA, RFC 8555): its connection, our account, and its errors.

Importing it loads `acme` and `cryptography` (0.2 s and more), so other modules import it only when they need it.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from email.utils import parsedate_to_datetime
from pathlib import Path
from typing import Any

import requests
from acme import client, errors, messages
from cryptography.hazmat.primitives.asymmetric import ec
from josepy.errors import Error as JoseError
from josepy.jwa import ES256
from josepy.jwk import JWKEC

from hippodrome.control.certificates.rules import FailureReason, OrderFailed

REQUEST_SECONDS = 20  # for one response of the CA
NONCE_ROUNDS = 4  # rounds of two attempts if the CA refuses a nonce; each refusal brings a new nonce
MAX_WAIT = timedelta(days=8)  # the longest Retry-After accepted: Let's Encrypt's windows have 7 days
DEFAULT_WAIT = timedelta(hours=1)  # if a CA refuses with `rateLimited` and sends no Retry-After


def new_account_key() -> dict[str, Any]:
    """Return a new account key (P-256), as a JWK."""
    jwk: dict[str, Any] = JWKEC(key=ec.generate_private_key(ec.SECP256R1())).to_json()
    return jwk


class Network(client.ClientNetwork):
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
def open_network(account: Mapping[str, Any], trusted: str = "") -> Iterator[tuple[Network, dict[str, datetime]]]:
    """Open a connection for an account (JWK), with a dict whose `until` is the time of the last Retry-After.

    `trusted` are the roots (PEM) by which the CA's own address is checked; "": the public ones.
    """
    retry_after: dict[str, datetime] = {}

    def note(response: requests.Response, *_: Any, **__: Any) -> None:
        if response.status_code in {429, 503} and (
            until := _parse_retry_after(response.headers.get("Retry-After", ""))
        ):
            retry_after["until"] = until

    with tempfile.TemporaryDirectory() as folder:
        network = Network(
            JWKEC.from_json(dict(account)),
            alg=ES256,
            user_agent="hippodrome",
            timeout=REQUEST_SECONDS,
        )
        if trusted:
            roots = Path(folder, "roots.pem")
            roots.write_text(trusted)
            network.verify_ssl = str(roots)  # type: ignore[assignment]  # it goes to requests, which takes a path
        network.session.hooks["response"].append(note)
        try:
            yield network, retry_after
        finally:
            network.session.close()


def open_account(directory: str, network: Network, email: str = "") -> client.ClientV2:
    """Return the client of the CA, with our account: opened now, or found by its key. Raises OrderFailed."""
    authority = client.ClientV2(client.ClientV2.get_directory(directory, network), network)
    if authority.external_account_required():
        raise OrderFailed(
            FailureReason.REFUSED, "it only takes accounts that were opened on its website (external account binding)"
        )
    wanted = messages.NewRegistration.from_data(email=email or None, terms_of_service_agreed=True)
    try:
        authority.new_account(wanted)
    except errors.ConflictError as known:
        found = messages.RegistrationResource(body=messages.Registration(), uri=known.location)
        network.account = found
        if email:
            authority.update_registration(found, messages.Registration.from_data(email=email))
    return authority


@contextmanager
def errors_translated(retry_after: Mapping[str, datetime]) -> Iterator[None]:
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
    text = text_of(error)
    match error.code:
        case "rateLimited":
            return OrderFailed(
                FailureReason.RATE_LIMITED, text, retry_after.get("until", datetime.now(UTC) + DEFAULT_WAIT)
            )
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
    return OrderFailed(FailureReason.VALIDATION, "; ".join(map(text_of, reasons)) or "it gave no reason")


def text_of(error: messages.Error) -> str:
    """Return the CA's message in one line, without control characters, since it may be printed in a terminal."""
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
