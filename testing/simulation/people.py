"""Simulated participants: they read, answer, wait, play, come back after a fault, and give up in the end."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlencode

from hippodrome.control.ports import Conflict
from hippodrome.protocol.keys import answer_key
from hippodrome.protocol.session import assignment_key
from testing.port_faults import Crash
from testing.simulation.trials import LINGER, is_lost
from testing.simulation.world import SimulatedWorld

READ, PLAY = 20.0, 60.0  # mean seconds for a page (each takes 0.5 to 1.5 times as many); seconds of the game
MAX_TRIES = 4  # requests of a page that does not come
RETRY = 2.0  # seconds until people try again
PATIENCE = 900.0  # seconds at the waiting page
RELOADS = 75.0  # seconds at the waiting page after which people load it again
POLLS = {
    "first": 1.0,
    "growth": 1.15,
    "longest": 4.0,
    "naming": 1.5,
}  # seconds, as in hippodrome/web/game/; a test compares them


def poll_delay(state: Mapping[str, Any], polls: int) -> float:
    """Return the seconds until the waiting page's next poll, after so many polls, as `pollDelay` of hippodrome/web/game/ does."""
    if state.get("state") in ("failed", "ended"):
        return POLLS["longest"]
    if state.get("state") == "naming":
        return POLLS["naming"]
    return float(min(POLLS["longest"], POLLS["first"] * POLLS["growth"] ** polls))


def retry_delay(tries: int) -> float:
    """Return the seconds until the waiting page repeats a poll without answer, as `pollUntilAnswered` of hippodrome/web/game/ does."""
    return float(min(POLLS["longest"], POLLS["first"] * 2**tries))


@dataclass
class SimulatedVisit:
    """The record of one participant's visit. Times are virtual seconds since the world's beginning."""

    user: str
    arrived: float
    asked: float | None = None  # when they sent the request for which their server is started
    waiting: float | None = None  # when they came to the game
    ready: float | None = None  # when their page first got the address of a server that it reached
    interruptions: int = 0  # servers that were lost while they played
    pages: int = 0  # pages that they requested, without polls
    unanswered: int = 0  # requested pages that did not come at the first try
    finished: float | None = None
    reason: str = ""  # why the study was over for them, if they have not finished


class SimulatedParticipant:
    """One participant with a browser, who goes through the study. Spawn `walk`, since it waits (`GreenletClock.spawn`)."""

    def __init__(
        self, world: SimulatedWorld, number: int, *, read: float = READ, play: float = PLAY, leaves_at: str = ""
    ) -> None:
        self.world, self.clock = world, world.clock
        self.visit = SimulatedVisit(f"p{number:05d}", world.clock.seconds)
        self.answered: list[str] = []  # the steps of which they were told that the answer is stored
        self._read, self._play, self._leaves_at = read, play, leaves_at
        self._first_ask = self._step_before_server()
        world.people += 1
        self._query = urlencode({"projectId": world.project.id, "userId": self.visit.user})

    def walk(self) -> None:
        """Go from the link to the last page, or give up. Spawn it, and only once."""
        try:
            self._walk()
        finally:
            self.world.people -= 1

    def _walk(self) -> None:
        self.visit.arrived = self.clock.seconds
        if self._first_ask is None:
            self.visit.asked = self.clock.seconds
        page = self._ask("GET")
        while page is not None:
            if "state" in page:
                if self._leaves_at == "wait":
                    self.visit.reason = "left by themselves"
                    return
                if not self._game(page):
                    return
                page = self._ask("GET")
                continue
            step = page.get("step")
            if not step:
                self.visit.reason = str(page.get("message") or "the end")
                return
            if step == self.world.project.final.key:
                self.visit.finished = self.clock.seconds
                return
            self.clock.sleep(self.clock.random.uniform(0.5, 1.5) * self._read)
            form = self._filled(page)
            sent = self.clock.seconds
            page = self._ask("POST", urlencode(form))
            if page and page.get("step") not in (step, None):  # None: the study is over, and the answer was refused
                self.answered.append(step)
                if step == self._first_ask:
                    self.visit.asked = sent
        self.visit.reason = self.visit.reason or "no answer from the site"

    def _filled(self, page: Mapping[str, Any]) -> dict[str, str]:
        """Return the fields of the page's form with their answers."""
        return {"hippodrome-step": page["step"], "hippodrome-ticket": page["ticket"], "answer": "yes"}

    def _step_before_server(self) -> str | None:
        """Return the step whose answer starts the server; None if the first request of the link does."""
        keys = [step.key for step in self.world.project.steps]
        at = keys.index(self.world.project.events.start_server_step or keys[0])
        return keys[at - 1] if at else None

    def _ask(self, method: str, body: str = "") -> dict[str, Any] | None:
        """Request a page, and again after `RETRY` seconds if it does not come; None after `MAX_TRIES`."""
        self.visit.pages += 1
        for tries in range(MAX_TRIES):
            if (answer := self._request(method, self._query, body)) is not None:
                return answer
            self.visit.unanswered += not tries
            self.clock.sleep(RETRY)
        return None

    def _poll(self, step: str) -> dict[str, Any] | None:
        """Return the state that a poll of the waiting page gets; None if no answer comes after `MAX_TRIES`."""
        for tries in range(MAX_TRIES):
            if (answer := self._request("GET", self._poll_query(step), "")) is not None:
                return answer
            self.clock.sleep(retry_delay(tries))
        return None

    def _poll_query(self, step: str) -> str:
        """Return the query of the page's poll address."""
        return f"{self._query}&poll={step}"

    def _request(self, method: str, query: str, body: str) -> dict[str, Any] | None:
        self.clock.sleep(self.clock.random.uniform(0.02, 0.2))
        try:
            status, answer = self.world.ask(method, query, body)
        except (Crash, Exception) as error:  # noqa: BLE001 - whatever the error, no page came
            self.world.cloud.log(f"a page failed: {type(error).__name__}")
            return None
        return answer if status < 500 and isinstance(answer, dict) else None

    def _game(self, page: dict[str, Any]) -> bool:
        """Wait and play, and wait again after an interruption. Return False if the study is over for them here."""
        if self.visit.waiting is None:
            self.visit.waiting = self.clock.seconds
        state, since, polls = page, self.clock.seconds, 0
        loaded = self.clock.seconds
        restarts = 0
        while True:
            if state.get("state") == "ready":
                outcome = self._play_on(state)
                if outcome == "done":
                    return True
                if outcome == "lost":
                    self.visit.interruptions += 1
                    since = self.clock.seconds
            elif state.get("state") in ("failed", "ended"):
                if self._is_over():
                    return True
                if state.get("without") and self._goes_on_without(page):
                    return True
                if not state.get("again") or restarts == 2:
                    self.visit.reason = f"{state['state']}: {state.get('reason')}"
                    return False
                restarts += 1
                form = {"hippodrome-step": page["step"], "hippodrome-action": "restart"}
                self._ask("POST", urlencode(form))
            if self.clock.seconds - since > PATIENCE:
                self.visit.reason = f"waited too long: {state.get('state')}"
                return False
            self.clock.sleep(poll_delay(state, polls))
            polls += 1
            state = self._poll(str(page["step"])) or state
            if "page" in state:  # the page was loaded again
                page = dict(state)
            if "state" not in state:
                return True
            if self.clock.seconds - loaded > RELOADS:
                loaded, polls = self.clock.seconds, 0
                fresh = self._ask("GET")
                if fresh and "state" not in fresh:
                    return True
                if fresh:
                    state = page = fresh

    def _goes_on_without(self, page: Mapping[str, Any]) -> bool:
        """Return whether the participant goes on without a game that no server could run."""
        return False

    def _is_over(self) -> bool:
        """Return whether the game is over, after the server has failed or ended.

        It is not over for a participant who plays alone: `_play_on` would have returned `done`.
        """
        return False

    def _connected(self) -> None:
        """Note that their page has reached a server."""
        if self.visit.ready is None:
            self.visit.ready = self.clock.seconds

    def _play_on(self, state: dict[str, Any]) -> str:
        """Connect and play. Return `done`, `lost` if the server was lost before the game was over, or `unreachable`."""
        tasks, task = self.world.platform.tasks, self.world.task_at(state["url"])
        if task is None or state["token"] != task.request.environment["TOKEN"]:
            return "unreachable"
        if task.is_warm_server and tasks.owner(task) != self.visit.user:
            return "unreachable"
        self._connected()
        task.guests += 1
        until = self.clock.seconds + self._play
        while self.clock.seconds < until:
            self.clock.sleep(min(max(1.0, self._play / 60), until - self.clock.seconds))
            if is_lost(task):
                return "lost"
        key = answer_key(self.world.project.id, self.visit.user, str(state["step"]))
        try:
            record = {"step": state["step"], "page": "game", "answers": {"score": 10}, "schema": 1}
            self.world.platform.documents.keep(key, json.dumps(record).encode())
        except Conflict:
            pass
        self.answered.append(str(state["step"]))
        if self._has_another_game():
            return "done"
        arn = task.arn
        self.clock.after(LINGER, lambda: tasks.end(arn, "EssentialContainerExited", "Essential container exited", 0))
        return "done"

    def _has_another_game(self) -> bool:
        """Return whether the server has a further game to run for the participant."""
        documents, project = self.world.platform.documents.kept, self.world.project
        found = documents.get(assignment_key(project.id, self.visit.user))
        games = json.loads(found[0])["games"] if found else ()
        return any(answer_key(project.id, self.visit.user, game) not in documents for game in games)
