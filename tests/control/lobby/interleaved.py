"""Functions of the lobby that run at the same time, one port call after the other, in an order that a test chooses.

The documents behave as S3's do where it matters here: an ETag is a hash of the content (S3 API Reference, "Object"),
LastModified has whole seconds, and a listing shows every write before it.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import greenlet

from hippodrome.control.lobby import decisions
from hippodrome.control.lobby.decisions import LOBBIES, Decisions
from hippodrome.control.lobby.lobby import Lobby
from hippodrome.control.model import ids
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json
from hippodrome.control.ports import Document, Entry, Message, Topic
from hippodrome.control.storage.repository import Repository
from testing.fake_platform import FakeBus, FakeDocuments, FakePlatform
from testing.port_faults import Crash, PortFault, call_with_fault
from tests.control.lobby.waiting_room import pairs, serve

ENDS = (Crash, ConnectionError)
"""The exceptions with which a function may end because the test has injected a fault."""


class S3Documents(FakeDocuments):
    """Documents that let other functions run before each call."""

    world: InterleavedPlatform

    def get(self, key: str, known: Document | None = None) -> Document | None:
        found: Document | None = self.world.call(f"get {key}", lambda: super(S3Documents, self).get(key, known))
        if found is not None and key.startswith(LOBBIES):
            self.world.note(found.body)
        return found

    def create(self, key: str, body: bytes) -> str:
        return self.world.call(f"create {key}", lambda: super(S3Documents, self).create(key, body))

    def replace(self, key: str, body: bytes, etag: str) -> str:
        return self.world.call(f"replace {key}", lambda: super(S3Documents, self).replace(key, body, etag))

    def put(self, key: str, body: bytes) -> None:
        self.world.call(f"put {key}", lambda: super(S3Documents, self).put(key, body))

    def list(self, prefix: str) -> Iterator[Entry]:
        yield from self.world.call(f"list {prefix}", lambda: list(super(S3Documents, self).list(prefix)))

    def delete(self, key: str) -> None:
        self.world.call(f"delete {key}", lambda: super(S3Documents, self).delete(key))

    def _write(self, key: str, body: bytes) -> str:
        etag = f'"{hashlib.md5(body, usedforsecurity=False).hexdigest()}"'
        self.kept[key] = (body, etag, self.world.now().replace(microsecond=0))
        return etag


class S3Bus(FakeBus):
    def __init__(self, world: InterleavedPlatform) -> None:
        super().__init__()
        self.world = world

    def publish(self, topic: Topic, message: Message) -> None:
        self.world.call(f"publish {topic}", lambda: super(S3Bus, self).publish(topic, message))


class InterleavedPlatform(FakePlatform):
    """A platform whose callers wait before each call until the test lets them make it."""

    def __init__(self) -> None:
        super().__init__()
        self.documents = S3Documents(self)
        self.bus = S3Bus(self)
        self.hub = greenlet.getcurrent()
        self.made: list[str] = []  # the calls, in order
        # For each function that runs: the participant whose page sent the request.
        self.askers: dict[greenlet.greenlet, str] = {}
        # The proposals that each participant's requests have read.
        self.read: defaultdict[str, list[decisions.Proposal]] = defaultdict(list)

    def call(self, name: str, effect: Callable[[], Any]) -> Any:
        fault = self.hub.switch() if greenlet.getcurrent() is not self.hub else None
        self.made.append(name)
        return call_with_fault(name, effect, fault)

    def note(self, decisions: bytes) -> None:
        """Note the proposals that the running function has read in the lobby's document."""
        if user := self.askers.get(greenlet.getcurrent()):
            with contextlib.suppress(ValueError):  # a test may have damaged the document
                self.read[user] += from_json(decisions, Decisions).proposed


@dataclass(eq=False)
class Running:
    """A function that runs and waits before its next call."""

    name: str
    thread: greenlet.greenlet
    calls: int = 0
    result: Any = None

    @property
    def is_over(self) -> bool:
        return bool(self.thread.dead)


@dataclass
class Crossing:
    """A lobby whose functions overlap."""

    project: Project = field(default_factory=pairs)
    platform: InterleavedPlatform = field(default_factory=InterleavedPlatform)
    running: list[Running] = field(default_factory=list)

    def begin(self, name: str, act: Callable[[Lobby], Any]) -> Running:
        """Start another function and let it run up to its first call."""
        lobby = Lobby(self.platform, Repository(self.platform.documents))
        made = Running(name, greenlet.getcurrent())

        def run() -> None:
            try:
                made.result = act(lobby)
            except ENDS:
                made.result = None

        made.thread = greenlet.greenlet(run)
        made.thread.switch()
        if not made.is_over:
            self.running.append(made)
        return made

    def advance(self, one: Running, fault: PortFault | None = None) -> None:
        """Let a function make its next call."""
        one.calls += 1
        one.thread.switch(fault)
        if one.is_over:
            self.running.remove(one)

    def finish(self, one: Running, fault: PortFault | None = None, at: int = 0) -> Running:
        """Let a function make all its calls; the fault occurs at the call of this number, counted from 1."""
        while not one.is_over:
            self.advance(one, fault if one.calls + 1 == at else None)
        return one

    def visit(self, user: str) -> Running:
        """Begin a request of the participant's page."""
        one = self.begin(f"visit {user}", lambda lobby: lobby.visit(self.project, user, None, dict))
        self.platform.askers[one.thread] = user
        return one

    def leave(self, user: str) -> Running:
        return self.begin(f"leave {user}", lambda lobby: lobby.leave(self.project, user))

    def forget(self, user: str) -> Running:
        return self.begin(f"forget {user}", lambda lobby: lobby.forget(self.project, user))

    def under_way(self, user: str) -> Running:
        return self.begin(f"under way {user}", lambda lobby: lobby.under_way(self.project, user))

    def repair(self) -> Running:
        return self.begin("repair", lambda lobby: lobby.repair(self.project))

    def serve(self, number: int | None = None) -> Running:
        """Make the server of this session ready; without a number, the servers of all sessions whose start message was sent."""
        begun = sorted(self.ids_in_start_messages())
        for session_id in begun if number is None else begun[number % len(begun) :][:1] if begun else []:
            serve(self.platform, self.project, session_id)
        return self.begin("serve", lambda lobby: None)

    # Documents and messages

    def sessions(self) -> dict[str, Any]:
        """Return the sessions' documents, by id."""
        return {
            key.split("/")[2]: json.loads(found[0])
            for key, found in self.platform.documents.kept.items()
            if key.startswith(f"{self.project.id}/sessions/") and key.endswith("/session.json")
        }

    def membership(self, user: str) -> Any:
        found = self.platform.documents.kept.get(f"{self.project.id}/users/{user}/session.json")
        return json.loads(found[0]) if found else None

    def decisions(self) -> Any:
        found = self.platform.documents.kept.get(f"_lobbies/{self.project.id}.json")
        return json.loads(found[0]) if found else {}

    def ids_in_start_messages(self) -> set[str]:
        """Return the ids of all sessions whose start message was sent."""
        return {m["userId"] for topic, m in self.platform.bus.sent if topic is Topic.START}

    def label(self, user: str) -> str:
        return ids.server_label(self.project.id, user)

    def wrong(self, users: list[str], *, at_rest: bool = False) -> list[str]:
        """Descriptions of all that must never be. `at_rest`: all runs are over, so that all decisions must also be written."""
        said, sessions = [], self.sessions()
        places: dict[str, list[str]] = {}
        for sid, found in sessions.items():
            names = [member["userId"] for member in found["members"]]
            if len(names) > self.project.players or len(set(names)) < len(names):
                said.append("a session has too many members, or one twice")
            if [member["seat"] for member in found["members"]] != list(range(len(names))):
                said.append("seats are not counted from 0")
            labels = {self.label(name) for name in names}
            for name in names:
                places.setdefault(name, []).append(sid)
                read = self.platform.read[name]
                if not any(set(each.labels) == labels for each in read):  # the session may have another server by now
                    said.append("a participant is matched whose page has not asked since the proposal")
        for user in users:
            membership, mine = self.membership(user), places.get(user, [])
            if len(mine) > 1:
                said.append("a participant is in two sessions")
            if membership and membership["session"] not in (mine or [None]):
                said.append("a membership is of a session that does not know it")
            if at_rest and mine and (membership is None or membership["session"] != mine[0]):
                said.append("a session has a member who has no membership of it")
            if (
                at_rest
                and membership
                and membership["session"]
                and membership["session"] not in self.ids_in_start_messages()
            ):
                said.append("a session has no server")
        return said
