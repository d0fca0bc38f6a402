"""Ordering a certificate and putting it where the servers fetch it: `certificate.py`'s decisions over the ports.

Whoever orders claims it first in `certificate.json`, by compare-and-swap, so two runs never order at once; a claim
whose run was killed lapses after `certificate.CLAIM`. The new key and chain become the certificate by one conditional
write of `privkey.pem`; everything else follows from that document and is put right by the next run, wherever this one
ended.
"""

from __future__ import annotations

import json
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING, Any, Protocol

from hippodrome.certificates import rules
from hippodrome.certificates.rules import (
    ACCOUNT,
    FORMER,
    Decision,
    Due,
    OrderFailed,
    Place,
    Stage,
    State,
    Stored,
    Trouble,
)
from hippodrome.model.records import from_json, to_json
from hippodrome.ports import Conflict, Document, Documents

if TYPE_CHECKING:
    from hippodrome.certificates.order import Issued

ROUNDS = 10  # at a document that others write at the same moment


class Challenges(Protocol):
    """Where TXT records are published."""

    def put(self, name: str, values: Sequence[str], seconds: float) -> None:
        """Make these the values of the TXT record `name`; returns once every name server of the zone has them.

        Raises OrderFailed (DNS, or TIMEOUT after that many seconds), and the library's own errors.
        """

    def remove(self, name: str, values: Sequence[str]) -> None:
        """Remove the record, if these are its values."""


@dataclass(frozen=True)
class Wish:
    """Whose certificate, from where."""

    domain: str
    directory: str
    email: str = ""  # told to the CA, and stored nowhere
    trusted: str = ""
    force: bool = False
    seconds: float = 300.0


@dataclass(frozen=True)
class Outcome:
    """What `obtain` has come to: the decision, and the certificate that is in place now."""

    decision: Decision
    stored: Stored | None

    @property
    def ordered(self) -> bool:
        return self.decision.due is Due.ORDER


class Renewal:
    """Looks after the certificate at one place. `tell` hears of each stage, `note` of what went wrong on the side."""

    def __init__(
        self,
        documents: Documents,
        challenges: Challenges,
        now: Callable[[], datetime],
        place: Place,
        *,
        tell: Callable[[Stage], None] = lambda _: None,
        note: Callable[[str, BaseException], None] = lambda *_: None,
    ) -> None:
        self._documents = documents
        self._challenges = challenges
        self._now = now
        self._place = place
        self._tell = tell
        self._note = note
        self._published: list[str] = []

    def look(self) -> tuple[State, Stored | None]:
        """What is there. Changes nothing."""
        return self._state()[0], self._stored()[0]

    def usual_directory(self) -> str:
        """Where the certificate comes from, or came from; "" if none was ever ordered.

        If there never was one for these names: where the one came from that earlier versions kept.
        """
        state, stored = self.look()
        found = stored.directory if stored else state.directory
        if found or stored or self._place == FORMER:
            return found
        return Renewal(self._documents, self._challenges, self._now, FORMER, note=self._note).usual_directory()

    def usual_roots(self, directory: str) -> str:
        """The roots (PEM) that this directory's own HTTPS was checked with; "" for the public ones."""
        state = self.look()[0]
        if not state.directory and self._place != FORMER:
            state = Renewal(self._documents, self._challenges, self._now, FORMER, note=self._note).look()[0]
        return state.trusted if state.directory == directory else ""

    def decide(self, wish: Wish) -> Decision:
        """What `obtain` would do now."""
        state, stored = self.look()
        return self._decide(state, stored, wish)

    def obtain(self, wish: Wish) -> Outcome:
        """Order if it is time to. Raises OrderFailed and what the ports raise; the certificate in use stays then."""
        token = secrets.token_hex(8)
        decision, before, stored = self._claim(wish, token)
        if decision.due is not Due.ORDER:
            if decision.due is Due.FRESH and stored:
                self._put_right(stored, wish)
            return Outcome(decision, stored)
        try:
            self._tidy(wish.domain, self._state()[0].challenges)  # of a run that was killed
            issued = self._order(wish, token)
            self._tell(Stage.STORE)
            self._store(issued, before)
        except BaseException as error:
            self._tidy(wish.domain, self._published)
            self._failed(token, wish, error)
            raise
        self._tidy(wish.domain, self._published)
        self._end(token, lambda state: rules.succeeded(state, issued.stored, wish.trusted, self._now()))
        return Outcome(decision, issued.stored)

    # ---- the state

    def _state(self) -> tuple[State, Document | None]:
        found = self._documents.get(self._place.state)
        if found is None:
            return State(), None
        try:
            return from_json(found.body, State), found
        except ValueError as error:  # edited by hand; what it said is known to the certificate itself
            self._note(f"{self._place.state} cannot be read and is written anew", error)
            return State(), found

    def _write(self, key: str, body: bytes, known: Document | None) -> None:
        if known is None:
            self._documents.create(key, body)
        else:
            self._documents.replace(key, body, known.etag)

    def _change(self, change: Callable[[State], State | None]) -> bool:
        """Apply `change` to the state, also when others write it; False if it returned None."""
        for _ in range(ROUNDS):
            state, known = self._state()
            wanted = change(state)
            if wanted is None or wanted == state:
                return wanted is not None
            try:
                self._write(self._place.state, to_json(wanted), known)
            except Conflict:
                continue
            return True
        raise Conflict(self._place.state)

    def _claim(self, wish: Wish, token: str) -> tuple[Decision, Document | None, Stored | None]:
        """Decide and, if that is to order, claim it. With it what lay in `privkey.pem` before."""
        for _ in range(ROUNDS):
            state, known = self._state()
            stored, before = self._stored()
            if state.claim == token:  # a write whose answer was lost, and which therefore met itself
                return Decision(Due.ORDER, "claimed"), before, stored
            decision = self._decide(state, stored, wish)
            if decision.due is not Due.ORDER:
                return decision, before, stored
            try:
                self._write(self._place.state, to_json(rules.claimed(state, token, self._now())), known)
            except Conflict:
                continue
            return decision, before, stored
        raise Conflict(self._place.state)

    def _decide(self, state: State, stored: Stored | None, wish: Wish) -> Decision:
        names = rules.names_of(wish.domain)
        return rules.decide(state, stored, wish.directory, names, now=self._now(), force=wish.force)

    def _end(self, token: str, change: Callable[[State], State]) -> None:
        """Write down how our order ended, unless somebody has taken over. If that fails, the next run finds out."""
        try:
            self._change(lambda state: change(state) if state.claim == token else None)
        except Exception as error:  # noqa: BLE001 - what came of the order is more important than its record
            self._note(f"{self._place.state} could not be written", error)

    def _failed(self, token: str, wish: Wish, error: BaseException) -> None:
        if not isinstance(error, Exception):  # Ctrl-C: nobody's failure
            self._end(token, rules.released)
            return
        trouble = error.trouble if isinstance(error, OrderFailed) else Trouble.BROKEN
        text = str(error) if isinstance(error, OrderFailed) else type(error).__name__
        until = error.until if isinstance(error, OrderFailed) else None
        failure = rules.Failure(self._now(), wish.directory, trouble, text, until)
        self._end(token, lambda state: rules.failed(state, failure))

    # ---- the order

    def _order(self, wish: Wish, token: str) -> Issued:
        from hippodrome.certificates import order  # noqa: PLC0415 - see there

        def publish(values: list[str], seconds: float) -> None:
            if not self._change(lambda state: rules.publishing(state, values) if state.claim == token else None):
                raise OrderFailed(Trouble.OVERTAKEN, "another run has taken over")
            self._published = values
            self._challenges.put(order.txt_name(wish.domain), values, seconds)

        request = order.Request(
            directory=wish.directory,
            domain=wish.domain,
            account=self._account(wish.directory),
            email=wish.email,
            trusted=wish.trusted,
            seconds=wish.seconds,
        )
        return order.order(request, publish, self._tell)

    def _account(self, directory: str) -> dict[str, Any]:
        """The key of our account there; a new one is stored before it is used."""
        from hippodrome.certificates.order import new_account_key  # noqa: PLC0415 - see there

        for _ in range(ROUNDS):
            known = self._documents.get(ACCOUNT)
            keys = _read_keys(known.body) if known else {}
            if directory in keys:
                return keys[directory]
            keys[directory] = new_account_key()
            try:
                self._write(ACCOUNT, json.dumps(keys, indent=1).encode(), known)
            except Conflict:
                continue
            return keys[directory]
        raise Conflict(ACCOUNT)

    def _tidy(self, domain: str, values: Sequence[str]) -> None:
        """Remove what was published. If that fails, the next run does it."""
        if not values:
            return
        from hippodrome.certificates.order import txt_name  # noqa: PLC0415 - see there

        try:
            self._challenges.remove(txt_name(domain), values)
            self._change(lambda state: rules.tidied(state, values))
        except Exception as error:  # noqa: BLE001 - an old TXT record does no harm, a lost certificate would
            self._note("the challenge's TXT record could not be removed", error)

    # ---- the certificate

    def _stored(self) -> tuple[Stored | None, Document | None]:
        found = self._documents.get(self._place.privkey)
        if found is None:
            return None, None
        from hippodrome.certificates.order import read_or_expired, read_stored  # noqa: PLC0415 - see there

        stored = read_stored(found.body)
        if stored is None:  # put there by hand
            chain = self._documents.get(self._place.fullchain)
            stored = read_or_expired(chain.body if chain else b"")
        return stored, found

    def _store(self, issued: Issued, before: Document | None) -> None:
        try:
            self._write(self._place.privkey, issued.document, before)
        except Conflict:
            present = self._documents.get(self._place.privkey)
            if present is None or present.body != issued.document:
                raise OrderFailed(Trouble.OVERTAKEN, "another certificate was stored meanwhile; it stays") from None
        self._mirror()

    def _mirror(self) -> None:
        """Make `fullchain.pem` the chain of `privkey.pem`."""
        from hippodrome.certificates.order import chain_of  # noqa: PLC0415 - see there

        for _ in range(ROUNDS):
            known = self._documents.get(
                self._place.fullchain
            )  # first, so that a chain which is newer than the key is a conflict
            source = self._documents.get(self._place.privkey)
            if source is None or (known and known.body == chain_of(source.body)):
                return
            try:
                self._write(self._place.fullchain, chain_of(source.body), known)
            except Conflict:
                continue
            return
        raise Conflict(self._place.fullchain)

    def _put_right(self, stored: Stored, wish: Wish) -> None:
        """What a run that was killed has left undone."""
        self._mirror()
        state = self._state()[0]
        if state.serial != stored.serial:
            self._change(lambda now: rules.succeeded(now, stored, wish.trusted, self._now()))
        elif state.claim and state.claimed and self._now() - state.claimed > rules.CLAIM:
            self._tidy(wish.domain, state.challenges)
            self._change(rules.released)


def renew(renewal: Renewal, domain: str, seconds: float) -> Outcome | None:
    """What the timer does: obtain again what is there, from where it came. None if nothing was ever ordered."""
    directory = renewal.usual_directory()
    if not directory:
        return None
    trusted = renewal.usual_roots(directory)
    return renewal.obtain(Wish(domain, directory, trusted=trusted, seconds=seconds))


def _read_keys(body: bytes) -> dict[str, dict[str, Any]]:
    found = json.loads(body)
    if not isinstance(found, dict):
        raise ValueError(f"{ACCOUNT} is not what it should be")
    return found
