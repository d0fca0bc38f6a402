"""Decides where the servers' TLS certificate is stored, and when to order a new one. Pure.

All servers show one certificate for `*.<the servers' domain>`, ordered by ACME (RFC 8555) with a DNS-01 challenge. It
is stored under `SSL/<the servers' domain>/`, so that every server reads a certificate for its own name:

* `privkey.pem`: a line that names the certificate's ACME directory, the private key, and its chain. Writing this one
  document replaces the old certificate, so no reader ever sees a key without its chain.
* `fullchain.pem`: a copy of the chain, where HIPPO's `ssl` section and other readers expect it.
* `certificate.json`: a `CertificateRecord`, which says what was ordered and when.

`SSL/account.json` has the keys of our accounts, one for each ACME directory. Without a domain each server has a
certificate for its own address (`addresses.py`), and `SSL/addresses.json` counts their orders.

If `privkey.pem` lacks that first line, the administrator has put it there, and no order replaces it.

Facts of Let's Encrypt (its pages "Integration Guide", 23 June 2025, "Rate Limits", 12 June 2025, "Profiles",
8 September 2026, and "Decreasing Certificate Lifetimes to 45 Days", 2 December 2025; read November 2026):

* Renew a certificate when a third of its lifetime is left; when half of it is left, if the lifetime is below 10 days.
  The default profile gives 90 days, 64 from 10 February 2027, 45 from 16 February 2028; `shortlived` gives 160 hours.
* After failures wait 1, 10, 100 minutes, then a day; the administrator may retry earlier.
* Limits: 5 failed validations per name and account an hour (one more every 12 minutes), 5 certificates for the same
  names in 7 days (one more every 34 hours), 10 new accounts per address in 3 hours. A request over a limit is refused
  with a Retry-After. The staging directory has the same limits with larger numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import StrEnum
from typing import Annotated, NamedTuple

import msgspec

from hippodrome.control.model.records import Record

ACCOUNT = "SSL/account.json"
ADDRESS_ORDERS = "SSL/addresses.json"

PRODUCTION = "https://acme-v02.api.letsencrypt.org/directory"
STAGING = "https://acme-staging-v02.api.letsencrypt.org/directory"

RENEW_BEFORE = timedelta(days=30)
SHORT_LIVED = timedelta(days=10)
CLAIM = timedelta(minutes=15)  # how long a claim counts: no order takes longer than the longest timeout in Lambda
# The waits after one failed order, two, three, and more. The last is less than a day, so a daily timer tries every day.
BACKOFF = (timedelta(minutes=1), timedelta(minutes=10), timedelta(minutes=100), timedelta(hours=20))
HOUR = timedelta(hours=1)
MAX_VALIDATIONS_PER_HOUR = 4  # one less than Let's Encrypt allows
ORDERS_WINDOW = timedelta(hours=3)
MAX_ORDERS = 300  # for addresses, in that time (Let's Encrypt's "New Orders per Account")
MAX_ORDERS_OF_SERVER = 5  # a server makes three tries; the answers to some may be lost
MAX_ORDERS_AT_START = 250  # no server is started after so many: those under way still order, some of them twice
MAX_FAILURES = 10  # failed orders that are stored
MAX_TEXT = 1000  # characters of a CA's message that are stored


class Location(NamedTuple):
    """The keys of a certificate's documents."""

    fullchain: str
    privkey: str
    state: str


def location(domain: str) -> Location:
    """Return the keys of the documents of the certificate for names directly below `domain`."""
    return Location(*(f"SSL/{domain}/{name}" for name in ("fullchain.pem", "privkey.pem", "certificate.json")))


def chain_of(privkey: bytes) -> bytes:
    """Return the chain of certificates (PEM) in `privkey.pem`."""
    return privkey[privkey.index(b"-----BEGIN CERTIFICATE") :]


class OrderStage(StrEnum):
    """The stages of an order, worded for the administrator."""

    ACCOUNT = "opening the account"
    ORDER = "placing the order"
    PUBLISH = "publishing the challenge in DNS"
    VALIDATE = "waiting until the authority has seen it"
    ISSUE = "waiting for the certificate"
    STORE = "storing the certificate"


class FailureReason(StrEnum):
    """Why an order failed."""

    VALIDATION = "validation"  # the CA did not find the TXT record, or found a wrong one
    CAA = "caa"  # a CAA record of the domain forbids this CA to issue
    RATE_LIMITED = "rateLimited"  # no order before `until`
    DNS = "dns"  # the TXT record could not be published
    REFUSED = "refused"  # the CA refuses, and says why
    UNREACHABLE = "unreachable"  # the CA did not answer, or is busy
    TIMEOUT = "timeout"  # the order took too long
    WRONG = "wrong"  # the certificate received is not the one ordered
    OVERTAKEN = "overtaken"  # another run orders now, or has stored a certificate meanwhile
    BROKEN = "broken"  # anything else


class Limit(StrEnum):
    """What a `rateLimited` order has too much of: another address does not help against all of these limits."""

    ACCOUNT = "account"  # orders of our account
    ADDRESS = "address"  # certificates for this address, or failed validations of it
    REQUESTS = "requests"  # requests to the CA, from whomever: it is busy


def limit_in(text: str) -> Limit:
    """Return the limit that Let's Encrypt names in this refusal (boulder's ratelimits/limiter.go, August 2026)."""
    if "from this account" in text:
        return Limit.ACCOUNT
    if "too many" in text or "temporarily prevented" in text:
        return Limit.ADDRESS
    return Limit.REQUESTS


@dataclass(frozen=True)
class RenewalRequest:
    """The certificate that should be stored: its domain and its ACME directory."""

    domain: str  # the certificate is for its wildcard, `*.domain`
    directory: str
    email: str = ""  # sent to the CA, not stored
    trusted: str = ""  # the root certificates (PEM) to trust at the directory's HTTPS address; "": the public ones
    force: bool = False  # as in `decide`
    seconds: float = 300.0  # for the whole order


class OrderFailed(Exception):
    """The order failed, and the certificate in use stays. `until`: the CA asks for no retry before this time."""

    def __init__(self, reason: FailureReason, text: str, until: datetime | None = None) -> None:
        super().__init__(text)
        self.reason = reason
        self.until = until


UtcDatetime = Annotated[datetime, msgspec.Meta(tz=True)]


class FailedOrder(Record, frozen=True):
    """An order that failed: when, at which ACME directory, the `FailureReason`, and its text."""

    at: UtcDatetime
    directory: str
    reason: str
    text: str = ""
    until: UtcDatetime | None = None


class CertificateRecord(Record, frozen=True):
    """`certificate.json`: the certificate ordered last ("" and None if none was), and the failed orders since then."""

    schema: int = 1
    directory: str = ""
    serial: str = ""  # hexadecimal
    ordered: UtcDatetime | None = None
    trusted: str = ""  # the root certificates (PEM) to trust at the directory's HTTPS address; "": the public ones
    failures: tuple[FailedOrder, ...] = ()  # since the last success, oldest first
    claim: str = ""  # the token of the run that is ordering now
    claimed: UtcDatetime | None = None


class CountedOrder(NamedTuple):
    """An order of a certificate for an address: when it was placed, and the server's name."""

    at: UtcDatetime
    server: str


class AddressOrders(Record, frozen=True):
    """`SSL/addresses.json`: the orders of certificates for servers' addresses lately, oldest first.

    `until`: the CA takes no order before this time.
    """

    placed: tuple[CountedOrder, ...] = ()
    until: UtcDatetime | None = None

    def count(self, now: datetime, server: str = "") -> int:
        """Return how many orders count against the CA's limit now: all, or this server's."""
        return sum(now - order.at < ORDERS_WINDOW and server in ("", order.server) for order in self.placed)

    def allows(self, now: datetime, most: int) -> bool:
        """Return whether another order may be placed, if `most` may count."""
        return self.count(now) < most and (self.until is None or now >= self.until)

    def with_order(self, now: datetime, server: str) -> AddressOrders:
        """Return the record with one more order; orders that do not count any more leave it."""
        kept = (order for order in self.placed if now - order.at < ORDERS_WINDOW)
        return AddressOrders((*kept, CountedOrder(now, server)), self.until)


@dataclass(frozen=True)
class StoredCertificate:
    """The names and dates of the certificate in the bucket."""

    names: tuple[str, ...]
    serial: str
    not_before: datetime
    not_after: datetime
    directory: str = ""  # the ACME directory that issued it; "" if the administrator put it there

    def days_left(self, now: datetime) -> int:
        """Return the whole days until the certificate expires; negative afterwards."""
        return (self.not_after - now) // timedelta(days=1)


class Verdict(StrEnum):
    """Whether to order a certificate; if not, why not."""

    FRESH = "fresh"
    ORDER = "order"
    WAIT = "wait"  # after a failure; not before `Decision.until`
    BUSY = "busy"  # another run is ordering
    FOREIGN = "foreign"  # the administrator put the certificate there


@dataclass(frozen=True)
class Decision:
    """Whether to order, the reason in words, and the time at which this may change."""

    verdict: Verdict
    why: str
    until: datetime | None = None


def names_of(domain: str) -> tuple[str, ...]:
    """Return the names that the certificate is for: the wildcard `*.domain`."""
    return (f"*.{domain}",)


def proof_name(domain: str) -> str:
    """Return the name of the TXT record that proves control of `domain` and `*.domain` (RFC 8555, section 8.4)."""
    return f"_acme-challenge.{domain}"


def renew_at(not_before: datetime, not_after: datetime) -> datetime:
    """Return the time at which to renew a certificate.

    It is 30 days before the certificate expires, or when a third of its lifetime is left if that is later. For a
    lifetime below 10 days it is when half of it is left.
    """
    lifetime = not_after - not_before
    left = lifetime / 2 if lifetime < SHORT_LIVED else min(RENEW_BEFORE, lifetime / 3)
    return not_after - left


def decide(
    state: CertificateRecord,
    stored: StoredCertificate | None,
    directory: str,
    names: Sequence[str],
    *,
    now: datetime,
    force: bool = False,
) -> Decision:
    """Decide whether to order a certificate for these names at this directory now.

    With `force` the decision is to order even if the certificate is fresh or not ours, another run holds a claim, or an
    order failed a moment ago. But even then no order begins before the time that the CA has asked for, or beyond the
    hourly limit of failed validations.
    """
    by_certificate = _decide_by_certificate(stored, directory, names, now)
    if by_certificate.verdict is not Verdict.ORDER and not force:
        return by_certificate
    busy = state.claimed + CLAIM if state.claim and state.claimed else None
    if busy and now < busy and not force:
        return Decision(Verdict.BUSY, "another run is ordering a certificate", busy)
    until, why = _wait_after_failures(state, directory, now, force)
    if until:
        return Decision(Verdict.WAIT, why, until)
    return by_certificate if by_certificate.verdict is Verdict.ORDER else Decision(Verdict.ORDER, "asked for")


def _decide_by_certificate(
    stored: StoredCertificate | None, directory: str, names: Sequence[str], now: datetime
) -> Decision:
    if stored is None:
        return Decision(Verdict.ORDER, "there is no certificate yet")
    if not stored.directory:
        return Decision(Verdict.FOREIGN, "the certificate was put there by hand")
    if sorted(stored.names) != sorted(names):
        return Decision(Verdict.ORDER, f"the present certificate is for {', '.join(stored.names) or 'no name'}")
    if stored.directory != directory:
        return Decision(Verdict.ORDER, "the present certificate is from another certificate authority")
    at = renew_at(stored.not_before, stored.not_after)
    if now >= stored.not_after:
        return Decision(Verdict.ORDER, "the certificate has expired")
    if now >= at:
        return Decision(Verdict.ORDER, "the certificate is due for renewal")
    return Decision(Verdict.FRESH, "the certificate is fresh", at)


def _wait_after_failures(
    state: CertificateRecord, directory: str, now: datetime, force: bool
) -> tuple[datetime | None, str]:
    failures = [failure for failure in state.failures if failure.directory == directory]
    if not failures:
        return None, ""
    last = failures[-1]
    if last.until and now < last.until:
        return last.until, "the certificate authority has asked to wait"
    recent = [f.at for f in failures if f.reason == FailureReason.VALIDATION and now - HOUR < f.at <= now]
    if len(recent) >= MAX_VALIDATIONS_PER_HOUR:
        return recent[-MAX_VALIDATIONS_PER_HOUR] + HOUR, f"{len(recent)} validations failed within an hour"
    again = last.at + BACKOFF[min(len(failures), len(BACKOFF)) - 1]
    # A failure in the future comes from a wrong clock: do not wait for it.
    if not force and last.at <= now < again:
        return again, f"the last {len(failures)} orders failed" if len(failures) > 1 else "the last order failed"
    return None, ""


def claimed(state: CertificateRecord, token: str, now: datetime) -> CertificateRecord:
    """Return the record with the claim of the run that has this token and orders now."""
    return msgspec.structs.replace(state, claim=token, claimed=now)


def unclaimed(state: CertificateRecord) -> CertificateRecord:
    """Return the record without a claim, after a run was interrupted (Ctrl-C), so that another run may order."""
    return msgspec.structs.replace(state, claim="", claimed=None)


def failed(state: CertificateRecord, failure: FailedOrder) -> CertificateRecord:
    """Return the record with this failed order added, and without the claim of its run."""
    kept = (*state.failures, msgspec.structs.replace(failure, text=failure.text[:MAX_TEXT]))[-MAX_FAILURES:]
    return msgspec.structs.replace(unclaimed(state), failures=kept)


def succeeded(stored: StoredCertificate, trusted: str, now: datetime) -> CertificateRecord:
    """Return the record of this new certificate, without the failed orders before it and without a claim."""
    return CertificateRecord(directory=stored.directory, serial=stored.serial, ordered=now, trusted=trusted)
