"""A study that is registered again and again with other numbers of players, while participants wait and play.

The events and their order are drawn from a seed: pages are loaded, polled and left; messages come late, twice or not
at all; servers are lost; and half of the functions know a registration only some seconds later.
"""

from __future__ import annotations

import json
import random
import re
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any
from urllib.parse import urlencode, urlsplit

from hippodrome.control.http import Request, Response
from hippodrome.control.model import messages
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import RECORDS, Server, ServerState
from hippodrome.control.participants.journey import Journey
from hippodrome.control.ports import Message, Topic
from hippodrome.control.servers.sweep import Sweep
from hippodrome.control.storage.repository import Repository
from hippodrome.protocol.keys import answer_key, sessions_folder
from testing.aws_events import FORM, JSON, http_event
from testing.servers import Servers
from testing.studies import installed, study
from testing.visitors import hidden
from tests.control.servers.delivery import events

RELOADED_AFTER = timedelta(
    seconds=240
)  # a waiting page is loaded again after this time, as in hippodrome/web/game/main.js
NOT_PLAYED = timedelta(minutes=10)  # a server without players ends by itself after this time
ABSENT = timedelta(minutes=2)  # a game waits for other members for this time


class World:
    """The participants, two instances of each function with their own caches, and the researcher."""

    def __init__(self, seed: int) -> None:
        self.chance = random.Random(seed)
        self.more: dict[str, Any] = {
            "patience": 60,
            "after_patience": self.chance.choice(["unmatched", "policies"]),
            "max_servers": self.chance.choice([None, 2, 4]),
        }
        self.project = self._registration(self.chance.choice([1, 1, 2, 3]))
        self.platform = installed(self.project)
        self.journeys = [Journey(self.platform) for _ in range(2)]
        self.servers = [Servers(self.platform) for _ in range(2)]
        self.repository = Repository(self.platform.documents)
        self.people = [Participant(self, f"p{number}") for number in range(self.chance.randint(2, 5))]
        self.played: dict[str, datetime] = {}  # by owner of a server: when a player was last connected

    def _registration(self, players: int) -> Project:
        trial = {"game": "x", "players": {"abc"[n]: "human" for n in range(players)} if players > 1 else None}
        return study(players=players, trial=trial, **self.more)

    def happens(self, steps: int) -> None:
        """Let so many steps of one to three seconds pass, with all kinds of faults."""
        for _ in range(steps):
            self.platform.wait(seconds=self.chance.choice([1, 2, 3]))
            for one in self.people:
                if self.chance.random() < one.eager:
                    one.act(may_stray=True)
            self._deliver(may_fail=True)
            self._play()
            what = self.chance.random()
            if what < 0.03:
                self._register(self.chance.choice([1, 2, 3]))
            elif what < 0.05:
                self._lose_one()
            elif what < 0.06:
                Sweep(self.platform).run()

    def end(self) -> None:
        """From now on there are no faults. AssertionError if a participant does not get to the end within an hour."""
        for step in range(1_800):
            self.platform.wait(seconds=2)
            for one in self.people:
                one.act()
            self._deliver()
            self._play()
            self._end_unplayed()
            if step % 150 == 149:
                Sweep(self.platform).run()
            if all(one.step == "finalStep" for one in self.people):
                return
        raise AssertionError([(one.user, one.step, one.state) for one in self.people])

    def left_over(self) -> list[str]:
        """Return the servers, tasks and names that are left an hour after the end."""
        for _ in range(12):
            self.platform.wait(minutes=5)
            self._deliver()
            self._end_unplayed()
            Sweep(self.platform).run()
        self._deliver()
        kept = [body for key, (body, _, _) in self.platform.documents.kept.items() if key.startswith(RECORDS)]
        opened = [each.name for each in (from_json(body, Server) for body in kept) if not each.is_closed]
        return [*opened, *(task.name for task in self.platform.tasks.running.values()), *self.platform.dns.records]

    def members(self) -> list[str]:
        """Return the participants in all sessions, once for each session."""
        entries = self.platform.documents.list(sessions_folder("maze"))
        found = [self.repository.session("maze", entry.key.split("/")[2]) for entry in entries]
        return [user for session in found if session for user in session.user_ids]

    def runs_for(self, owner: str) -> int:
        """For how many players the server of this participant or session runs."""
        record = self.repository.server_of("maze", owner)
        task = next(each for each in self.platform.tasks.running.values() if record and each.name == record.name)
        return len(json.loads(task.environment["TRIAL"])["players"] or [owner])

    def plays_alone(self, user: str) -> bool:
        """Return whether the participant has a server of their own, and no membership."""
        record = self.repository.server_of("maze", user)
        has_server = record is not None and record.state is ServerState.READY
        return has_server and self.repository.membership("maze", user) is None

    def has_played(self, user: str) -> bool:
        return answer_key("maze", user, "3") in self.platform.documents.kept

    def _register(self, players: int) -> None:
        if players == 1 < self.project.players:
            return  # `registry.register` refuses it
        self.project = self._registration(players).following(self.project)
        self.platform.documents.keep(MASTER_LIST, to_json(MasterList([self.project])))

    # Servers

    def _deliver(self, *, may_fail: bool = False) -> None:
        bus, timers = self.platform.bus, self.platform.timers
        for name, (at, message) in list(timers.due.items()):
            if at <= self.platform.now():
                timers.cancel(name)
                bus.publish(Topic.STOP, message)
        sent, bus.sent = bus.sent, []
        later, bus.delayed = bus.delayed, []
        self.chance.shuffle(sent)
        for topic, message in sent:
            what = self.chance.random() if may_fail else 1
            if what < 0.5:
                bus.publish(topic, message)  # later, or twice
            if what > 0.1 and not 0.5 < what < 0.53:  # otherwise it is late or lost
                self._handle(topic, message)
        changes = [messages.parse_dns_changed(json.loads(json.dumps(message))) for _, message in later]
        self.chance.choice(self.servers).dns_changed(*filter(None, changes))
        running = [each for each in events(self.platform, "RUNNING") if not may_fail or self.chance.random() < 0.5]
        self.chance.choice(self.servers).tasks_changed(running)

    def _handle(self, topic: Topic, message: Message) -> None:
        body, servers = json.loads(json.dumps(message)), self.chance.choice(self.servers)
        if topic is Topic.START:
            start = messages.parse_start_server(body)
            assert start
            servers.start(start)
        else:
            stop = messages.parse_stop_server(body)
            assert stop
            for again in servers.stop([stop]):
                self.platform.bus.publish(topic, messages.to_message(again))

    def _lose_one(self) -> None:
        running = events(self.platform, "STOPPED", stop_code="SpotInterruption")
        if running:
            lost = self.chance.choice(running)
            del self.platform.tasks.running[lost.task]
            self.chance.choice(self.servers).tasks_changed([lost])

    def _end_unplayed(self) -> None:
        for event in events(self.platform, "STOPPED", stop_code="EssentialContainerExited", exit_code=0):
            stored = self.repository.owner(event.name)
            if stored is None or stored.server.ready is None:
                continue
            owner = stored.server.user_id
            if stored.server.is_of_session and self.repository.session("maze", owner) is None:
                continue  # the server waits for its session
            since = max(stored.server.ready, self.played.get(owner, stored.server.ready))
            if self.platform.now() - since > NOT_PLAYED:
                del self.platform.tasks.running[event.task]
                self.chance.choice(self.servers).tasks_changed([event])

    def _play(self) -> None:
        """The trials: connected participants play, until the game is over for all members."""
        for owner in sorted({one.server for one in self.people if one.server}):
            there = [one for one in self.people if one.server == owner]
            record = self.repository.server_of("maze", owner)
            if record is None or record.state is not ServerState.READY:
                for one in there:
                    one.server = None
                continue
            now = self.played[owner] = self.platform.now()
            session = self.repository.session("maze", owner) if record.is_of_session else None
            users = session.user_ids if session else [owner]
            are_here = len(there) == len(users) or now - min(one.since for one in there) > ABSENT
            if are_here and self.chance.random() < 0.15:
                for user in users:
                    if not self.has_played(user):
                        self.platform.documents.keep(answer_key("maze", user, "3"), b"{}")


class Participant:
    """A participant's browser: the page that it shows, the page's own requests, and the participant's actions."""

    def __init__(self, world: World, user: str) -> None:
        self.world, self.user, self.eager = world, user, world.chance.choice([0.2, 0.6, 0.9])
        self.page = self.step = self.state = ""
        self.data: dict[str, Any] = {}
        self.loaded = self.since = datetime.min
        self.server: str | None = None  # the owner of the server that the page is connected to
        self._pages: list[str] = []
        self._polls: list[str] = []

    def act(self, *, may_stray: bool = False) -> None:
        """Do the next action."""
        stray = self.world.chance.random() if may_stray and self.page else 1
        if stray < 0.03:
            if self.state == "lobby" and stray < 0.02:
                self._send(self.page, **{"hippodrome-action": "leave"})
            self._load()
        elif stray < 0.06:
            self._use_an_old_tab()
        elif not self.page or self.step in ("1", "2", "4"):
            if self.page:
                self._send(self.page, words="x")
            self._load()
        elif self.step == "3" and self.world.has_played(self.user):
            self._load()
        elif self.step == "3" and not self.server:
            self._poll()

    def _load(self) -> None:
        self.server, self.loaded = None, self.world.platform.now()
        self.page = self._request("GET", f"projectId=maze&userId={self.user}")
        found = re.search(r'data-step="(\w+)"', self.page)
        assert found, self.page
        self.step = found[1]
        data = re.search(r'<script type="application/json"[^>]*>(.*?)</script>', self.page, re.DOTALL)
        self.data = json.loads(data[1]) if data else {}
        self.state = self.data.get("state", {}).get("state", "")
        assert self.state != "lobby" or not self.world.plays_alone(self.user), "there is a game of their own"
        self._pages.append(self.page)
        if data:
            self._polls.append(urlsplit(self.data["poll"]).query)

    def _poll(self) -> None:
        """Poll as `hippodrome/web/game/main.js` and `lobby.js` do."""
        told = self._ask(urlsplit(self.data["poll"]).query)
        was, self.state, first = self.state, told["state"], self.data["state"]
        is_over = self.state in ("ended", "failed")
        waits_long = self.state != "lobby" and self.world.platform.now() - self.loaded > RELOADED_AFTER
        if was == "lobby" and told.get("players", self.data["players"]) != self.data["players"]:
            self._load()
        elif is_over and (self.state, told["attempt"]) == (first["state"], first["attempt"]):
            if told["again"]:
                self._send(self.page, **{"hippodrome-action": "restart"})
                self._load()
        elif self.state == "ready":
            self._connect(told)
        elif is_over or self.state == "unmatched" or waits_long:
            self._load()
        else:
            assert was == "lobby" or self.state != "lobby", "the page has left the lobby"

    def _connect(self, told: Mapping[str, Any]) -> None:
        membership = self.world.repository.membership("maze", self.user) if told.get("session") else None
        self.server = membership.session if membership else self.user
        self.since = self.world.platform.now()
        assert told.get("players") == self.data.get("players"), "the page is for another number of players"
        assert self.world.runs_for(self.server) == told.get("players", 1)

    def _use_an_old_tab(self) -> None:
        if self._polls and self.world.chance.random() < 0.5:
            self._ask(self.world.chance.choice(self._polls))
        else:
            action = self.world.chance.choice(["leave", "restart", ""])
            self._send(self.world.chance.choice(self._pages), **{"hippodrome-action": action, "words": "x"})

    def _ask(self, query: str) -> Any:
        return json.loads(self._request("GET", query, accept=JSON))

    def _send(self, page: str, **fields: str) -> None:
        query = f"projectId=maze&userId={self.user}"
        self._request("POST", query, urlencode({**hidden(page), **fields}), content_type=FORM)

    def _request(self, method: str, query: str, body: str | None = None, **headers: str) -> str:
        named = {"accept": "text/html", **{name.replace("_", "-"): value for name, value in headers.items()}}
        journey = self.world.chance.choice(self.world.journeys)
        answer: Response = journey.respond(Request.from_event(http_event(method, query, body, headers=named)))
        assert answer.status in (200, 204, 303), answer
        return answer.body if isinstance(answer.body, str) else answer.body.decode()
