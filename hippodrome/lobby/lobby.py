"""The lobby of projects whose sessions have several players: it matches participants, and forms their sessions.

A *run* reads the document of decisions (`decisions.py`), lists the folder of those who wait (`entries.py`), decides
(`rules.py`), and writes the document if something changed. Then it carries out what it has decided for good
(`store.py`): the session's document, its server's start message, each member's membership; then it removes the entries,
and marks the decision as done. If it is interrupted, the next request of a member, or the sweep, does all of that
again. Runs are made by each request of a participant at the game step, and by the sweep. If another run has written the
document meanwhile, a run reads it and decides again; mostly nothing is left to do. A request proposes sessions of all
participants who are there, but forms and carries out only that of its own participant.

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

import msgspec

from hippodrome.lobby import entries as folder
from hippodrome.lobby import matchmaking, questions, rules, servers_ahead, traits
from hippodrome.lobby.decisions import Decisions, Formed, Matched, Proposal, Unmatched
from hippodrome.lobby.entries import Entries, Person, Waiting
from hippodrome.lobby.matcher import Matcher
from hippodrome.lobby.run import Run, Servers
from hippodrome.lobby.store import LobbyStore
from hippodrome.log import failure, logger
from hippodrome.model import ids, sessions
from hippodrome.model.matching import field_of
from hippodrome.model.memberships import Membership
from hippodrome.model.messages import StopServer, to_message
from hippodrome.model.project import Project
from hippodrome.model.server import Server
from hippodrome.ports import Platform, Topic
from hippodrome.storage.errors import RetryLater
from hippodrome.storage.repository import Repository
from protocol.answer import UNMATCHED

SEEN_ANEW = timedelta(seconds=1)
"""A participant who was seen since then is not written down again, however often their page asks."""
FORMED_LATE = timedelta(seconds=4)
"""A session that all have confirmed and that was proposed before that is formed by requests of others, too."""
FORMED_AT_ONCE = 10
"""Sessions of others that one request forms."""
DELETED_AT_ONCE = 5
"""Old entries that one request deletes."""
LOOKED_AT = 5
"""Servers of open sessions at which a request looks whose session is the first that waits for one."""
LOOKED_AT_IN_NEED = 50
"""The same, if the session's own server has ended."""
WRITTEN_WITHIN = timedelta(seconds=60)
"""No request that writes a session takes longer (`next_step` ends after 29 seconds; sweeps are minutes apart)."""
NO_RECORD_AFTER = timedelta(minutes=3)
"""If a server that was to start ahead has no record by then, its start message is sent again."""
CLOSED_FOR_GOOD = timedelta(minutes=3)
"""If the server of an open session has been closed for so long, it is not replaced any more."""
Answers = Callable[[], Mapping[str, Any]]


@dataclass(frozen=True, slots=True)
class LobbyState:
    """What a participant who waits is told. `here` counts those who could play together, this participant included."""

    here: int
    seconds: float  # since they came
    proposed: bool  # others are found, and all are asked whether they are still there


@dataclass(frozen=True, slots=True)
class NoServerYet:
    """A participant whose session is formed, and has no server that is ready.

    `session` is the server that was started ahead for it, and `record` that server's: another may be ready sooner.
    """

    session: str
    members: int
    record: Server | None


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
                open_for=self._open_for(project),
            )

        after = self._store.change(project, settle)
        if label in after.labels():  # a message that came late: nothing else removes it
            self._documents.delete(way)
        for each in after.open:
            if each.by == label:
                self._store.start_server(project, each.id)

    # The sweep

    def repair(self, project: Project) -> Collection[str]:
        """Finish what was interrupted, and bring servers that were started ahead to their number.

        Return the ids of all sessions that the lobby lists afterwards. A server of a session that is not among them is
        left over if the session has no document: the caller must have listed servers before this call, and looks for
        the document after it. Raises what reading and writing the document raises; one that cannot be read is made
        anew, empty.
        """
        known, entries = self._store.read(project), self._store.entries(project)
        self._store.delete(entries.outdated)
        if project.asks_match:
            self._matcher.forget(project)
        is_whole = known.renewed is not None and self._platform.now() - known.renewed >= WRITTEN_WITHIN
        if is_whole:
            self._store.finish_sessions(project)
        self._store.carry_out(project, rules.without_done(known, entries.done).for_good(), entries)
        ahead = [*known.open, *(each.waits_for for each in known.formed if each.waits_for)]
        servers = {each.id: self._repository.server_of(project.id, each.id) for each in ahead}
        entries = self._store.entries(project)  # with the marks of what has just been carried out
        confirmed = rules.confirmed(known, entries)
        run = self._run(project, known, entries, confirmed, servers=Servers(servers))
        closed = [each for each in servers.values() if each and each.closed]
        over = [each.user_id for each in closed if each.closed and run.now - each.closed > CLOSED_FOR_GOOD]
        wanted = servers_ahead.sessions_wanted(known, entries, project)
        ended = servers_ahead.surplus(known, wanted, over, run.now, players=project.players, open_for=run.open_for)

        def settle(document: Decisions) -> Decisions:
            if is_whole and document.renewed == known.renewed:
                document = msgspec.structs.replace(document, renewed=None)
            document = servers_ahead.without_open(run.decided(document), ended)
            wanted = servers_ahead.sessions_wanted(document, entries, project)
            return servers_ahead.open_sessions(
                document,
                wanted,
                "",
                run.now,
                ids.new_session_id,
                players=project.players,
                open_for=run.open_for,
            )

        after = self._store.change(project, settle)
        self._store.forget_done(project, after, entries)
        for session_id in sorted(ended - after.session_ids()):
            self._platform.bus.publish(Topic.STOP, to_message(StopServer(project.id, session_id)))
        waits_for = (each.waits_for for each in after.formed if each.waits_for)
        for each in [*after.open, *waits_for]:
            is_new = each.by == "" and each.asked == run.now
            is_lost = each.id in servers and servers[each.id] is None and run.now - each.asked > NO_RECORD_AFTER
            if is_new or is_lost:
                self._store.start_server(project, each.id)
        formed = tuple(each for each in after.for_good().formed if each not in known.formed)
        self._store.carry_out(project, Decisions(formed=formed), entries)
        if ended:
            logger.info("servers that were ahead", extra={"project": project.id, "stopped": len(ended)})
        return after.session_ids()

    # A run

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
            come = partial(_person, me)
            wished = self._matcher.wished(project, me.label, come, known, entries)
        ready = self._ready(known, entries, me.label)
        servers = self._servers(project, known, me.label, ready)
        run = self._run(project, known, entries, ready, servers=servers, wished=wished)
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
            return NoServerYet(formed.id, len(formed.members), servers.records.get(formed.id))
        seconds = folder.seconds_since(own.joined, run.now) if own else 0.0
        here = rules.here(after, entries, project, me.label, run.now)
        is_proposed = after.proposal_of(me.label) is not None or after.is_decided(me.label)
        return LobbyState(here, seconds, is_proposed)

    def _begin_to_wait(
        self, project: Project, known: Decisions, after: Decisions, entries: Entries, servers: Servers
    ) -> None:
        """Sessions are formed that wait for a server: remove the entries of their members.

        If the server that was started ahead has no record, its start message may be lost, and is sent again.
        """
        fresh = [each for each in after.without_server() if known.labels_formed().isdisjoint(each.labels)]
        self._store.delete(key for each in fresh for label in each.labels for key in entries.keys.get(label, ()))
        for each in fresh:
            if servers.records.get(each.id, ...) is None:
                self._store.start_server(project, each.id)

    def _wait_for_server(
        self, project: Project, me: _Asking, known: Decisions, formed: Formed
    ) -> NoServerYet | Membership:
        """The participant's session is formed, and waits for a server. Their entries are gone."""
        now, before = self._platform.now(), known
        servers = self._servers(project, known, me.label, ())
        open_for = self._open_for(project)

        def settle(document: Decisions) -> Decisions:
            nonlocal before
            before = document
            return servers.given(document, now, open_for)

        if settle(known) is known:  # mostly
            return NoServerYet(formed.id, len(formed.members), servers.records.get(formed.id))
        after = self._change(project, known, settle)
        made = self._store.carry_out(project, _due(me.label, known, before, after), Entries())
        if me.label in made:
            return made[me.label]
        formed = after.formed_of(me.label) or formed
        return NoServerYet(formed.id, len(formed.members), servers.records.get(formed.id))

    def _change(self, project: Project, known: Decisions, settle: Callable[[Decisions], Decisions]) -> Decisions:
        """Change the document; `known` if others change it all the time: the next request, in two seconds, decides."""
        try:
            return self._store.change(project, settle)
        except RetryLater:
            logger.info("the lobby's document keeps changing", extra={"project": project.id})
            return known

    def _servers(self, project: Project, known: Decisions, label: str, ready: Sequence[Proposal]) -> Servers:
        """The servers at which this participant's request looks: that of their session, if it has to be ready yet.

        Whose session is the first that waits looks at some of those that no session has, too; whose server has ended,
        at more.
        """
        formed = known.formed_of(label)
        own = formed.waits_for if formed else next((each.ahead for each in ready if label in each.labels), None)
        if own is None:
            return Servers({})
        waiting, now = known.without_server(), self._platform.now()
        is_first = not waiting or waiting[0] is formed
        open_for = self._open_for(project)
        usable = [each.id for each in known.open if each.is_usable(own.players, now, open_for)]
        some = usable[:LOOKED_AT] if is_first else []
        found = self._records(project, [own.id, *some])
        if own.id in found.over:
            others = self._records(project, usable[len(some) : LOOKED_AT_IN_NEED])
            return Servers({**found.records, **others.records})
        return found

    def _records(self, project: Project, session_ids: Sequence[str]) -> Servers:
        acts = [partial(self._server, project, each) for each in session_ids]
        return Servers(dict(zip(session_ids, self._platform.run_all(acts), strict=True)))

    def _server(self, project: Project, session_id: str) -> Server | None:
        """The record of a session's server; None also if it cannot be read, which the next request tries again."""
        try:
            return self._repository.server_of(project.id, session_id)
        except Exception as error:  # noqa: BLE001 - `run_all` takes functions that do not raise
            failure("the record of a server that was started ahead cannot be read", error, project=project.id)
            return None

    def _ready(self, known: Decisions, entries: Entries, label: str) -> list[Proposal]:
        """The confirmed proposals that this participant's request forms: their own, and some that have waited for long.

        So in a crowd that writes faster than the document takes it, a write decides on several sessions.
        """
        now = self._platform.now()
        confirmed = rules.confirmed(known, entries)
        own = [each for each in confirmed if label in each.labels]
        late = [each for each in confirmed if label not in each.labels and now - each.at > FORMED_LATE]
        return [*own, *late[:FORMED_AT_ONCE]]

    def _run(
        self,
        project: Project,
        known: Decisions,
        entries: Entries,
        ready: Sequence[Proposal],
        *,
        servers: Servers,
        wished: Sequence[Sequence[str]] = (),
    ) -> Run:
        """A run that may form these sessions, with what is to be known of them."""
        members, broken = self._checked(project, ready, entries)
        now, open_for = self._platform.now(), self._open_for(project)
        return Run(project, known, entries, members, broken, now, open_for, servers, wished)

    def _be_seen(self, project: Project, me: _Asking, entries: Entries) -> Entries:
        """Write down that the participant is there. At most once a second, however often they ask."""
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
        self._documents.put(present, folder.body(Person(me.user_id, me.group)))
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

    def _checked(
        self, project: Project, ready: Sequence[Proposal], entries: Entries
    ) -> tuple[Mapping[str, Sequence[Matched]], Collection[str]]:
        """The members of each of these sessions that can be formed, and the ids of those that cannot be.

        A session cannot be formed if a member has left, or has a membership: a late request of a second tab may have
        brought them back into the lobby; nor if the project has been registered with another number of players since.
        Two reads for each member.
        """
        waiting = [entries.waiting[label] for each in ready for label in each.labels]
        looked = self._platform.run_all([partial(self._member, project, one) for one in waiting])
        found = {one.label: member for one, member in zip(waiting, looked, strict=True)}
        members, broken = {}, []
        for each in ready:
            known = [found[label] for label in each.labels]
            if any(isinstance(one, Exception) for one in known):
                continue  # the next run looks again
            able = [one for one in known if isinstance(one, Matched)]
            if len(able) == len(known) and each.players in (0, project.players):
                members[each.id] = able
            else:
                broken.append(each.id)
        return members, broken

    def _member(self, project: Project, one: Waiting) -> Matched | Exception | None:
        """The participant who waits, as a member; None if they have left or have a membership. Errors are returned."""
        try:
            found = self._documents.get(folder.waiting_key(project.id, one))
            person = folder.person(found.body) if found else None
            if person is None or ids.server_label(project.id, person.user_id) != one.label:
                return None
            membership = self._repository.membership(project.id, person.user_id)
        except Exception as error:  # noqa: BLE001 - `run_all` takes functions that do not raise
            failure("a participant who waits cannot be read", error, project=project.id)
            return error
        if membership:
            return None
        return Matched(one.label, person.user_id, person.group, folder.seconds_since(one.joined, self._platform.now()))

    def _open_for(self, project: Project) -> timedelta:
        return sessions.open_for(project, self._platform.settings)


def _person(me: _Asking) -> questions.Person:
    """The participant who asks, as the function `match` is told."""
    return questions.person(me.label, me.group, dict(me.answers()))


def _due(label: str, known: Decisions, before: Decisions, after: Decisions) -> Decisions:
    """What this participant's request carries out. `known`: what it read; it has made `after` of `before`.

    What it has decided on them, or what had been decided when it began; and the sessions of others to which it has
    given a server. What another request has decided meanwhile, that one carries out.
    """
    own = after.of(label) if known.is_decided(label) or not before.is_decided(label) else Decisions()
    waited = {each.labels for each in before.without_server()}
    given = [each for each in after.for_good().formed if each.labels in waited and each not in own.formed]
    return Decisions(formed=(*own.formed, *given), unmatched=own.unmatched)
