"""Orders a certificate if `rules.py` decides so, and stores it where the servers read it.

A run first claims the order in `certificate.json`, by compare-and-swap, so two runs never order at the same time. If a
run is killed, its claim expires after `rules.CLAIM`. One conditional write of `privkey.pem` replaces the certificate.
All other documents are derived from `privkey.pem`; if a run is interrupted, the next run repairs them.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Protocol

from hippodrome.control.certificates import rules
from hippodrome.control.certificates.accounts import account_key
from hippodrome.control.certificates.rules import (
    CertificateRecord,
    Decision,
    FailureReason,
    Location,
    OrderFailed,
    OrderStage,
    StoredCertificate,
    Verdict,
)
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.ports import Conflict, Document, Documents

if TYPE_CHECKING:
    from hippodrome.control.certificates.order import Issued

MAX_TRIES = 10  # for a conditional write of a document that other runs may write at the same time


class Challenges(Protocol):
    """Publishes and removes the TXT records of DNS-01 challenges."""

    def put(self, name: str, values: Sequence[str], seconds: float) -> None:
        """Set the values of the TXT record `name`; return once every name server of the zone has them.

        Raises OrderFailed (DNS, or TIMEOUT after `seconds`), and the library's own errors.
        """

    def remove(self, name: str, values: Sequence[str]) -> None:
        """Remove the record if it has exactly these values."""


@dataclass(frozen=True)
class RenewalRequest:
    """The certificate that should be stored: its domain and its ACME directory."""

    domain: str
    directory: str
    email: str = ""  # sent to the CA, not stored
    trusted: str = ""  # as in `order.OrderRequest`
    force: bool = False  # as in `rules.decide`
    seconds: float = 300.0  # for the whole order


@dataclass(frozen=True)
class RenewalOutcome:
    """The result of `obtain`: the decision, and the certificate that is stored now."""

    decision: Decision
    stored: StoredCertificate | None

    @property
    def ordered(self) -> bool:
        return self.decision.verdict is Verdict.ORDER


class Renewal:
    """Renews the certificate at one location.

    Each stage of an order is passed to `tell`. An error that does not end the run is passed to `note`, with a text.
    """

    def __init__(
        self,
        documents: Documents,
        challenges: Challenges,
        now: Callable[[], datetime],
        location: Location,
        *,
        tell: Callable[[OrderStage], None] = lambda _: None,
        note: Callable[[str, BaseException], None] = lambda *_: None,
    ) -> None:
        self._documents = documents
        self._challenges = challenges
        self._now = now
        self._location = location
        self._tell = tell
        self._note = note
        self._published: list[str] = []

    def read(self) -> tuple[CertificateRecord, StoredCertificate | None]:
        """Return the record in `certificate.json` and the stored certificate. Changes nothing."""
        return self._state()[0], self._stored()[0]

    def last_directory(self) -> str:
        """Return the ACME directory that issued the present certificate or, if it is gone, the one ordered last.

        The result is "" if no certificate was ever ordered, or if the administrator put the present one there.
        """
        state, stored = self.read()
        return stored.directory if stored else state.directory

    def last_roots(self, directory: str) -> str:
        """Return the root certificates (PEM) last trusted at this directory's HTTPS address; "" for the public ones."""
        state = self.read()[0]
        return state.trusted if state.directory == directory else ""

    def decide(self, wanted: RenewalRequest) -> Decision:
        """Return what `obtain` would decide now."""
        state, stored = self.read()
        return self._decide(state, stored, wanted)

    def obtain(self, wanted: RenewalRequest) -> RenewalOutcome:
        """Order the certificate if it is due, and store it.

        Raises OrderFailed, or an error of the documents or of DNS; then the present certificate stays.
        """
        token = secrets.token_hex(8)
        decision, before, stored = self._decide_and_claim(wanted, token)
        if decision.verdict is not Verdict.ORDER:
            if decision.verdict is Verdict.FRESH and stored:
                self._repair(stored, wanted)
            return RenewalOutcome(decision, stored)
        try:
            self._remove_challenges(wanted.domain, self._state()[0].challenges)  # left by a run that was killed
            issued = self._order(wanted, token)
            self._tell(OrderStage.STORE)
            self._store(issued, before)
        except BaseException as error:
            self._remove_challenges(wanted.domain, self._published)
            self._failed(token, wanted, error)
            raise
        self._remove_challenges(wanted.domain, self._published)
        self._record_result(token, lambda state: rules.succeeded(state, issued.stored, wanted.trusted, self._now()))
        return RenewalOutcome(decision, issued.stored)

    # ---- the state

    def _state(self) -> tuple[CertificateRecord, Document | None]:
        found = self._documents.get(self._location.state)
        if found is None:
            return CertificateRecord(), None
        try:
            return from_json(found.body, CertificateRecord), found
        except ValueError as error:  # someone has edited it; the certificate has the names and the dates
            self._note(f"{self._location.state} cannot be read and is written anew", error)
            return CertificateRecord(), found

    def _write(self, key: str, body: bytes, known: Document | None) -> None:
        if known is None:
            self._documents.create(key, body)
        else:
            self._documents.replace(key, body, known.etag)

    def _change(self, change: Callable[[CertificateRecord], CertificateRecord | None]) -> bool:
        """Apply `change` to the state and write it, again after each conflict; False if `change` returned None."""
        for _ in range(MAX_TRIES):
            state, known = self._state()
            wanted = change(state)
            if wanted is None or wanted == state:
                return wanted is not None
            try:
                self._write(self._location.state, to_json(wanted), known)
            except Conflict:
                continue
            return True
        raise Conflict(self._location.state)

    def _decide_and_claim(
        self, wanted: RenewalRequest, token: str
    ) -> tuple[Decision, Document | None, StoredCertificate | None]:
        """Decide, and claim the order if one is due. Also return the present `privkey.pem` and its certificate."""
        for _ in range(MAX_TRIES):
            state, known = self._state()
            stored, before = self._stored()
            if state.claim == token:  # an earlier try has written it, and its reply was lost
                return Decision(Verdict.ORDER, "claimed"), before, stored
            decision = self._decide(state, stored, wanted)
            if decision.verdict is not Verdict.ORDER:
                return decision, before, stored
            try:
                self._write(self._location.state, to_json(rules.claimed(state, token, self._now())), known)
            except Conflict:
                continue
            return decision, before, stored
        raise Conflict(self._location.state)

    def _decide(self, state: CertificateRecord, stored: StoredCertificate | None, wanted: RenewalRequest) -> Decision:
        names = rules.names_of(wanted.domain)
        return rules.decide(state, stored, wanted.directory, names, now=self._now(), force=wanted.force)

    def _record_result(self, token: str, change: Callable[[CertificateRecord], CertificateRecord]) -> None:
        """Record how our order ended, unless another run has claimed it. If that fails, the next run repairs it."""
        try:
            self._change(lambda state: change(state) if state.claim == token else None)
        except Exception as error:  # noqa: BLE001 - the certificate matters more than its state
            self._note(f"{self._location.state} could not be written", error)

    def _failed(self, token: str, wanted: RenewalRequest, error: BaseException) -> None:
        if not isinstance(error, Exception):  # Ctrl-C is no failure
            self._record_result(token, rules.unclaimed)
            return
        if not isinstance(error, OrderFailed):
            error = OrderFailed(FailureReason.BROKEN, type(error).__name__)
        failure = rules.FailedOrder(self._now(), wanted.directory, error.reason, str(error), error.until)
        self._record_result(token, lambda state: rules.failed(state, failure))

    # ---- the order

    def _order(self, wanted: RenewalRequest, token: str) -> Issued:
        from hippodrome.control.certificates import order  # noqa: PLC0415 - its import is slow

        def publish(values: list[str], seconds: float) -> None:
            if not self._change(lambda state: rules.with_challenges(state, values) if state.claim == token else None):
                raise OrderFailed(FailureReason.OVERTAKEN, "another run is ordering this certificate now")
            self._published = values
            self._challenges.put(order.txt_name(wanted.domain), values, seconds)

        request = order.OrderRequest(
            directory=wanted.directory,
            domain=wanted.domain,
            account=account_key(self._documents, wanted.directory),
            email=wanted.email,
            trusted=wanted.trusted,
            seconds=wanted.seconds,
        )
        return order.order(request, publish, self._tell)

    def _remove_challenges(self, domain: str, values: Sequence[str]) -> None:
        """Remove published values from DNS. If that fails, the next run does it."""
        if not values:
            return
        from hippodrome.control.certificates.order import txt_name  # noqa: PLC0415 - its import is slow

        try:
            self._challenges.remove(txt_name(domain), values)
            self._change(lambda state: rules.without_challenges(state, values))
        except Exception as error:  # noqa: BLE001 - an old TXT record does no harm; a lost certificate would
            self._note("the challenge's TXT record could not be removed", error)

    # ---- the certificate

    def _stored(self) -> tuple[StoredCertificate | None, Document | None]:
        found = self._documents.get(self._location.privkey)
        if found is None:
            return None, None
        from hippodrome.control.certificates.order import read_or_expired, read_stored  # noqa: PLC0415 - its import is slow

        stored = read_stored(found.body)
        if stored is None:  # the administrator put the certificate there
            chain = self._documents.get(self._location.fullchain)
            stored = read_or_expired(chain.body if chain else b"")
        return stored, found

    def _store(self, issued: Issued, before: Document | None) -> None:
        try:
            self._write(self._location.privkey, issued.document, before)
        except Conflict:
            present = self._documents.get(self._location.privkey)
            if present is None or present.body != issued.document:
                raise OrderFailed(
                    FailureReason.OVERTAKEN, "another certificate was stored meanwhile; it stays"
                ) from None
        self._copy_chain()

    def _copy_chain(self) -> None:
        """Copy the chain of `privkey.pem` to `fullchain.pem`."""
        from hippodrome.control.certificates.order import chain_of  # noqa: PLC0415 - its import is slow

        for _ in range(MAX_TRIES):
            known = self._documents.get(self._location.fullchain)  # read first, so that a newer chain conflicts
            source = self._documents.get(self._location.privkey)
            chain = chain_of(source.body) if source else None
            if chain is None or (known and known.body == chain):
                return
            try:
                self._write(self._location.fullchain, chain, known)
            except Conflict:
                continue
            return
        raise Conflict(self._location.fullchain)

    def _repair(self, stored: StoredCertificate, wanted: RenewalRequest) -> None:
        """Finish what a killed run left undone: the chain, the state, the challenges."""
        self._copy_chain()
        state = self._state()[0]
        if state.serial != stored.serial:
            self._change(lambda now: rules.succeeded(now, stored, wanted.trusted, self._now()))
        elif state.claim and state.claimed and self._now() - state.claimed > rules.CLAIM:
            self._remove_challenges(wanted.domain, state.challenges)
            self._change(rules.unclaimed)


def renew(renewal: Renewal, domain: str, seconds: float) -> RenewalOutcome | None:
    """Renew the certificate from its present ACME directory, for the daily timer.

    `seconds` is the time for the whole order. Returns None if no certificate was ever ordered, or if the administrator
    put the present one there.
    """
    directory = renewal.last_directory()
    if not directory:
        return None
    trusted = renewal.last_roots(directory)
    return renewal.obtain(RenewalRequest(domain, directory, trusted=trusted, seconds=seconds))
