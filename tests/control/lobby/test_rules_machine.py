"""A stateful machine: the rules of the lobby under requests that overlap and crash, over a model of the documents.

Requests here do what `lobby.py` does, in memory, one step at a time: read, list, write their entry or confirm,
compare-and-swap, carry out. As on S3, a version of the document is identified by its bytes alone.
"""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from itertools import combinations, count
from typing import Any

from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule

from hippodrome.control.lobby import decisions, matchmaking, rules, servers_ahead
from hippodrome.control.lobby import entries as folder
from hippodrome.control.lobby.decisions import Decisions, Matched, Proposal, Unmatched
from hippodrome.control.lobby.entries import Entries, Waiting, milliseconds
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import to_json
from hippodrome.control.ports import Entry
from testing.exploration import examples
from tests.control.lobby.waiting_room import pairs

PEOPLE = [f"s{letter * 20}" for letter in "abcde"]
PATIENCE, WAY, OPEN_FOR = 40, timedelta(minutes=30), timedelta(minutes=30)
UNMATCHED = "unmatched"
NONE_LISTED = Entries()
Request = Iterator[None]
people = st.sampled_from(PEOPLE)


@dataclass
class World:
    """The documents, the participants, and checks that run whenever a document is written."""

    project: Project
    traits: dict[str, str]
    now: datetime = datetime(2026, 3, 4, 12, tzinfo=UTC)
    document: Decisions = field(default_factory=Decisions)
    writes: int = 0
    entries: dict[str, datetime] = field(default_factory=dict)
    ready: set[str] = field(default_factory=set)  # servers, by their sessions' ids
    groups: set[tuple[str, ...]] = field(default_factory=set)  # members of all sessions that were formed
    memberships: dict[str, str] = field(default_factory=dict)  # the session's id, or UNMATCHED
    sessions: dict[str, tuple[str, ...]] = field(default_factory=dict)  # members as they were formed first
    has_read: dict[str, set[Proposal]] = field(default_factory=lambda: {label: set() for label in PEOPLE})
    came: dict[str, int] = field(default_factory=dict)  # in ms
    numbers: Iterator[int] = field(default_factory=count)

    def new_id(self) -> str:
        return f"s.{next(self.numbers):020x}"

    def listing(self) -> Entries:
        listed = [Entry(key, modified, 0) for key, modified in sorted(self.entries.items())]
        return folder.read(self.project.id, listed, self.now, WAY)

    def put(self, key: str) -> None:
        self.entries[key] = self.now

    def delete(self, keys: Iterable[str]) -> None:
        for key in keys:
            self.entries.pop(key, None)

    # The document

    def change(self, settle: Callable[[Decisions], Decisions], listed: Entries = NONE_LISTED) -> Iterator[None]:
        """Change the document as a run does that has listed these entries; write it if no other run has."""
        came = {**self.came, **{label: one.joined for label, one in listed.waiting.items()}}
        for _ in range(8):
            before, writes = self.document, self.writes
            after = decisions.next_version(before, settle(before))
            if after == before:
                return
            yield
            if to_json(self.document) == to_json(before):
                assert self.writes == writes, "a later version is overwritten by one who read an earlier one"
                self.write(after, came)
                return

    def write(self, after: Decisions, came: Mapping[str, int]) -> None:
        before, self.document, self.writes = self.document, after, self.writes + 1
        standing = [label for each in after.proposed for label in each.labels]
        standing += [member.label for each in after.formed for member in each.members]
        standing += [each.label for each in after.unmatched]
        assert max(Counter(standing).values(), default=0) < 2, "a participant stands in the document twice"
        ids = [each.id for each in after.open] + [each.session_id for each in after.proposed]
        ids += [each.id for each in after.formed]
        assert len(ids) == len(set(ids)), "a server is for two groups"
        for each in set(after.proposed) - set(before.proposed):
            self.is_fair(each, came)
        for one in set(after.unmatched) - set(before.unmatched):
            assert milliseconds(one.at) >= came[one.label] + PATIENCE * 1000, "unmatched too early"
        for formed in after.formed:
            if formed.waits_for is None:
                assert self.sessions.setdefault(formed.id, formed.labels) == formed.labels, "a session has changed"
            else:
                assert formed.waits_for.id == formed.id, "a session waits for another server than it has"
                assert formed.id not in self.sessions, "a session has the server of another"
        for formed in (each for each in after.formed if each.labels not in self.groups):
            labels = formed.labels
            self.groups.add(labels)
            found = [each for each in before.proposed if set(each.labels) == set(labels)]
            assert [sorted(each.labels) for each in found] == [sorted(labels)], "formed, and not as it was proposed"
            for label in labels:
                assert found[0] in self.has_read[label], "formed with one who has not asked since the proposal"
                assert label not in self.memberships, "formed with one who has a membership"
        in_two = Counter(label for labels in self.groups for label in labels)
        assert max(in_two.values(), default=0) < 2, "a participant is in two sessions"

    def is_fair(self, proposal: Proposal, came: Mapping[str, int]) -> None:
        short = len(proposal.labels) < self.project.players
        assert 0 < len(proposal.labels) <= self.project.players
        assert list(proposal.labels) == sorted(proposal.labels, key=lambda label: (came[label], label))
        assert self.fit(proposal.labels), "proposed, and may not play together"
        over = [came[label] + PATIENCE * 1000 <= milliseconds(proposal.at) for label in proposal.labels]
        if self.project.after_patience == "policies":
            assert any(over) or not short, "a short group before patience is over"
        else:
            assert not any(over), "proposed after the end of patience"
            assert not short, "a short group"

    def fit(self, labels: Sequence[str]) -> bool:
        found = Counter(self.traits[label] for label in labels)
        if self.project.matching == "group":
            return len(found) == 1
        if self.project.matching == "mixed":  # of two groups
            return max(found.values()) <= (self.project.players + 1) // 2
        return max(found.values()) == 1 if isinstance(self.project.matching, dict) else True

    # Functions, as generators that pause before each call

    def visit(self, who: str) -> Request:
        if who in self.memberships:
            return
        yield
        known = self.document
        formed = known.formed_of(who)
        if formed and formed.waits_for:
            yield from self.wait_for_server(who)
            return
        proposal = known.proposal_of(who)
        if proposal:
            self.has_read[who].add(proposal)
        yield
        entries = self.listing()
        if who not in known.labels() or (proposal and who not in entries.waiting):
            yield
            entries = self.be_seen(who, entries)
        if proposal and who not in entries.confirmed.get(proposal.id, ()):
            yield
            self.put(folder.confirmation_key(self.project.id, who, proposal.id))
            yield
            own = entries.waiting.get(who)
            entries = self.listing().with_confirmation(proposal.id, who)
            if own and who not in {*entries.waiting, *entries.left}:
                entries = entries.with_waiting(own)
        formable, broken = [], []
        for each in rules.confirmed(known, entries):
            if who in each.labels:
                yield
                gone = [
                    label for label in each.labels if label in self.memberships or not self.is_written(entries, label)
                ]
                (broken if gone else formable).append(each)
        now, own = self.now, entries.waiting.get(who)

        def settle(document: Decisions) -> Decisions:
            document = rules.without_done(document, entries.done)
            document = rules.without_proposals(document, [each.id for each in broken])
            for each in formable:
                document = rules.form(document, each.id, [Matched(label, label) for label in each.labels], now)
            document = rules.decide(document, entries, self.project, now, self.new_id, open_for=OPEN_FOR, known=known)
            if own is None or self.project.after_patience == "policies":
                return document
            if not matchmaking.patience_is_over(own.joined, self.project, now):
                return document
            return rules.give_up(document, Unmatched(who, who, now))

        yield from self.change(settle, entries)
        after = self.document
        kept = {*(each.id for each in after.formed), *(each.label for each in after.unmatched)}
        if own and milliseconds(now) >= self.came[who] + PATIENCE * 1000 and who not in known.labels():
            assert who in after.labels() or who in self.memberships, "patience is overrun"
        yield
        self.delete(folder.done_key(self.project.id, name) for name in entries.done - kept)
        yield from self.carry_out(after.decided_for(who), entries)

    def wait_for_server(self, who: str) -> Request:
        ready, now = set(self.ready), self.now
        yield
        yield from self.change(
            lambda document: servers_ahead.with_ready_servers(document, ready, (), now, open_for=OPEN_FOR), Entries()
        )
        yield from self.carry_out(self.document.decided_for(who), Entries())

    def is_written(self, entries: Entries, label: str) -> bool:
        return folder.waiting_key(self.project.id, entries.waiting[label]) in self.entries

    def be_seen(self, who: str, entries: Entries) -> Entries:
        found, left = entries.waiting.get(who), entries.left.get(who)
        back = left is not None and self.now - left.at < folder.PRESENT
        joined = found.joined if found else left.joined if left and back else milliseconds(self.now)
        one = Waiting(who, joined, self.traits[who], self.now)
        self.came[who] = joined
        key = folder.waiting_key(self.project.id, one)
        self.put(key)
        self.delete(each for each in entries.keys.get(who, ()) if each != key and ".yes." not in each)
        return entries.with_waiting(one)

    def carry_out(self, decided: Decisions, entries: Entries) -> Iterator[None]:
        made = {member.label: each.id for each in decided.formed for member in each.members}
        made |= {each.label: UNMATCHED for each in decided.unmatched}
        for label, membership in made.items():
            yield
            kept = self.memberships.setdefault(label, membership)  # written once: one of two tabs may give up late
            assert kept == membership or membership == UNMATCHED, "a participant gets another membership"
        for key in [key for label in made for key in entries.keys.get(label, ())]:
            yield
            self.delete([key])
        for name in [*(each.id for each in decided.formed), *(each.label for each in decided.unmatched)]:
            yield
            self.put(folder.done_key(self.project.id, name))

    def leave(self, who: str) -> Request:
        entries = self.listing()
        one = entries.waiting.get(who)
        yield
        if one:
            self.put(folder.departure_key(self.project.id, who, one.joined))
        yield
        if one or who in entries.left:
            self.delete(key for key in entries.keys[who] if ".left." not in key)

    def start_ahead(self, wanted: int, by: str) -> Request:
        now = self.now
        yield from self.change(
            lambda document: servers_ahead.open_sessions(
                document, wanted, by, now, self.new_id, players=self.project.players, open_for=OPEN_FOR
            )
        )


def finish(request: Request) -> None:
    for _ in request:
        pass


class Machine(RuleBasedStateMachine):
    def __init__(self) -> None:
        super().__init__()
        self.running: list[Request] = []

    @initialize(
        players=st.sampled_from([2, 2, 3]),
        then=st.sampled_from(["unmatched", "policies"]),
        matching=st.sampled_from(["arrival", "arrival", "group", "mixed", {"different": "x"}]),
        of=st.lists(st.sampled_from("012"), min_size=5, max_size=5),
    )
    def install(self, players: int, then: str, matching: Any, of: list[str]) -> None:
        project = pairs(players=players, after_patience=then, patience=PATIENCE, matching=matching)
        kinds = {"arrival": ["-"] * 5, "mixed": [min(each, "1") for each in of]}
        traits = kinds.get(matching, of) if isinstance(matching, str) else of
        shown = [each if each == "-" else each * 10 for each in traits]
        self.world = World(project, dict(zip(PEOPLE, shown, strict=True)))

    # Events

    @rule(who=people)
    def ask(self, who: str) -> None:
        self.running.append(self.world.visit(who))

    @rule(who=st.lists(people, min_size=1, max_size=4))
    def ask_in_turn(self, who: list[str]) -> None:
        for one in who:
            self.pass_time(0.5)
            finish(self.world.visit(one))

    @rule(who=people)
    def close(self, who: str) -> None:
        finish(self.world.leave(who))

    @rule(who=people, wanted=st.integers(1, 2))
    def start_ahead(self, who: str, wanted: int) -> None:
        finish(self.world.start_ahead(wanted, who))

    @rule(which=st.integers(0, 7))
    def serve(self, which: int) -> None:
        """A server that was started ahead becomes ready."""
        document = self.world.document
        ids = [each.id for each in document.open] + [each.id for each in document.without_server()]
        if ids:
            self.world.ready.add(ids[which % len(ids)])

    @rule(seconds=st.sampled_from([0.3, 2.0, 6.0, 10.0, 12.0, 35.0]))
    def pass_time(self, seconds: float) -> None:
        self.world.now += timedelta(seconds=seconds)

    @precondition(lambda self: self.running)
    @rule(which=st.integers(0, 7), calls=st.integers(1, 12))
    def go_on(self, which: int, calls: int) -> None:
        for _ in range(calls):
            if self.running:
                self.advance(which % len(self.running))

    @precondition(lambda self: self.running)
    @rule(which=st.integers(0, 7))
    def crash(self, which: int) -> None:
        """The function ends between two of its calls."""
        self.running.pop(which % len(self.running))

    @rule(chance=st.integers(0, 10**6))
    def bustle(self, chance: int) -> None:
        """Some participants ask again and again, each request a few calls at a time, and some close their pages."""
        dice = random.Random(chance)
        some = dice.sample(PEOPLE, dice.choice([2, 3, 4, 5]))
        for _ in range(150):
            if self.running and dice.random() < 0.8:
                which = dice.randrange(len(self.running))
                if dice.random() < 0.02:
                    self.crash(which)
                else:
                    self.advance(which)
            elif dice.random() < 0.06:
                self.close(dice.choice(some))
            elif dice.random() < 0.05:
                self.start_ahead(dice.choice(some), 1)
            elif dice.random() < 0.1:
                self.serve(dice.randrange(8))
            elif len(self.running) < 4:
                self.running.append(self.world.visit(dice.choice(some)))
                self.pass_time(dice.choice([0, 0.2, 0.7, 1.5, 4]))

    @rule(who=st.permutations(PEOPLE), calls=st.integers(2, 5))
    def be_slow(self, who: list[str], calls: int) -> None:
        """A request writes after a proposal has been made and has fallen apart, so that the document has the same content as when it was read."""
        slow, left, other, *_ = who
        self.ask_in_turn([left])
        mine = self.world.visit(slow)
        for _ in range(calls):
            next(mine, None)
        self.ask_in_turn([other])
        self.close(left)
        self.ask_in_turn([other])
        finish(mine)

    @rule(some=st.sets(people, min_size=1))
    def stay(self, some: set[str]) -> None:
        """Only these ask, each second. Within 16 seconds (an old proposal falls apart, and one of theirs is made) all who fit play."""
        self.crash_all()
        for _ in range(16):
            for one in sorted(some):
                finish(self.world.visit(one))
            self.pass_time(1)
        settled = {*self.world.memberships, *self.world.document.labels_formed()}
        left = [one for one in sorted(some) if one not in settled]
        fit = [each for each in combinations(left, self.world.project.players) if self.world.fit(each)]
        assert fit == [], "they fit, ask, and wait"

    def crash_all(self) -> None:
        self.running.clear()

    def advance(self, which: int) -> None:
        if next(self.running[which], self) is self:
            self.running.pop(which)

    # Invariants

    @invariant()
    def memberships_are_those_of_sessions(self) -> None:
        if not hasattr(self, "world"):
            return
        for label, membership in self.world.memberships.items():
            assert membership == UNMATCHED or label in self.world.sessions[membership]

    def teardown(self) -> None:
        if not hasattr(self, "world"):
            return
        self.crash_all()
        for _ in range(PATIENCE + 20):
            for which in range(8):
                self.serve(which)
            for who in PEOPLE:
                finish(self.world.visit(who))
            self.pass_time(1)
        assert self.world.memberships.keys() == set(PEOPLE), "a participant who asks waits for ever"
        self.memberships_are_those_of_sessions()


Machine.TestCase.settings = settings(max_examples=examples(120), stateful_step_count=15)
TestRules = Machine.TestCase
