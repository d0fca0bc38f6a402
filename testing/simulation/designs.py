"""Simulated participants of studies with a design, and two such studies.

They answer wrongly, send forms twice, go back, have two tabs, let time run out, leave and come back. Whatever they are
told is remembered, so that `design_checks.py` can compare it with what is stored in the end.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlencode

from hippodrome.control.model.design import Block, End, Factor, Section, Step
from hippodrome.control.model.project import Events
from hippodrome.control.participants.steps.game import UNASSIGNED
from hippodrome.protocol.keys import participant_folder
from hippodrome.protocol.session import assignment_key
from testing.simulation.members import SimulatedMember
from testing.simulation.people import SimulatedParticipant
from testing.simulation.world import SimulatedWorld
from testing.visitors import hidden

SHOWN = "<i>{{ condition.partner }}{{ condition.pay }}/{{ order.look | join(',') }}</i><input name=answer>"
"""A page on which participants see what they were assigned to."""
PAGES = {"rate": SHOWN, "debrief": SHOWN, "about-equal": SHOWN, "about-best": SHOWN}
CONDITIONS = (
    Factor("partner", {"helpful": "helpful", "lazy": "lazy"}),
    Factor("advice", {"on": "on", "off": "off"}),
)
SECTIONS = tuple(Section({"partner": name}, {"options": {"partner": name}}) for name in ("helpful", "lazy"))
SOUP: Mapping[str, object] = {
    "conditions": CONDITIONS,
    "steps": [
        Step("consent", "consent"),
        Step("quiz", "quiz", right={"soups": "3"}, tries=2, max_seconds=900),
        Step("game", "game", when='answers.consent.plays != "no"', sections=SECTIONS),
        Step("rate", "rate", max_seconds=120),
        Step("impression", "impression-{partner}", when='condition.advice == "on"', min_seconds=5),
        Step("survey", "survey"),
        Step("debrief", "debrief"),
    ],
    "ends": (
        End("declined", ('answers.consent.agree == "no"',)),
        End("screenedOut", ("not answers.quiz.passed",), code="CS1"),
        End("late", minutes=20, page="late"),
        End("failed", code="CF1"),
    ),
    "events": Events(start_server_step="quiz", stop_server_step="survey"),
}
"""Two factors between people, a check, a game that may be skipped, times, and all kinds of ends."""
LOOKS: Mapping[str, object] = {
    "blocks": (Block((Factor("look", {"plain": "plain", "face": "face", "voice": "voice"}),)),),
    "steps": [
        Step("consent", "consent"),
        Step("about", "about"),
        Step("game", "game", block=0),
        Step("rate", "rate", block=0),
        Step("debrief", "debrief"),
    ],
    "ends": (End("tired", ('count(answers.rate.answer) > 1 and answers.about.tired == "yes"',)),),
    "events": Events(start_server_step="about", stop_server_step="debrief"),
}
"""A game and a page that are repeated in an order of the participant's own."""
DAY = 86_400.0
SITTINGS: Mapping[str, object] = {
    "conditions": CONDITIONS,
    "steps": [
        Step("consent", "consent"),
        Step("ready", "ready"),
        Step("game", "game", sections=SECTIONS),
        Step("tomorrow", "tomorrow", min_seconds=DAY),
        Step("again", "game", sections=SECTIONS),
        Step("debrief", "debrief"),
    ],
    "events": Events(start_server_step="ready", stop_server_step="debrief"),
}
"""Two sittings a day apart, with a game in each."""
PAY: Mapping[str, object] = {
    "conditions": (Factor("pay", {"equal": "equal", "best": "best"}),),
    "steps": [
        Step("consent", "consent"),
        Step("ready", "ready"),
        Step("game", "game"),
        Step("about", "about-{pay}"),
        Step("debrief", "debrief"),
    ],
    "ends": (End("declined", ('answers.ready.answer == "no"',)),),
    "events": Events(start_server_step="ready", stop_server_step="about"),
    "players": 2,
    "patience": 120.0,
}
"""Participants who play together are assigned together."""
TOGETHER: Mapping[str, object] = {
    **LOOKS,
    "conditions": PAY["conditions"],
    "ends": (End("late", minutes=30),),
    "players": 2,
    "patience": 120.0,
}
"""They play several games together, in one order."""


@dataclass(frozen=True)
class Ways:
    """How somebody takes part. Steps are named by their names in the study; times are seconds."""

    answers: Mapping[str, Sequence[Mapping[str, str]]] = field(default_factory=dict)  # by step, one for each try
    pauses: Mapping[str, float] = field(default_factory=dict)  # before the page of a step is answered
    reloads: Sequence[str] = ()  # steps whose page is loaded again after the pause
    twice: bool = False  # each form is sent twice at once, with other answers the second time
    tabs: bool = False  # each page is also loaded in another tab, and answered there
    back: bool = False  # after each page, the form of the page before is sent again with other answers
    comes: float = 0.0
    leaves: str = ""  # the step at whose page they leave for good


RIGHT = {"quiz": ({"soups": "3"},)}
WRONG = {"quiz": ({"soups": "2"}, {"soups": "4"})}


class Left(Exception):
    """The participant has closed the page for good."""


class Designed(SimulatedParticipant):
    """What is special of participants of a study with a design."""

    def __init__(self, world: SimulatedWorld, number: int, *, ways: Ways | None = None, **person: Any) -> None:
        super().__init__(world, number, **person)
        self.ways = ways or Ways()
        self.seen: set[str] = set()  # what pages have said of the assignment
        self.stored: dict[str, bytes] = {}  # their documents, as they were when a page came after them
        self.wrong: list[str] = []
        self._forms: list[dict[str, str]] = []
        self._tries: dict[str, int] = {}
        self._has_ended = False

    def _walk(self) -> None:
        self.clock.sleep(self.ways.comes)
        try:
            super()._walk()
        except Left:
            self.visit.reason = "left by themselves"
        if self._has_ended:  # they try everything, and are asked nothing more
            for form in self._forms[-3:]:
                self._ask("POST", urlencode(form))
            self._ask("GET")

    def _filled(self, page: Mapping[str, Any]) -> dict[str, str]:
        step = self._name(str(page["step"]))
        if step == self.ways.leaves:
            raise Left
        self.clock.sleep(self.ways.pauses.get(step, 0.0))
        if step in self.ways.reloads:
            again = self._ask("GET")
            if again and again.get("step") != page["step"]:
                return {}  # the study has gone on, and an empty form answers nothing
        tries = self._tries[step] = self._tries.get(step, -1) + 1
        answers = self.ways.answers.get(step, RIGHT.get(step, ({"answer": "yes"},)))
        return {**hidden(page["page"]), **answers[min(tries, len(answers) - 1)]}

    def _name(self, key: str) -> str:
        """The name of a run's step."""
        return key.partition("-")[0]

    def _ask(self, method: str, body: str = "") -> dict[str, Any] | None:
        if method == "POST" and self.ways.twice:
            self._meanwhile("POST", body.replace("answer=yes", "answer=twice").replace("soups=", "soups=1"))
        if self.ways.tabs:
            self._meanwhile(method, body.replace("answer=yes", "answer=tab"))
            self._meanwhile("GET")
        if method == "POST" and self.ways.back and len(self._forms) > 1:
            self._meanwhile("POST", urlencode(self._forms[-2]).replace("answer=yes", "answer=back"))
        page = super()._ask(method, body)
        if page and page.get("page") and "state" not in page and page.get("step"):
            self._forms.append({**hidden(str(page["page"])), "answer": "yes", "soups": "0"})
        return page

    def _meanwhile(self, method: str, body: str = "") -> None:
        """Send a request from another tab at about the same time."""
        self.clock.spawn(lambda: self._request(method, self._query, body))

    def _request(self, method: str, query: str, body: str) -> dict[str, Any] | None:
        had_ended = self._has_ended
        page = super()._request(method, query, body)
        if page is not None and "poll=" not in query:
            self._look(page, had_ended=had_ended)
        return page

    def _look(self, page: Mapping[str, Any], *, had_ended: bool) -> None:
        """Remember what the page says, and what is stored when it comes: neither may change any more."""
        is_asked = bool(page.get("step")) or "state" in page
        if had_ended and is_asked:
            self.wrong.append(f"{self.visit.user} is asked {page.get('step')} after an end")
        documents, project = self.world.platform.documents.kept, self.world.project
        folder = participant_folder(project.id, self.visit.user)
        for key in [key for key in documents if key.startswith((f"{folder}a", f"{folder}end"))]:
            body = documents[key][0]
            if self.stored.setdefault(key, body) != body:
                self.wrong.append(f"{key} has changed")
        self._has_ended = self._has_ended or (f"{folder}end.json" in documents and not is_asked)
        if shown := re.search("<i>(.*?)</i>", str(page.get("page"))):
            self.seen.add(shown[1])

    def _goes_on_without(self, page: Mapping[str, Any]) -> bool:
        form = {"hippodrome-step": page["step"], "hippodrome-action": "without"}
        if not (ticket := page.get("ticket")):
            found = self._ask("GET") or {}
            ticket = hidden(str(found.get("page"))).get("hippodrome-ticket", "")
        self._ask("POST", urlencode({**form, "hippodrome-ticket": ticket}))
        return True


class DesignedMember(Designed, SimulatedMember):
    """A participant of such a study who plays together with others."""

    _page_is_unassigned = False

    def _request(self, method: str, query: str, body: str) -> dict[str, Any] | None:
        had_none = not self._is_assigned()
        page = super()._request(method, query, body)
        if page is not None and "poll=" not in query and "state" in page:
            self._page_is_unassigned = had_none
        return page

    def _poll(self, step: str) -> dict[str, Any] | None:
        """Return what a poll says, or the page that is loaded again, as `hippodrome/web/game/main.js` does."""
        state = super()._poll(step)
        is_matched = state is not None and state.get("state") == "ended" and self._page_is_unassigned
        return self._ask("GET") if is_matched else state

    def _poll_query(self, step: str) -> str:
        return super()._poll_query(step) + (f"&{UNASSIGNED}=1" if self._page_is_unassigned else "")

    def _is_assigned(self) -> bool:
        key = assignment_key(self.world.project.id, self.visit.user)
        return key in self.world.platform.documents.kept
