"""A lobby on a platform in memory, and participants who ask there: for the tests of this folder."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

from msgspec.structs import replace

from hippodrome.control.lobby import decisions
from hippodrome.control.lobby import entries as folder
from hippodrome.control.lobby.decisions import Decisions
from hippodrome.control.lobby.lobby import Lobby, LobbyState, NoServerYet
from hippodrome.control.model import ids
from hippodrome.control.model.messages import StartServer
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import ServerState, new_attempt
from hippodrome.control.model.server import key as server_key
from hippodrome.control.model.sessions import Membership
from hippodrome.control.ports import Topic
from hippodrome.control.storage.repository import Repository
from hippodrome.protocol.session import SessionDocument
from testing.fake_platform import FakePlatform
from testing.studies import study

POLL = 2.0
"""Seconds between two requests of a page in the lobby."""


def pairs(**changes: Any) -> Project:
    """Return the study of `testing/studies.py` for two players."""
    return study(**{"players": 2, "patience": 60, **changes})


def serve(
    platform: FakePlatform, project: Project, session_id: str, state: ServerState = ServerState.READY, **changes: Any
) -> None:
    """Write the record of a session's server."""
    record = new_attempt(project, session_id, 1, settings=platform.settings, now=platform.now())
    stored = to_json(replace(record, state=state, **changes))
    platform.documents.kept[server_key(record.label)] = (stored, stored.hex(), platform.now())


@dataclass
class WaitingRoom:
    """A lobby, and the answers and groups of the participants who ask there."""

    project: Project = field(default_factory=pairs)
    platform: FakePlatform = field(default_factory=FakePlatform)
    answers: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    groups: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.repository = Repository(self.platform.documents)
        self.lobby = self.function()

    def function(self) -> Lobby:
        """Return the lobby of another running function, whose caches are empty."""
        return Lobby(self.platform, Repository(self.platform.documents))

    def visit(self, user: str, lobby: Lobby | None = None) -> LobbyState | NoServerYet | Membership:
        """Send a request of the participant's page; return its reply."""
        asked = (lobby or self.lobby).visit
        return asked(self.project, user, self.groups.get(user), lambda: self.answers.get(user, {}))

    def poll(self, *users: str, seconds: float = 0) -> dict[str, LobbyState | NoServerYet | Membership]:
        """These pages ask now and every two seconds for so many seconds; the last reply to each."""
        told = {user: self.visit(user) for user in users}
        for _ in range(round(seconds / POLL)):
            self.platform.wait(seconds=POLL)
            told = {user: self.visit(user) for user in users}
        return told

    def membership(self, user: str) -> Membership | None:
        return self.repository.membership(self.project.id, user)

    def session(self, user: str) -> SessionDocument:
        """Return the session in which the participant is."""
        membership = self.membership(user)
        assert membership is not None
        assert membership.session is not None
        found = self.repository.session(self.project.id, membership.session)
        assert found is not None
        return found

    def together(self, *users: str) -> bool:
        """Return whether these participants, and no others, are in one session, each in a seat of their own."""
        found = self.session(users[0])
        seats = {member.user_id: member.seat for member in found.members}
        return set(seats) == set(users) and all(
            (membership := self.membership(user)) is not None
            and replace(membership, waited=None) == Membership(found.id, seats[user], len(users), players=found.players)
            for user in users
        )

    def document(self) -> Decisions:
        found = self.platform.documents.kept.get(decisions.key(self.project.id))
        return from_json(found[0], Decisions) if found else Decisions()

    def entries(self) -> list[str]:
        """Return the names of the entries in the lobby's folder, sorted."""
        prefix = folder.folder(self.project.id)
        return [key.removeprefix(prefix) for key in sorted(self.platform.documents.kept) if key.startswith(prefix)]

    def label(self, user: str) -> str:
        return ids.server_label(self.project.id, user)

    def started(self) -> list[str]:
        """Return the ids in the start messages so far."""
        return [message["userId"] for topic, message in self.platform.bus.sent if topic is Topic.START]

    def stopped(self) -> list[str]:
        return [message["userId"] for topic, message in self.platform.bus.sent if topic is Topic.STOP]

    def stored(self, name: str) -> Any:
        found = self.platform.documents.kept.get(f"{self.project.id}/{name}")
        return json.loads(found[0]) if found else None

    def arrive_at_start(self, *users: str, ready: bool = True) -> None:
        """Do what `start_server` does for their start messages. `ready`: the servers that start are ready at once."""
        for user in users:
            self.lobby.under_way(self.project, StartServer(self.project.id, user).user_id)
        if ready:
            self.serve(*self.started())

    def serve(self, *session_ids: str, state: ServerState = ServerState.READY, **changes: Any) -> None:
        """Set the state of the servers of these sessions."""
        for session_id in session_ids:
            serve(self.platform, self.project, session_id, state, **changes)

    def wait(self, seconds: float) -> None:
        self.platform.clock += timedelta(seconds=seconds)


def waits(told: LobbyState | NoServerYet | Membership) -> LobbyState:
    """Return the reply to a participant who still waits; fails for any other reply."""
    assert isinstance(told, LobbyState), told
    return told
