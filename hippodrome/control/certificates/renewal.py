"""Orders a certificate if `rules.py` decides so, and stores it where the servers read it.

A run first claims the order in `certificate.json`, by compare-and-swap, so two runs never order at the same time. If a
run is killed, its claim expires after `rules.CLAIM`; its TXT record stays until the next order replaces it, or until
`hippodrome destroy`. One conditional write of `privkey.pem` replaces the certificate. All other documents are derived
from `privkey.pem`; if a run is interrupted, the next run repairs them.
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
    RenewalRequest,
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

    def read(self) -> tuple[CertificateRecord, StoredCertificate | None]:
        """Return the record in `certificate.json` and the stored certificate. Changes nothing."""
        return self._state(), self._stored()[0]

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
        return self._decide(*self.read(), wanted)

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
            issued = self._order(wanted, token)
            self._tell(OrderStage.STORE)
            self._store(issued, before)
        except BaseException as error:
            self._failed(token, wanted, error)
            raise
        self._record_result(token, lambda _: rules.succeeded(issued.stored, wanted.trusted, self._now()))
        return RenewalOutcome(decision, issued.stored)

    # ---- the state

    def _state(self) -> CertificateRecord:
        return self._parsed(self._documents.get(self._location.state))

    def _parsed(self, found: Document | None) -> CertificateRecord:
        try:
            return from_json(found.body, CertificateRecord) if found else CertificateRecord()
        except ValueError as error:  # someone has edited it; the certificate has the names and the dates
            self._note(f"{self._location.state} cannot be read and is written anew", error)
            return CertificateRecord()

    def _change(self, change: Callable[[CertificateRecord], CertificateRecord]) -> None:
        """Apply `change` to the state, and write it unless it is equal."""

        def content(known: Document | None) -> bytes | None:
            state = self._parsed(known)
            wanted = change(state)
            return None if wanted == state else to_json(wanted)

        self._swap(self._location.state, content)

    def _swap(self, key: str, content: Callable[[Document | None], bytes | None]) -> None:
        """Write what `content` makes of the present document (None: nothing), again after each conflict."""
        for _ in range(MAX_TRIES):
            known = self._documents.get(key)
            body = content(known)
            if body is None:
                return
            try:
                self._write(key, body, known)
            except Conflict:
                continue
            return
        raise Conflict(key)

    def _write(self, key: str, body: bytes, known: Document | None) -> None:
        if known is None:
            self._documents.create(key, body)
        else:
            self._documents.replace(key, body, known.etag)

    def _decide_and_claim(
        self, wanted: RenewalRequest, token: str
    ) -> tuple[Decision, Document | None, StoredCertificate | None]:
        """Decide, and claim the order if one is due. Also return the present `privkey.pem` and its certificate."""
        result: tuple[Decision, Document | None, StoredCertificate | None]

        def claim(state: CertificateRecord) -> CertificateRecord:
            nonlocal result
            stored, before = self._stored()
            if state.claim == token:  # an earlier try has written it, and its reply was lost
                result = Decision(Verdict.ORDER, "claimed"), before, stored
                return state
            result = self._decide(state, stored, wanted), before, stored
            return rules.claimed(state, token, self._now()) if result[0].verdict is Verdict.ORDER else state

        self._change(claim)
        return result

    def _decide(self, state: CertificateRecord, stored: StoredCertificate | None, wanted: RenewalRequest) -> Decision:
        names = rules.names_of(wanted.domain)
        return rules.decide(state, stored, wanted.directory, names, now=self._now(), force=wanted.force)

    def _record_result(self, token: str, change: Callable[[CertificateRecord], CertificateRecord]) -> None:
        """Record how our order ended, unless another run has claimed it. If that fails, the next run repairs it."""
        try:
            self._change(lambda state: change(state) if state.claim == token else state)
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
        from hippodrome.control.certificates.order import order  # noqa: PLC0415 - its import is slow

        name, published = rules.proof_name(wanted.domain), list[str]()

        def publish(values: list[str], seconds: float) -> None:
            if self._state().claim != token:
                raise OrderFailed(FailureReason.OVERTAKEN, "another run is ordering this certificate now")
            published.extend(values)
            self._challenges.put(name, values, seconds)

        try:
            return order(wanted, account_key(self._documents, wanted.directory), publish, self._tell)
        finally:
            if published:
                self._remove_proof(name, published)

    def _remove_proof(self, name: str, values: Sequence[str]) -> None:
        try:
            self._challenges.remove(name, values)
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
        """Copy the chain of `privkey.pem`, which is read last, to `fullchain.pem`, so that a newer chain conflicts."""

        def content(known: Document | None) -> bytes | None:
            source = self._documents.get(self._location.privkey)
            chain = rules.chain_of(source.body) if source else None
            return None if known and known.body == chain else chain

        self._swap(self._location.fullchain, content)

    def _repair(self, stored: StoredCertificate, wanted: RenewalRequest) -> None:
        """Finish what a killed run left undone: the chain, and the state."""
        self._copy_chain()
        state = self._state()
        if state.serial != stored.serial:
            self._change(lambda _: rules.succeeded(stored, wanted.trusted, self._now()))
        elif state.claim and state.claimed and self._now() - state.claimed > rules.CLAIM:
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
