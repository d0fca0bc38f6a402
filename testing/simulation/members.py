"""Simulated participants who play together: they wait in the lobby, close tabs, reload, come back, lose the network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any
from urllib.parse import urlencode

from hippodrome.control.model import ids
from testing.simulation.people import SimulatedParticipant
from testing.simulation.trials import SimTrial, is_lost
from testing.simulation.world import SECRET, SimulatedWorld

POLL, PROPOSED_POLL = 2.0, 0.5  # seconds between two polls of the lobby's page, as in hippodrome/web/game/
GIVES_UP = 3900.0  # seconds in the lobby: `patience` is an hour at most


@dataclass(frozen=True)
class Habits:
    """The behaviour of one member in the lobby and in the game. Times are seconds since they came there."""

    leaves: float | None = None  # the seconds after which they close the page of the lobby
    beacon: float | None = 0.1  # seconds from leaving until the page's beacon is sent; None: never
    back: float | None = None  # seconds from leaving until they open the link again; None: never. 0 is a reload
    offline: tuple[float, float] | None = None  # when they lose the network in the lobby, and for how long
    tabs: int = 1
    drops: tuple[float, float] | None = None  # when they lose the connection to the game, and for how long
    quits: float | None = None  # the seconds after which they close the page of the game for good


class Quit(Exception):
    """The member has closed the page of the game for good."""


class SimulatedMember(SimulatedParticipant):
    """One participant's way through a study whose sessions have several players."""

    def __init__(self, world: SimulatedWorld, number: int, *, habits: Habits | None = None, **person: Any) -> None:
        super().__init__(world, number, **person)
        self.habits = habits or Habits()
        self.asked_at: list[datetime] = []  # when they sent each request that is no beacon
        self.lobby: float | None = None  # the second at which they came to the lobby
        self.matched: float | None = None  # the second at which their page first left the state `lobby`
        self.first_picture: float | None = None  # the second at which they saw the first picture
        self.polls = 0  # polls of the lobby's page
        self._left = False
        self._dropped = False

    def _walk(self) -> None:
        try:
            super()._walk()
        except Quit:
            self.visit.reason = "left by themselves"

    def _request(self, method: str, query: str, body: str) -> dict[str, Any] | None:
        self.asked_at.append(self.clock.now())
        return super()._request(method, query, body)

    def _game(self, page: dict[str, Any]) -> bool:
        while page.get("state") == "lobby":
            found = self._wait_in_lobby(page)
            if found is None:
                return False
            page = found
        if self.lobby is not None and self.matched is None:
            self.matched = self.clock.seconds
        return super()._game(page) if "state" in page else True

    def _wait_in_lobby(self, page: Mapping[str, Any]) -> dict[str, Any] | None:
        """Wait in the lobby, and return the page that follows it; None if they have left for good, or if no page comes."""
        step, since, habits = str(page["step"]), self.clock.seconds, self.habits
        if self.lobby is None:
            self.lobby = since
            for _ in range(1, habits.tabs):
                self.clock.spawn(lambda: self._second_tab(step), delay=0.5)
        leaves = since + habits.leaves if habits.leaves is not None and not self._left else GIVES_UP + since
        state: Mapping[str, Any] | None = page
        while self.clock.seconds - since < GIVES_UP:
            pause = PROPOSED_POLL if state and state.get("proposed") else POLL
            self.clock.sleep(max(0.0, min(pause, leaves - self.clock.seconds)))
            if self.clock.seconds >= leaves:
                return self._leave(step)
            if habits.offline and habits.offline[0] <= self.clock.seconds - since < sum(habits.offline):
                self.clock.sleep(since + sum(habits.offline) - self.clock.seconds)
            state = self._poll_lobby(step)
            if state is not None and state.get("state") != "lobby":
                return self._loaded()
        self.visit.reason = "waited too long: lobby"
        return None

    def _loaded(self) -> dict[str, Any] | None:
        """Load the page again and return it; None if it does not come."""
        found = self._ask("GET")
        if found is None:
            self.visit.reason = "no answer from the site"
        return found

    def _poll_lobby(self, step: str) -> dict[str, Any] | None:
        self.polls += 1
        return self._request("GET", self._poll_query(step), "")

    def _poll_query(self, step: str) -> str:
        """Return the query of the page's polls. With sessions it has the step's ticket, even after the lobby."""
        return f"{self._query}&{urlencode({'poll': step, 'ticket': self._ticket(step)})}"

    def _ticket(self, step: str) -> str:
        """Return the ticket of this step, as the page has it."""
        return ids.ticket(SECRET.project_secret(self.world.project), self.visit.user, step)

    def _leave(self, step: str) -> dict[str, Any] | None:
        """Close the page; return the page that they load if they come back, else None."""
        self._left = True
        if self.habits.beacon is not None:
            self.clock.spawn(lambda: self._beacon(step), delay=self.habits.beacon)
        if self.habits.back is None:
            self.visit.reason = "left by themselves"
            return None
        self.clock.sleep(self.habits.back)
        return self._loaded()

    def _beacon(self, step: str) -> None:
        """Send what a page sends when it is closed. It is not in `asked_at`, since the member is no longer present."""
        form = {"hippodrome-step": step, "hippodrome-ticket": self._ticket(step), "hippodrome-action": "leave"}
        super()._request("POST", self._query, urlencode(form))

    def _second_tab(self, step: str) -> None:
        """Poll from another tab in the lobby, until they are matched or gone."""
        while self.matched is None and not self.visit.reason and self.visit.finished is None:
            self._poll_lobby(step)
            self.clock.sleep(POLL)

    def _play_on(self, state: dict[str, Any]) -> str:
        """Connect and play with the others. Return `done`, `lost` or `unreachable`."""
        task = self.world.task_at(state["url"])
        trial = self.world.trials.at(task, str(state["step"]), self._play) if task else None
        if task is None or trial is None or not trial.connect(self.visit.user, state["token"]):
            return "unreachable"
        if self.first_picture is None:
            self.first_picture = self.clock.seconds
        self._connected()
        try:
            outcome = self._stay(trial, str(state["step"]))
        finally:
            trial.disconnect(self.visit.user)
        if outcome == "dropped":
            assert self.habits.drops
            self.clock.sleep(self.habits.drops[1])
            return "unreachable"
        return outcome

    def _stay(self, trial: SimTrial, step: str) -> str:
        """Stay until the trial is over (`done`), the server is lost (`lost`), or they lose the connection (`dropped`).

        Raises Quit when they close the page for good.
        """
        since, drops = self.clock.seconds, self.habits.drops
        while True:
            self.clock.sleep(1.0)
            if trial.over == "done":
                self.answered.append(step)
                return "done"
            if trial.over or is_lost(trial.task):
                return "lost"
            if self.habits.quits is not None and self.clock.seconds - since >= self.habits.quits:
                raise Quit
            if drops and not self._dropped and self.clock.seconds - since >= drops[0]:
                self._dropped = True
                return "dropped"

    def _is_over(self) -> bool:
        """Load the page, and return whether the game is over for this member."""
        page = self._ask("GET")
        return page is not None and "state" not in page
