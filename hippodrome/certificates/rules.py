"""The certificate of the servers' names: what is stored of it, and when to order another. Pure.

One certificate for `*.<the servers' domain>`, ordered by ACME (RFC 8555) with a DNS-01 challenge. It lies under
`SSL/<the servers' domain>/`, so that no server is ever given a certificate for other names than its own, also while an
installation moves from one domain to another:

* `privkey.pem`: a line that says where the certificate comes from, the private key, and the chain that fits it. Writing
  this one document is the moment at which a new certificate replaces the old, so there is no moment at which somebody
  could read a key without its chain.
* `fullchain.pem`: the same chain once more, where HIPPO's `ssl` section and other readers look for it.
* `certificate.json`: `State`, what we did and when.

`SSL/account.json` has the keys of our accounts, one for each ACME directory. Earlier versions kept a certificate for
`*.<root domain>` in `SSL/` itself (`FORMER`); servers that they named still read it.

A `privkey.pem` without that line was not written by us, but put there by hand: it is left alone.

Facts of Let's Encrypt (its pages "Integration Guide", 23 June 2025, "Rate Limits", 12 June 2025, "Profiles",
8 September 2026, and "Decreasing Certificate Lifetimes to 45 Days", 2 December 2025; read November 2026):

* Renew with a third of the lifetime left, below 10 days of lifetime with half of it. The default profile gives 90 days,
  64 from 10 February 2027, 45 from 16 February 2028; the profile `shortlived` gives 160 hours.
* After failures wait 1, 10, 100 minutes, then a day; the administrator may retry earlier.
* Limits: 5 failed validations per name and account an hour (one more every 12 minutes), 5 certificates for the same
  names in 7 days (one more every 34 hours), 10 new accounts per address in 3 hours. What is over is told with a
  Retry-After. Staging has the same limits with larger numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Annotated, NamedTuple

import msgspec

from hippodrome.model.records import Record

ACCOUNT = "SSL/account.json"

PRODUCTION = "https://acme-v02.api.letsencrypt.org/directory"
STAGING = "https://acme-staging-v02.api.letsencrypt.org/directory"

RENEW_BEFORE = timedelta(days=30)
SHORT_LIVED = timedelta(days=10)
CLAIM = timedelta(minutes=15)  # so long an order may take: what a Lambda function may live
# The last one is less than a day, so that a timer that fires daily tries once a day and not every other.
BACKOFF = (timedelta(minutes=1), timedelta(minutes=10), timedelta(minutes=100), timedelta(hours=20))
HOUR = timedelta(hours=1)
VALIDATIONS_AN_HOUR = 4  # one less than Let's Encrypt allows
FAILURES_KEPT = 10
LONGEST_TEXT = 1000  # characters of a CA's words that are kept


class Place(NamedTuple):
    """Where a certificate lies: keys of documents."""

    fullchain: str
    privkey: str
    state: str


FORMER = Place("SSL/fullchain.pem", "SSL/privkey.pem", "SSL/certificate.json")
"""Where earlier versions kept that of `*.<root domain>`. A `ssl` section that names these means the installation's."""


def place(domain: str, root_domain: str) -> Place:
    """Where the certificate of the names directly below this domain lies."""
    if domain == root_domain:
        return FORMER
    return Place(*(f"SSL/{domain}/{name}" for name in ("fullchain.pem", "privkey.pem", "certificate.json")))


class Stage(StrEnum):
    """How far an order is, in words for people."""

    ACCOUNT = "opening the account"
    ORDER = "placing the order"
    PUBLISH = "publishing the challenge in DNS"
    VALIDATE = "waiting until the authority has seen it"
    ISSUE = "waiting for the certificate"
    STORE = "storing the certificate"


class Trouble(StrEnum):
    """Why an order failed."""

    VALIDATION = "validation"  # the CA looked for the TXT record and did not find it, or found a wrong one
    CAA = "caa"  # a CAA record of the domain forbids this CA to issue
    RATE_LIMITED = "rateLimited"  # not before `until`
    DNS = "dns"  # the TXT record could not be published
    REFUSED = "refused"  # the CA does not want to, and says why
    UNREACHABLE = "unreachable"  # the CA did not answer, or is busy
    TIMEOUT = "timeout"  # it took too long
    WRONG = "wrong"  # what came is not what was ordered
    OVERTAKEN = "overtaken"  # another run has stored a certificate meanwhile
    BROKEN = "broken"  # anything else


class OrderFailed(Exception):
    """No certificate came of it; the one in use stays. `until` is when the CA wants to be asked again."""

    def __init__(self, trouble: Trouble, text: str, until: datetime | None = None) -> None:
        super().__init__(text)
        self.trouble = trouble
        self.until = until


Moment = Annotated[datetime, msgspec.Meta(tz=True)]


class Failure(Record, frozen=True):
    """One order that failed."""

    at: Moment
    directory: str
    trouble: str
    text: str = ""
    until: Moment | None = None


class State(Record, frozen=True):
    """`certificate.json`: the last certificate that was ordered ("" and None if none was), and what came since."""

    schema: int = 1
    directory: str = ""
    names: tuple[str, ...] = ()
    serial: str = ""  # hexadecimal
    not_before: Moment | None = None
    not_after: Moment | None = None
    ordered: Moment | None = None
    trusted: str = ""  # the roots (PEM) of a directory that is no public one
    failures: tuple[Failure, ...] = ()  # since the last success, oldest first
    claim: str = ""  # who is ordering at the moment
    claimed: Moment | None = None
    challenges: tuple[str, ...] = ()  # what may still lie in the TXT record


@dataclass(frozen=True)
class Stored:
    """The certificate that lies in the bucket."""

    names: tuple[str, ...]
    serial: str
    not_before: datetime
    not_after: datetime
    directory: str = ""  # the ACME directory it comes from; "" if it was put there by hand

    def days_left(self, now: datetime) -> int:
        """Whole days until it expires; negative afterwards."""
        return (self.not_after - now) // timedelta(days=1)


class Due(StrEnum):
    """What there is to do."""

    FRESH = "fresh"  # nothing
    ORDER = "order"
    WAIT = "wait"  # after a failure; not before `Decision.until`
    BUSY = "busy"  # somebody else is ordering
    FOREIGN = "foreign"  # the certificate there is not ours


@dataclass(frozen=True)
class Decision:
    """What to do, why in words, and when there will be something to do."""

    due: Due
    why: str
    until: datetime | None = None


def names_of(domain: str) -> tuple[str, ...]:
    """The names on the certificate of the servers whose names lie directly below this domain."""
    return (f"*.{domain}",)


def renew_at(not_before: datetime, not_after: datetime) -> datetime:
    """When to order the next one: with 30 days left, or a third (half, if it is short-lived) of its lifetime."""
    lifetime = not_after - not_before
    left = lifetime / 2 if lifetime < SHORT_LIVED else min(RENEW_BEFORE, lifetime / 3)
    return not_after - left


def decide(
    state: State, stored: Stored | None, directory: str, names: Sequence[str], *, now: datetime, force: bool = False
) -> Decision:
    """Whether to order these names at this directory now.

    `force` orders although the certificate is fresh, or not ours, or another run says it is at work, and does not wait
    after failures; what the CA has asked to wait, and the hourly limit of failed validations, hold nevertheless.
    """
    wanted = _wanted(stored, directory, names, now)
    if wanted.due is not Due.ORDER and not force:
        return wanted
    busy = state.claimed + CLAIM if state.claim and state.claimed else None
    if busy and now < busy and not force:
        return Decision(Due.BUSY, "another run is ordering a certificate", busy)
    until, why = _wait(state, directory, now, force)
    if until:
        return Decision(Due.WAIT, why, until)
    return wanted if wanted.due is Due.ORDER else Decision(Due.ORDER, "asked for")


def _wanted(stored: Stored | None, directory: str, names: Sequence[str], now: datetime) -> Decision:
    if stored is None:
        return Decision(Due.ORDER, "there is no certificate yet")
    if not stored.directory:
        return Decision(Due.FOREIGN, "the certificate there was put there by hand")
    if sorted(stored.names) != sorted(names):
        return Decision(Due.ORDER, f"the certificate there is for {', '.join(stored.names) or 'no name'}")
    if stored.directory != directory:
        return Decision(Due.ORDER, "the certificate there comes from elsewhere")
    at = renew_at(stored.not_before, stored.not_after)
    if now >= stored.not_after:
        return Decision(Due.ORDER, "the certificate has expired")
    if now >= at:
        return Decision(Due.ORDER, "the certificate is due for renewal")
    return Decision(Due.FRESH, "the certificate is fresh", at)


def _wait(state: State, directory: str, now: datetime, force: bool) -> tuple[datetime | None, str]:
    failures = [failure for failure in state.failures if failure.directory == directory]
    if not failures:
        return None, ""
    last = failures[-1]
    if last.until and now < last.until:
        return last.until, "the certificate authority has asked to wait"
    recent = [f.at for f in failures if f.trouble == Trouble.VALIDATION and now - HOUR < f.at <= now]
    if len(recent) >= VALIDATIONS_AN_HOUR:
        return recent[-VALIDATIONS_AN_HOUR] + HOUR, f"{len(recent)} validations failed within an hour"
    again = last.at + BACKOFF[min(len(failures), len(BACKOFF)) - 1]
    # A time that lies ahead of us comes from a clock that went wrong, and nothing is waited for it.
    if not force and last.at <= now < again:
        return again, f"the last {len(failures)} orders failed" if len(failures) > 1 else "the last order failed"
    return None, ""


def claimed(state: State, token: str, now: datetime) -> State:
    """From here on `token` is ordering."""
    return msgspec.structs.replace(state, claim=token, claimed=now)


def publishing(state: State, values: Sequence[str]) -> State:
    """These values are about to be published; whoever finds them here removes them, should we not come to that."""
    return msgspec.structs.replace(state, challenges=tuple(values))


def tidied(state: State, values: Sequence[str]) -> State:
    """These values are not published any more."""
    return msgspec.structs.replace(state, challenges=()) if state.challenges == tuple(values) else state


def released(state: State) -> State:
    """Nobody is ordering, and nothing came of it that would have to be remembered (somebody pressed Ctrl-C)."""
    return msgspec.structs.replace(state, claim="", claimed=None)


def failed(state: State, failure: Failure) -> State:
    """The order failed."""
    kept = (*state.failures, msgspec.structs.replace(failure, text=failure.text[:LONGEST_TEXT]))[-FAILURES_KEPT:]
    return msgspec.structs.replace(released(state), failures=kept)


def succeeded(state: State, stored: Stored, trusted: str, now: datetime) -> State:
    """This certificate is stored."""
    return msgspec.structs.replace(
        released(state),
        directory=stored.directory,
        names=stored.names,
        serial=stored.serial,
        not_before=stored.not_before,
        not_after=stored.not_after,
        ordered=now,
        trusted=trusted,
        failures=(),
    )
