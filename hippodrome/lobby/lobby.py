"""The lobby of projects whose sessions have several players: it matches participants, and forms their sessions.

This module does what a participant's request or start message does. Each request of a participant at the game step
makes a *run*:
1. It reads the document of decisions (`decisions.py`), and lists the folder of those who wait (`entries.py`).
2. It looks up who can be a member, and which servers are ready (`lookups.py`).
3. It decides (`rules.py`, by `run.py`), and writes the document if something has changed. If another run has written
   the document meanwhile, it reads it and decides again; mostly nothing is left to do.
4. It carries out what is decided for good (`store.py`): it writes the session's document, sends its server's start
   message, and writes each member's membership; then it removes the entries, and marks the decision as done. If this is
   interrupted, the next request of a member, or the sweep, does all of it again.

The sweep makes runs, too (`repair.py`). A request proposes sessions of all participants who are there, but it forms
and carries out that of its own participant, and only a few others (`Lookups.proposals_to_form`).

A session whose server was started ahead waits in the document until a server is ready: the first that is goes to the
session that was formed first. Only then it is decided for good, and its documents are written.

A membership is written only for what stands in the document as formed, with its server, and a participant stands there
at most once. A session is formed only if no member has one, which is looked up while they stand there as proposed. So
no participant gets two.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from typing import Any

from hippodrome.lobby import entries as folder
from hippodrome.lobby import matchmaking, questions, rules, servers_ahead, traits
from hippodrome.lobby.decisions import Decisions, Formed, Proposal, Unmatched
from hippodrome.lobby.entries import Entries, Waiting, WaitingDocument
from hippodrome.lobby.lookups import Lookups
from hippodrome.lobby.matcher import Matcher
from hippodrome.lobby.repair import Repair
from hippodrome.lobby.run import StartedAhead
from hippodrome.lobby.store import LobbyStore
from hippodrome.log import logger
from hippodrome.model import ids
from hippodrome.model.matching import field_of
from hippodrome.model.memberships import Membership
from hippodrome.model.project import Project
from hippodrome.model.server import Server
from hippodrome.ports import Platform
from hippodrome.storage.errors import RetryLater
from hippodrome.storage.repository import Repository
from protocol.answer import UNMATCHED

SEEN_ANEW = timedelta(seconds=1)
"""The entry of a participant who waits is written anew only if it is older, however often their page asks."""
DELETED_AT_ONCE = 5
"""Old entries that one request deletes."""
Answers = Callable[[], Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class LobbyState:
    """What a participant who waits is told. `here` counts those who could play together, this participant included."""

    here: int
    seconds: float  # since they came
    proposed: bool  # others are found, and all are asked whether they are still there


@dataclass(frozen=True, slots=True)
class NoServerYet:
    """A participant whose session is formed, and which still has no server that is ready.

    `session` is the id of the server that was started ahead for it, and `record` that server's record. The session may
    get another server that was started ahead, if that is ready sooner.
    """

    session: str
    members: int
    record: Server | None
    players: int  # with the places that nobody has; 0 in documents of earlier versions


@dataclass(frozen=True, slots=True)
class _Asking:
    """A participant who asks."""

    label: str
    user_id: str
    group: int | None
    answers: Answers


class Lobby:
    """The lobbies of all projects. One per running function."""

    def __init__(self, platform: Platform, repository: Repository) -> None:
        self._platform = platform
        self._documents = platform.documents
        self._repository = repository
        self._store = LobbyStore(platform, repository)
        self._matcher = Matcher(platform)
        self._lookups = Lookups(platform, repository)
        self._repair = Repair(platform, repository, self._store, self._matcher, self._lookups)

    # Participants

    def visit(
        self, project: Project, user_id: str, group: int | None, answers: Answers
    ) -> LobbyState | NoServerYet | Membership:
        """The participant asks at the game step. Return their membership, or what they are told while they wait.

        The membership also says that they are unmatched: then all game steps have their answers. `answers` reads the
        participant's answers so far; it is called when they come, if `matching` goes by them. The project must have its
        secret. Calls: `docs/architecture.md`.
        """
        label = ids.server_label(project.id, user_id)
        membership = self._repository.membership(project.id, user_id)
        if membership is None:
            found = self._ask(project, _Asking(label, user_id, group, answers))
            if not isinstance(found, Membership):
                return found
            membership = found
        if membership.unmatched:
            self._store.answer_as_unmatched(project, user_id)
        return membership

    def leave(self, project: Project, user_id: str) -> None:
        """The participant has closed the page: they are not proposed until they ask again. A listing and some writes.

        Whoever is back within `entries.PRESENT` (a reload, another tab) keeps the time at which they came.
        """
        label = ids.server_label(project.id, user_id)
        found = self._store.entries(project, label)
        one = found.waiting.get(label)
        if one is not None:
            self._documents.put(folder.departure_key(project.id, label, one.joined), b"")
        if one is not None or label in found.left:
            self._store.delete(key for key in found.keys[label] if ".left." not in key)

    def forget(self, project: Project, user_id: str) -> None:
        """Remove what the lobby knows of a participant who no longer needs a game. May be repeated. A listing."""
        label = ids.server_label(project.id, user_id)
        self._store.delete(self._store.entries(project, label).keys.get(label, ()))

    def under_way(self, project: Project, user_id: str) -> None:
        """Note that the participant is on their way to the game, and see to it that a server is started for them.

        May be repeated, and may come late: a participant who has a membership, or has answered all game steps, is not
        under way. One server is started ahead for every `players` who are under way or wait. If the start message was
        lost after the document was written, a repetition sends it again.
        """
        if self._repository.membership(project.id, user_id) is not None:
            return
        if self._repository.progress(project.id, user_id).answered.keys() >= set(project.game_steps):
            return
        label = ids.server_label(project.id, user_id)
        way = folder.way_key(project.id, label)
        self._documents.put(way, b"")
        entries = self._store.entries(project)
        if label in entries.waiting:
            self._documents.delete(way)
        now = self._platform.now()

        def settle(document: Decisions) -> Decisions:
            if label in document.labels():
                return document
            wanted = servers_ahead.sessions_wanted(document, entries, project, [label])
            return servers_ahead.open_sessions(
                document,
                wanted,
                label,
                now,
                ids.new_session_id,
                players=project.players,
                open_for=self._lookups.open_for(project),
            )

        after = self._store.change(project, settle)
        if label in after.labels():  # a message that came late: nothing else removes it
            self._documents.delete(way)
        for each in after.open:
            if each.by == label:
                self._store.start_server(project, each.id, each.players)

    def repair(self, project: Project) -> Collection[str]:
        """Finish what was interrupted, and bring servers that were started ahead to their number; for the sweep.

        Return the ids of all sessions that the lobby lists afterwards. A server of a session that is not among them is
        left over if the session has no document: the caller must have listed servers before this call, and looks for
        the document after it. Raises what reading and writing the document raises; one that cannot be read is made
        anew, empty.
        """
        return self._repair.run(project)

    # A participant's request

    def _ask(self, project: Project, me: _Asking) -> LobbyState | NoServerYet | Membership:
        known = self._store.read(project)
        formed = known.formed_of(me.label)
        if formed and formed.waits_for:
            return self._wait_for_server(project, me, known, formed)
        entries = self._store.entries(project)
        proposal = known.proposal_of(me.label)
        if me.label not in known.labels() or (proposal and me.label not in entries.waiting):
            entries = self._be_seen(project, me, entries)
        if proposal and me.label not in entries.confirmed.get(proposal.id, ()):
            entries = self._confirm(project, me, proposal, entries)
        wished: Sequence[Sequence[str]] = ()
        if project.asks_match:
            come = partial(_candidate, me)
            wished = self._matcher.wished(project, me.label, come, known, entries)
        proposals = self._lookups.proposals_to_form(known, entries, me.label)
        servers = self._lookups.servers(project, known, me.label, proposals)
        run = self._lookups.run(project, known, entries, proposals, servers=servers, wished=wished)
        own = entries.waiting.get(me.label)
        before = known  # the document that this run has changed

        def settle(document: Decisions) -> Decisions:
            nonlocal before
            before = document
            document = run.decided(document)
            if own is None or project.after_patience == "policies":
                return document
            if not matchmaking.patience_is_over(own.joined, project, run.now):
                return document
            code = ids.completion_code(project.secret, me.user_id, UNMATCHED)
            waited = folder.seconds_since(own.joined, run.now)
            return rules.give_up(document, Unmatched(me.label, me.user_id, run.now, code, waited))

        after = known
        if settle(known) != rules.without_done(known, entries.done):  # what is done leaves with the next other change
            after = self._change(project, known, settle)
            if after is not known:
                self._store.forget_done(project, after, entries)
        self._begin_to_wait(project, known, after, entries, servers)
        made = self._store.carry_out(project, _due(me.label, known, before, after), entries)
        if me.label in made:
            return made[me.label]
        self._store.delete(entries.outdated[:DELETED_AT_ONCE])
        if formed := after.formed_of(me.label):
            return NoServerYet(formed.id, len(formed.members), servers.records.get(formed.id), formed.players)
        seconds = folder.seconds_since(own.joined, run.now) if own else 0.0
        here = rules.here(after, entries, project, me.label, run.now)
        is_proposed = after.proposal_of(me.label) is not None or after.is_decided(me.label)
        return LobbyState(here, seconds, is_proposed)

    def _begin_to_wait(
        self, project: Project, known: Decisions, after: Decisions, entries: Entries, servers: StartedAhead
    ) -> None:
        """Sessions are formed that wait for a server: remove the entries of their members.

        If the server that was started ahead has no record, its start message may be lost, and is sent again.
        """
        fresh = [each for each in after.without_server() if known.labels_formed().isdisjoint(each.labels)]
        self._store.delete(key for each in fresh for label in each.labels for key in entries.keys.get(label, ()))
        for each in fresh:
            if servers.records.get(each.id, ...) is None:
                self._store.start_server(project, each.id, each.players)

    def _wait_for_server(
        self, project: Project, me: _Asking, known: Decisions, formed: Formed
    ) -> NoServerYet | Membership:
        """The participant's session is formed, and waits for a server. Their entries are gone."""
        now, before = self._platform.now(), known
        servers = self._lookups.servers(project, known, me.label, ())
        open_for = self._lookups.open_for(project)

        def settle(document: Decisions) -> Decisions:
            nonlocal before
            before = document
            return servers.given(document, now, open_for)

        if settle(known) is known:  # mostly
            return NoServerYet(formed.id, len(formed.members), servers.records.get(formed.id), formed.players)
        after = self._change(project, known, settle)
        made = self._store.carry_out(project, _due(me.label, known, before, after), Entries())
        if me.label in made:
            return made[me.label]
        formed = after.formed_of(me.label) or formed
        return NoServerYet(formed.id, len(formed.members), servers.records.get(formed.id), formed.players)

    def _change(self, project: Project, known: Decisions, settle: Callable[[Decisions], Decisions]) -> Decisions:
        """Change the document; `known` if others change it all the time: the next request, in two seconds, decides."""
        try:
            return self._store.change(project, settle)
        except RetryLater:
            logger.info("the lobby's document keeps changing", extra={"project": project.id})
            return known

    def _be_seen(self, project: Project, me: _Asking, entries: Entries) -> Entries:
        """Write down that the participant is there, at most once in `SEEN_ANEW`."""
        now, found, left = self._platform.now(), entries.waiting.get(me.label), entries.left.get(me.label)
        if found is not None and now - found.seen < SEEN_ANEW:
            return entries
        if found is None:
            back = left is not None and now - left.at < folder.PRESENT
            joined = left.joined if left is not None and back else folder.milliseconds(now)
            answers = me.answers() if field_of(project.matching) is not None else {}
            found = Waiting(me.label, joined, traits.trait(project, me.group, answers), now)
        one = Waiting(found.label, found.joined, found.trait, now)
        present = folder.waiting_key(project.id, one)
        self._documents.put(present, folder.body(WaitingDocument(me.user_id, me.group)))
        others = (key for key in entries.keys.get(me.label, ()) if key != present and ".yes." not in key)
        self._store.delete(others)  # that they had left, were under way, or opened two pages at once
        return entries.with_waiting(one)

    def _confirm(self, project: Project, me: _Asking, proposal: Proposal, entries: Entries) -> Entries:
        """Write down that the participant has asked since the proposal could be read.

        The folder is listed again: of two who confirm at once, at least one sees both.
        """
        self._documents.put(folder.confirmation_key(project.id, me.label, proposal.id), b"")
        own = entries.waiting.get(me.label)
        entries = self._store.entries(project).with_confirmation(proposal.id, me.label)
        return entries.with_waiting(own) if own and me.label not in {*entries.waiting, *entries.left} else entries


def _candidate(me: _Asking) -> questions.Candidate:
    """The participant who asks, as the function `match` is told."""
    return questions.candidate(me.label, me.group, dict(me.answers()))


def _due(label: str, known: Decisions, before: Decisions, after: Decisions) -> Decisions:
    """What this participant's request carries out. It has read `known` and has changed `before` to `after`.

    It carries out what is decided on its own participant, and the sessions of others to which it has given a server. If
    another request has decided on its participant since it read `known`, that request carries this out.
    """
    own = after.of(label) if known.is_decided(label) or not before.is_decided(label) else Decisions()
    waited = {each.labels for each in before.without_server()}
    given = [each for each in after.for_good().formed if each.labels in waited and each not in own.formed]
    return Decisions(formed=(*own.formed, *given), unmatched=own.unmatched)
