"""Sessions: participants who wait in a lobby, their servers, and what must hold for them.

`SessionWorld` is the installation with a study that several participants play together; `always` and `ends_well` are
what `checks.py` has for studies with one participant.
"""

from __future__ import annotations

import itertools
import json
from collections import Counter
from collections.abc import Sequence
from datetime import timedelta
from typing import Any

from hippodrome.control.lobby.decisions import Decisions
from hippodrome.control.lobby.decisions import key as lobby_key
from hippodrome.control.model import ids
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import MAX_ATTEMPTS, Server
from hippodrome.control.model.sessions import Membership
from hippodrome.protocol.keys import answer_key, membership_key, sessions_folder
from hippodrome.protocol.session import SessionDocument, member_token, parse
from testing.port_faults import FaultAt
from testing.studies import study
from testing.tasks import Task
from tests.stateful import checks
from tests.stateful.world import World

USERS = ("alice", "bob", "carol")
TOGETHER = 3  # seconds between two requests of a page in the lobby


def pairs(**changes: Any) -> Project:
    """Return the study, for pairs who wait for each other for a minute."""
    return study(players=2, patience=60, **changes)


def numbered_id() -> str:
    """Replaces `ids.new_session_id`, which is random, so that a repeated run has the same ids."""
    return f"s.{next(SessionWorld.numbers):020x}"


class SessionWorld(World):
    """The installation, and participants who play in pairs."""

    numbers = itertools.count(1)

    def __init__(self, project: Project, users: Sequence[str] = USERS) -> None:
        SessionWorld.numbers = itertools.count(1)
        super().__init__(project, users)
        self.written: dict[str, bytes] = {}  # documents of sessions and of memberships, which never change

    # State

    def documents(self) -> dict[str, bytes]:
        """Return the documents of sessions and of memberships."""
        kept = self.account.kept
        return {key: kept[key][0] for key in kept if key.endswith("/session.json")}

    def sessions(self) -> list[SessionDocument]:
        """Return all sessions that were formed."""
        folder = sessions_folder(self.project.id)
        return [parse(body) for key, body in self.documents().items() if key.startswith(folder)]

    def membership(self, user: str) -> Membership | None:
        """Return the participant's membership, once it is decided."""
        found = self.account.kept.get(membership_key(self.project.id, user))
        return from_json(found[0], Membership) if found else None

    def record_of(self, user: str) -> Server | None:
        """Return the record of the server of their session."""
        membership = self.membership(user)
        session = membership.session if membership else None
        return self.record(ids.server_label(self.project.id, session)) if session else None

    def decisions(self) -> Decisions:
        """Return the lobby's document."""
        found = self.account.kept.get(lobby_key(self.project.id))
        try:
            return from_json(found[0], Decisions) if found else Decisions()
        except ValueError:  # the test has made it unreadable
            return Decisions()

    def session_of(self, task: Task) -> SessionDocument | None:
        """Return the session that plays on the task, if it was formed."""
        told = self.handovers().get(task.name)
        session_id = task.session or (told.user_id if told else "")
        return next((one for one in self.sessions() if one.id == session_id), None)

    def left(self) -> dict[str, list[str]]:
        """Leftovers as for studies of one, and leftovers in lobbies."""
        there = self.decisions()
        decided = [*there.open, *there.proposed, *there.formed, *there.unmatched]
        return {
            **super().left(),
            "lobby": [key for key in self.account.kept if key.startswith("_lobby/")],
            "decisions": [type(one).__name__ for one in decided],
        }

    # Participants

    def poll(self, user: str, fault: FaultAt | None = None) -> dict[str, Any]:
        """The lobby's page asks."""
        game = self.project.game_steps[0]
        return self.ask(user, fault=fault, poll=game, ticket=ids.ticket(self.project.secret, user, game))

    def close_page(self, user: str, fault: FaultAt | None = None) -> None:
        """They close the page at the game."""
        game = self.project.game_steps[0]
        ticket = ids.ticket(self.project.secret, user, game)
        fields = {"hippodrome-step": game, "hippodrome-ticket": ticket, "hippodrome-action": "leave"}
        self.ask(user, "POST", fields, fault)

    def spoil_the_lobby(self) -> None:
        """Make the lobby's document unreadable."""
        self.tell("the lobby's document is spoilt")
        self.calm = False
        self.account.put(lobby_key(self.project.id), b"{")

    def played(self, task: Task, answers: int = 16) -> None:
        """The trial stores its members' answers; with a number, only so many, and then it is lost."""
        session, step = self.session_of(task), self.project.game_steps[0]
        for member in session.members[:answers] if session else ():
            key = answer_key(self.project.id, member.user_id, step)
            if key not in self.account.kept:
                found = {"score": 10, "session": session.id if session else "", "outcome": "finished"}
                self.account.put(
                    key, json.dumps({"step": step, "page": "game", "answers": found, "schema": 1}).encode()
                )
                self.tell(f"{member.user_id} has played")


# After every step


def always(world: SessionWorld) -> None:
    """Cheap; after every step."""
    checks.always(world)
    documents = world.documents()
    for key, body in world.written.items():
        assert documents.get(key) == body, f"a session changed: {key}"
    world.written.update(documents)
    sessions = {session.id: session for session in world.sessions()}
    players = Counter(member.user_id for session in sessions.values() for member in session.members)
    assert all(count == 1 for count in players.values()), f"a participant is in two sessions: {players}"
    for session in sessions.values():
        assert len(session.members) <= world.project.players, f"a session has too many members: {session}"
    for user in world.people:
        membership = world.membership(user)
        if membership and membership.session:
            member = sessions[membership.session].member(user) if membership.session in sessions else None
            assert member is not None, f"{user} has a membership of a session that does not know them"
            assert member.seat == membership.seat
        assert world.record(ids.server_label(world.project.id, user)) is None, f"{user} has a server of their own"


# In the end


def ends_well(world: SessionWorld) -> None:
    """Check that all are matched and play, or see why not, and that nothing is left."""
    for waiting in [*world.functions.waiting]:
        world.functions.go_on(waiting)
    for message in world.queued:
        message.failed = 0
    checks.settle(world)
    world.wait(checks.CACHES)
    always(world)
    walk(world)
    checks.nothing_left(world)
    always(world)
    for user in world.people:
        page = world.ask(user)
        assert checks.is_last_or_true(world, user, page), f"in the end {user} sees {page}"


def walk(world: SessionWorld) -> None:
    """Let all go on to the end at the same time, from any step, as far as possible."""
    until, swept, restarts = world.account.now() + checks.PATIENCE, world.account.now(), Counter[str]()
    there, pages = set(world.people), dict[str, dict[str, Any]]()
    while there and world.account.now() < until:
        for user in sorted(there):
            waits = pages.get(user, {}).get("state") == "lobby" and world.poll(user).get("state") == "lobby"
            pages[user] = page = {"state": "lobby"} if waits else world.ask(user)
            if not go_on(world, user, page, restarts):
                there.discard(user)
        lobby = any(pages[user].get("state") == "lobby" for user in there)
        world.wait(TOGETHER if lobby else 35)
        checks.settle(world)
        if world.account.now() - swept > timedelta(minutes=5):
            world.sweep()
            swept = world.account.now()
    for user, page in pages.items():
        assert checks.is_last_or_true(world, user, page), f"{user} waits for ever: {page}"


def go_on(world: SessionWorld, user: str, page: dict[str, Any], restarts: Counter[str]) -> bool:
    """Do the next thing that this participant can do; whether there is more to do for them."""
    state, step = page.get("state"), page.get("step")
    if state == "ready":
        play(world, user, page)
    elif state in ("ended", "failed"):
        if not page["again"] or restarts[user] == MAX_ATTEMPTS:
            return False
        restarts[user] += 1
        world.restart(user)
    elif state is None:
        if step is None or step == world.project.final.key:
            return False
        world.answer(user, step)
    return True


def play(world: SessionWorld, user: str, page: dict[str, Any]) -> None:
    """Connect and play, if a server answers at that address. The game ends for all when all have connected."""
    for task in checks.running_at(world, str(page["url"])):
        assert page["token"] == member_token(task.request.environment["TOKEN"], user)
        session = world.session_of(task)
        assert session is not None, f"{user} is let in where no session plays"
        assert session.member(user), f"{user} is let in where others play"
        world.played(task)
        world.account.fleet.end(task, "EssentialContainerExited", "done", 0)
