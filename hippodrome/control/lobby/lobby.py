"""The lobby of projects whose sessions have several players: it matches participants and forms their sessions.

This module handles participants' requests and start messages. Each request of a participant at the game step makes a
*run*:
1. It reads the document of decisions (`decisions.py`), and lists the entries in the lobby's folder (`entries.py`).
2. It looks up who can be a member, and which servers are ready (`run.py`).
3. It decides (by `rules.py`), and writes the document if something has changed. If another run has written
   the document since step 1, it reads the document and decides again; mostly nothing is left to do.
4. It carries out the decisions that are made for good (`store.py`): it writes the session's document, sends its
   server's start message, and writes each member's membership; then it deletes the entries, and marks the decision as
   done. If this is interrupted, the next request of a member, or the sweep, does all of it again.

The sweep makes runs, too (`repair.py`). A request proposes sessions of all participants who are present. It forms and
carries out its own participant's session, and only a few others (`Lookups.proposals_to_form`).

A session whose server was started ahead waits in the document until a server is ready. The first server that is ready
goes to the session that was formed first. Only then is the session decided for good, and its documents are written.

No participant gets two memberships, for two reasons. A membership is written only for a session that stands in the
document as formed, with its server, and a participant stands in the document at most once. And a session is formed only
if none of its members has a membership, which is looked up while they stand in the document as proposed.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import partial
from typing import Any

from hippodrome.control.lobby import entries as lobby_entries
from hippodrome.control.lobby import matchmaking, questions, rules, servers_ahead
from hippodrome.control.lobby.decisions import Decisions, Formed, Proposal, Unmatched
from hippodrome.control.lobby.entries import Entries, Waiting, WaitingDocument
from hippodrome.control.lobby.matcher import Matcher
from hippodrome.control.lobby.repair import Repair
from hippodrome.control.lobby.run import Lookups, StartedAhead
from hippodrome.control.lobby.store import LobbyStore
from hippodrome.control.log import logger
from hippodrome.control.model import ids, sessions
from hippodrome.control.model.matching import field_of
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server
from hippodrome.control.model.sessions import Membership
from hippodrome.control.ports import Platform, RetryLater
from hippodrome.control.storage.repository import Repository
from hippodrome.protocol.answer import UNMATCHED

SEEN_ANEW = timedelta(seconds=1)
"""A request writes its participant's entry again only if the entry is older than this."""
DELETED_AT_ONCE = 5
"""The most old entries that one request deletes."""
ReadAnswers = Callable[[], Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class LobbyState:
    """The state of the lobby, as the page of a waiting participant shows it."""

    here: int  # participants who could play together, this one included
    seconds: float  # the seconds since the participant came
    proposed: bool  # whether others are found: then the pages of all confirm that they are still open


@dataclass(frozen=True, slots=True)
class NoServerYet:
    """The participant's session is formed, and no server is ready for it yet.

    `session` is its id. `record` is the record of the server that was started ahead under this id. If another server
    that was started ahead is ready sooner, the session gets that server, and the id under which it was started.
    """

    session: str
    members: int
    record: Server | None
    players: int  # empty places included


@dataclass(frozen=True, slots=True)
class _Asker:
    """The participant whose request this is. `answers` reads their answers so far."""

    label: str
    user_id: str
    group: int | None
    answers: ReadAnswers


class Lobby:
    """The lobbies of all projects. Each running function has one `Lobby`."""

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
        self, project: Project, user_id: str, group: int | None, answers: ReadAnswers
    ) -> LobbyState | NoServerYet | Membership:
        """Handle a request of a participant at the game step.

        Returns their membership; until it is decided, the state of the lobby or of their session. The membership may
        say that the participant is unmatched; then the answer of each game step is stored. `answers` reads the
        participant's answers so far, and is called only if `matching` needs them. `project` must have its secret
        (`SecretCache.with_secret`). `docs/architecture.md` counts the AWS calls.
        """
        label = ids.server_label(project.id, user_id)
        membership = self._repository.membership(project.id, user_id)
        if membership is None:
            standing = self._run(project, _Asker(label, user_id, group, answers))
            if not isinstance(standing, Membership):
                return standing
            membership = standing
        if membership.unmatched:
            self._store.answer_as_unmatched(project, user_id)
        return membership

    def leave(self, project: Project, user_id: str) -> None:
        """Note that the participant has closed the page: until their next request, no session with them is proposed.

        A participant who is back within `entries.PRESENT` (a reload, another tab) keeps the time at which they came.
        AWS calls: one listing and some writes.
        """
        label = ids.server_label(project.id, user_id)
        entries = self._store.entries(project, label)
        person = entries.waiting.get(label)
        if person is not None:
            self._documents.put(lobby_entries.departure_key(project.id, label, person.joined), b"")
        if person is not None or label in entries.left:
            self._store.delete(key for key in entries.keys[label] if ".left." not in key)

    def forget(self, project: Project, user_id: str) -> None:
        """Delete the entries of a participant who no longer needs a game. May be repeated.

        AWS calls: one listing, and deletes.
        """
        label = ids.server_label(project.id, user_id)
        self._store.delete(self._store.entries(project, label).keys.get(label, ()))

    def under_way(self, project: Project, user_id: str) -> None:
        """Note that the participant is under way to the game, and start a server ahead if one is needed for them.

        One server is started ahead for every `players` participants who are under way or wait. The call may be
        repeated, or come late: for a participant who has a membership, or has answered all game steps, it does nothing.
        If the server's start message was lost after the document was written, a repetition sends it again.
        """
        if self._repository.membership(project.id, user_id) is not None:
            return
        progress = self._repository.progress(project.id, user_id)
        if progress.has_ended or progress.answered.keys() >= set(project.game_steps):
            return
        label = ids.server_label(project.id, user_id)
        way = lobby_entries.way_key(project.id, label)
        self._documents.put(way, b"")
        entries = self._store.entries(project)
        if label in entries.waiting:
            self._documents.delete(way)
        now = self._platform.now()

        def settle(document: Decisions) -> Decisions:
            if label in document.labels():
                return document
            sessions_ahead = servers_ahead.sessions_wanted(document, entries, project, [label])
            return servers_ahead.open_sessions(
                document,
                sessions_ahead,
                label,
                now,
                ids.new_session_id,
                players=project.players,
                open_for=sessions.open_for(project, self._platform.settings),
            )

        after = self._store.change(project, settle)
        if label in after.labels():  # the message came late, and nothing else removes the participant
            self._documents.delete(way)
        for server in after.open:
            if server.by == label:
                self._store.start_server(project, server.id, server.players)

    def repair(self, project: Project) -> Collection[str]:
        """Finish interrupted runs, and bring the servers that are started ahead to their number; for the sweep.

        Returns the ids of all sessions that the lobby lists afterwards. If a session is not among them and has no
        document, its server is left over. To find such servers, the caller must list the servers before this call, and
        look for the documents after it. If the document of decisions cannot be read, it is replaced by an empty one.
        Raises `RetryLater` and the errors of the documents.
        """
        return self._repair.run(project)

    # A participant's request

    def _run(self, project: Project, me: _Asker) -> LobbyState | NoServerYet | Membership:
        """One run, for a participant without a membership."""
        decisions = self._store.read(project)
        formed = decisions.formed_of(me.label)
        if formed and formed.waits_for:
            return self._wait_for_server(project, me, decisions, formed)
        entries = self._store.entries(project)
        proposal = decisions.proposal_of(me.label)
        if me.label not in decisions.labels() or (proposal and me.label not in entries.waiting):
            entries = self._write_entry(project, me, entries)
        if proposal and me.label not in entries.confirmed.get(proposal.id, ()):
            entries = self._confirm(project, me, proposal, entries)
        chosen: Sequence[Sequence[str]] = ()
        if project.asks_match:
            chosen = self._matcher.chosen(project, me.label, partial(_candidate, me), decisions, entries)
        proposals = self._lookups.proposals_to_form(decisions, entries, me.label)
        servers = self._lookups.servers(project, decisions, me.label, proposals)
        run = self._lookups.run(project, decisions, entries, proposals, servers=servers, chosen=chosen)
        own = entries.waiting.get(me.label)
        before = decisions  # the version of the document that this run changes

        def settle(document: Decisions) -> Decisions:
            nonlocal before
            before = document
            document = run.decided(document)
            if own is None or project.after_patience == "policies":
                return document
            if not matchmaking.patience_is_over(own.joined, project, run.now):
                return document
            code = ids.completion_code(project.secret, me.user_id, UNMATCHED)
            waited = lobby_entries.seconds_since(own.joined, run.now)
            return rules.give_up(document, Unmatched(me.label, me.user_id, run.now, code, waited))

        after = decisions
        # Decisions that are carried out leave the document with the next other change. Alone they need no write.
        if settle(decisions) != rules.without_done(decisions, entries.done):
            after = self._change(project, decisions, settle)
            if after is not decisions:
                self._store.forget_done(project, after, entries)
        self._begin_to_wait(project, decisions, after, entries, servers)
        memberships = self._store.carry_out(project, _due(me.label, decisions, before, after), entries)
        if me.label in memberships:
            return memberships[me.label]
        self._store.delete(entries.outdated[:DELETED_AT_ONCE])
        if formed := after.formed_of(me.label):
            return _no_server_yet(formed, servers)
        seconds = lobby_entries.seconds_since(own.joined, run.now) if own else 0.0
        here = rules.number_here(after, entries, project, me.label, run.now)
        is_proposed = after.proposal_of(me.label) is not None or after.is_decided(me.label)
        return LobbyState(here, seconds, is_proposed)

    def _begin_to_wait(
        self, project: Project, decisions: Decisions, after: Decisions, entries: Entries, servers: StartedAhead
    ) -> None:
        """Delete the entries of members whose sessions were formed by this run and wait for a server.

        If such a server has no record, its start message may be lost, and is sent again.
        """
        fresh = [session for session in after.without_server() if decisions.labels_formed().isdisjoint(session.labels)]
        self._store.delete(key for session in fresh for label in session.labels for key in entries.keys.get(label, ()))
        for each in fresh:
            if servers.records.get(each.id, ...) is None:
                self._store.start_server(project, each.id, each.players)

    def _wait_for_server(
        self, project: Project, me: _Asker, decisions: Decisions, formed: Formed
    ) -> NoServerYet | Membership:
        """One run, for a member of a formed session that waits for a server. The members' entries are deleted."""
        now, before = self._platform.now(), decisions
        servers = self._lookups.servers(project, decisions, me.label, ())
        open_for = sessions.open_for(project, self._platform.settings)

        def settle(document: Decisions) -> Decisions:
            nonlocal before
            before = document
            return servers.given(document, now, open_for)

        if settle(decisions) is decisions:  # the usual case: nothing changes
            return _no_server_yet(formed, servers)
        after = self._change(project, decisions, settle)
        memberships = self._store.carry_out(project, _due(me.label, decisions, before, after), Entries())
        if me.label in memberships:
            return memberships[me.label]
        return _no_server_yet(after.formed_of(me.label) or formed, servers)

    def _change(self, project: Project, decisions: Decisions, settle: Callable[[Decisions], Decisions]) -> Decisions:
        """Change the document; return `decisions` if others change it all the time. The next request then decides."""
        try:
            return self._store.change(project, settle)
        except RetryLater:
            logger.info("the lobby's document keeps changing", extra={"project": project.id})
            return decisions

    def _write_entry(self, project: Project, me: _Asker, entries: Entries) -> Entries:
        """Write the participant's entry, at most once in `SEEN_ANEW`; return `entries` with it."""
        now, waiting, departure = self._platform.now(), entries.waiting.get(me.label), entries.left.get(me.label)
        if waiting is not None and now - waiting.seen < SEEN_ANEW:
            return entries
        if waiting is None:
            is_back = departure is not None and now - departure.at < lobby_entries.PRESENT
            joined = departure.joined if departure is not None and is_back else lobby_entries.milliseconds(now)
            answers = me.answers() if field_of(project.matching) is not None else {}
            waiting = Waiting(me.label, joined, matchmaking.trait(project, me.group, answers), now)
        refreshed = Waiting(waiting.label, waiting.joined, waiting.trait, now)
        own_key = lobby_entries.waiting_key(project.id, refreshed)
        self._documents.put(own_key, lobby_entries.body(WaitingDocument(me.user_id, me.group)))
        others = (key for key in entries.keys.get(me.label, ()) if key != own_key and ".yes." not in key)
        self._store.delete(others)  # entries that say they have left, are under way, or wait on another page
        return entries.with_waiting(refreshed)

    def _confirm(self, project: Project, me: _Asker, proposal: Proposal, entries: Entries) -> Entries:
        """Write the participant's confirmation of the proposal; return the folder's entries, listed again.

        Of two participants who confirm at once, at least one sees both confirmations.
        """
        self._documents.put(lobby_entries.confirmation_key(project.id, me.label, proposal.id), b"")
        own = entries.waiting.get(me.label)
        entries = self._store.entries(project).with_confirmation(proposal.id, me.label)
        return entries.with_waiting(own) if own and me.label not in {*entries.waiting, *entries.left} else entries


def _no_server_yet(formed: Formed, servers: StartedAhead) -> NoServerYet:
    return NoServerYet(formed.id, len(formed.members), servers.records.get(formed.id), formed.players)


def _candidate(me: _Asker) -> questions.Candidate:
    """The participant of this request, as the function `match` gets them."""
    return questions.candidate(me.label, me.group, dict(me.answers()))


def _due(label: str, decisions: Decisions, before: Decisions, after: Decisions) -> Decisions:
    """The decisions that this participant's request carries out.

    The request has read `decisions`, and changed `before` to `after`. It carries out the decision on its own
    participant, and the sessions of others to which it has given a server. If another request has decided on this
    participant since `decisions` was read, that request carries the decision out.
    """
    own = after.decided_for(label) if decisions.is_decided(label) or not before.is_decided(label) else Decisions()
    waited = {session.labels for session in before.without_server()}
    newly_formed = [
        session for session in after.for_good().formed if session.labels in waited and session not in own.formed
    ]
    return Decisions(formed=(*own.formed, *newly_formed), unmatched=own.unmatched)
