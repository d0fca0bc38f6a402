"""A form that is sent again answers no second step, whether it names its step or not."""

from __future__ import annotations

import itertools
import json
import threading
from collections.abc import Callable
from contextlib import closing
from html.parser import HTMLParser
from typing import Any
from urllib.parse import urlencode

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.participant import REPEAT_WINDOW
from hippodrome.control.model.project import Events, Project, step_key
from hippodrome.control.ports import Topic
from hippodrome.functions import installed as place
from testing.aws_events import FORM
from testing.fake_platform import FakePlatform
from testing.studies import SECRET, installed, study
from testing.visitors import Program

PAGES = ["1", "2", "3", "4", "finalStep"]
WINDOW = REPEAT_WINDOW.total_seconds()


def pages_only() -> Project:
    """Return a study of four pages and a final one, where each step may be answered with the same form."""
    return study(steps=[Step(key, "survey") for key in PAGES[:-1]] + [Step("finalStep", "debrief")], events=Events())


@pytest.fixture
def project() -> Project:
    return pages_only()


class Fields(HTMLParser):
    """The named elements of a page, as HIPPO's front end collects them from its form."""

    def __init__(self) -> None:
        super().__init__()
        self.values: dict[str, str] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if tag in ("input", "textarea", "select") and given.get("name"):
            self.values[str(given["name"])] = given.get("value") or ""


def hippos_form(page: str) -> dict[str, str]:
    """Return what HIPPO's front end posts of a page: every named element but buttons."""
    fields = Fields()
    fields.feed(page)
    return fields.values


def answered(platform: FakePlatform, user: str = "alice") -> dict[str, Any]:
    """Return the stored answers, by step."""
    folder = f"maze/users/{user}/answers/"
    found = {key: body for key, (body, *_) in platform.documents.kept.items() if key.startswith(folder)}
    return {key.removeprefix(folder).removesuffix(".json"): json.loads(found[key])["answers"] for key in sorted(found)}


def asking(platform: FakePlatform) -> Program:
    """Return a program of alice's that has asked for her first page."""
    program = Program(platform)
    program.ask()
    return program


# Sent again


def test_a_form_without_a_step_that_is_sent_twice_answers_one_step(platform: FakePlatform) -> None:
    program = asking(platform)
    first = program.post({"agree": "yes"})
    again = program.post({"agree": "yes"})
    assert answered(platform) == {"1": {"agree": "yes"}}
    assert first["step"] == again["step"] == "2"


def test_a_repeated_form_is_recognized_after_other_forms_and_with_its_fields_in_another_order(
    platform: FakePlatform,
) -> None:
    program = asking(platform)
    program.post({"age": 7, "names": {"a": 1, "b": [2]}})
    program.post({"word": "hello"})
    program.post({"names": {"b": [2], "a": 1}, "age": 7})
    assert list(answered(platform)) == ["1", "2"]


@pytest.mark.parametrize("other", [{"age": "7"}, {"age": 7.0}, {"age": True}, {"age": [7]}, {}, {"age": 7, "x": None}])
def test_a_form_with_any_difference_is_another_answer(platform: FakePlatform, other: object) -> None:
    program = asking(platform)
    program.post({"age": 7})
    program.post(other)
    assert list(answered(platform)) == ["1", "2"]


def test_a_form_that_a_browser_sent_is_not_accepted_again_from_a_program(platform: FakePlatform) -> None:
    program = asking(platform)
    proof = {"hippodrome-step": "1", "hippodrome-ticket": ids.ticket(SECRET, "alice", "1")}
    program.ask("POST", urlencode({"agree": "yes", **proof}), FORM)
    program.post({"agree": "yes"})
    program.ask("POST", "agree=yes", FORM)
    assert list(answered(platform)) == ["1"]


def test_a_form_with_a_step_and_no_ticket_answers_only_this_step(platform: FakePlatform) -> None:
    program = asking(platform)
    for _ in range(3):
        program.post({"agree": "yes", "hippodrome-step": "1"})
    assert list(answered(platform)) == ["1"]
    program.post({"agree": "yes", "hippodrome-step": "2"})
    assert list(answered(platform)) == ["1", "2"]


def test_an_unreadable_answer_of_an_agent_does_not_stop_the_participant(platform: FakePlatform) -> None:
    program = asking(platform)
    for step, body in (("1", b"\xff{"), ("2", b"[]"), ("3", b'{"answers": 3}')):
        platform.documents.put(f"maze/users/alice/answers/{step}.json", body)
    program.post({"agree": "yes"})
    kept = platform.documents.kept["maze/users/alice/answers/4.json"][0]
    assert json.loads(kept)["answers"] == {"agree": "yes"}


def test_few_documents_are_read_however_many_steps_were_answered() -> None:
    steps = [Step(str(n), "survey") for n in range(1, 101)] + [Step("finalStep", "debrief")]
    platform = installed(study(steps=steps, events=Events()))
    program = asking(platform)
    for step in steps[:-2]:
        platform.documents.put(f"maze/users/alice/answers/{step.key}.json", b'{"answers": {}}')
    platform.documents.calls.clear()
    program.post({"agree": "yes"})
    assert platform.documents.calls.count("get") <= 12


# Equal answers to different steps


def test_a_program_that_names_no_step_may_answer_the_same_after_a_minute(platform: FakePlatform) -> None:
    program = asking(platform)
    program.post({})
    platform.wait(seconds=WINDOW - 1)
    assert program.post({})["step"] == "2"
    platform.wait(seconds=1)
    assert program.post({})["step"] == "3"
    assert answered(platform) == {"1": {}, "2": {}}


def test_hippos_front_end_may_answer_equal_pages_at_any_speed_and_one_form_answers_one_step(
    platform: FakePlatform,
) -> None:
    platform.documents.put(step_key("maze", "survey"), b"<input name='agree' value='yes'><button name='b'>Go</button>")
    program = Program(platform)
    shown = program.ask()
    for step, following in itertools.pairwise(PAGES):
        form = hippos_form(shown["page"])
        assert form.pop("agree") == "yes"
        assert shown["step"] == step
        shown = program.post({**form, "agree": "yes"})
        assert program.post({**form, "agree": "yes"})["step"] == shown["step"] == following
    assert answered(platform) == {key: {"agree": "yes"} for key in PAGES[:-1]}


def test_a_step_that_is_named_twice_with_the_same_value_counts(platform: FakePlatform) -> None:
    """A program adds step and ticket to a form that has them already."""
    program = Program(platform)
    shown = program.ask()
    fields = [*hippos_form(shown["page"]).items(), ("hippodrome-step", shown["step"])]
    for _ in range(2):
        program.ask("POST", urlencode([*fields, ("hippodrome-ticket", shown["ticket"])]), FORM)
    assert list(answered(platform)) == ["1"]
    assert "hippodrome-step" not in answered(platform)["1"]


def test_a_form_that_asks_for_another_server_is_not_taken_for_a_repeated_answer() -> None:
    platform = installed(
        study(steps=[Step("1", "survey"), Step("2", "game"), Step("3", "debrief")], events=Events("2"))
    )
    program = asking(platform)
    program.post({})
    from hippodrome.control.model import server
    from hippodrome.control.model.records import to_json
    from hippodrome.control.model.server import Reason

    failed = server.stopped_before_start("maze", "alice", 1, platform.now())
    platform.documents.put(server.key(failed.label), to_json(failed))
    assert program.ask()["reason"] == Reason.STOPPED
    platform.bus.sent.clear()
    program.post({"hippodrome-action": "restart"})
    assert (Topic.START, {"projectId": "maze", "userId": "alice", "attempt": 2}) in platform.bus.sent


# In any order


class Turns:
    """Lets requests of several threads go on one call at a time, in the order that the test decides.

    A request waits before each of its calls to the documents until the test lets it go on.
    """

    def __init__(self, platform: FakePlatform) -> None:
        self._local = threading.local()
        documents = platform.documents
        for name in ("get", "create", "replace", "list"):
            setattr(documents, name, self._waiting(getattr(documents, name)))

    def _waiting(self, call: Callable[..., Any]) -> Callable[..., Any]:
        def wait(*args: Any, **kw: Any) -> Any:
            flight: Flight | None = getattr(self._local, "flight", None)
            if flight:
                flight.pause()
            found = call(*args, **kw)
            return iter(list(found)) if call.__name__ == "list" else found

        return wait

    def begin(self, act: Callable[[], Any]) -> Flight:
        return Flight(self._local, act)


class Flight:
    """A request that is not answered yet."""

    def __init__(self, local: threading.local, act: Callable[[], Any]) -> None:
        self.reply: Any = None
        self.over = False
        self._go, self._rests = threading.Semaphore(0), threading.Semaphore(0)
        self._thread = threading.Thread(target=self._run, args=(local, act), daemon=True)
        self._thread.start()
        assert self._rests.acquire(timeout=60)

    def _run(self, local: threading.local, act: Callable[[], Any]) -> None:
        local.flight = self
        try:
            self.reply = act()
        finally:
            self.over = True
            self._rests.release()

    def pause(self) -> None:
        self._rests.release()
        assert self._go.acquire(timeout=60)

    def one_call(self) -> None:
        """Let the request go on until its next call, or its end."""
        if not self.over:
            self._go.release()
            assert self._rests.acquire(timeout=60)

    def land(self) -> Any:
        while not self.over:
            self.one_call()
        assert self.reply is not None
        return self.reply


class Participant:
    """Answers the pages that their program shows, and whose forms the network sends as often and as late as it likes.

    A copy of a form comes at the latest while the answer it repeats is younger than the time that counts as repeated.
    """

    def __init__(self, forms: list[dict[str, str]]) -> None:
        self.platform = installed(pages_only())
        self.program = Program(self.platform)
        self.turns = Turns(self.platform)
        self.forms = forms
        self.shown = self.program.ask()["step"]
        self.flights: list[Flight] = []

    def send(self, at: int, names: str) -> None:
        step = PAGES[at]
        ours = {"step": {"hippodrome-step": step}, "nothing": {}, "ticket": {
            "hippodrome-step": step, "hippodrome-ticket": ids.ticket(SECRET, "alice", step),
        }}[names]  # fmt: skip
        self.flights.append(self.turns.begin(lambda: self.program.post({**self.forms[at], **ours})))

    def may_come_late(self, at: int) -> bool:
        kept = self.platform.documents.kept.get(f"maze/users/alice/answers/{PAGES[at]}.json")
        return kept is not None and (self.platform.now() - kept[2]) < REPEAT_WINDOW

    def look(self, reply: Any) -> None:
        """Take the reply's page as the open one, unless a later page is open already."""
        self.shown = max(self.shown, reply["step"], key=PAGES.index)

    def land(self) -> None:
        for flight in self.flights:
            self.look(flight.land())
        self.flights.clear()

    def close(self) -> None:
        """End the requests that still wait for their turn."""
        for flight in self.flights:
            while not flight.over:
                flight.one_call()
        place.use(None)

    def check(self) -> None:
        kept = answered(self.platform)
        assert kept == {key: form for key, form in zip(PAGES, self.forms, strict=False) if key in kept}
        assert list(kept) == PAGES[: len(kept)]


FORMS = st.sampled_from([{}, {"agree": "yes"}, {"agree": "no"}])
NAMES = st.sampled_from(["nothing", "nothing", "nothing", "step", "ticket"])


@given(forms=st.lists(FORMS, min_size=4, max_size=4), data=st.data())
def test_every_answer_is_stored_for_its_own_step_however_requests_overtake_each_other(
    forms: list[dict[str, str]], data: st.DataObject
) -> None:
    with closing(Participant([*forms, {}])) as alice:
        overtake(alice, data)
        press_on(alice)


def overtake(alice: Participant, data: st.DataObject) -> None:
    """Send, repeat, delay and overtake requests as hypothesis chooses; then each stored answer must belong to its step."""
    for _ in range(data.draw(st.integers(0, 40), label="moves")):
        at = PAGES.index(alice.shown)
        late = [n for n in range(at) if alice.may_come_late(n)]
        moves = ["send"] * (at < 4) + ["late"] * bool(late) + ["go on"] * bool(alice.flights) * 3 + ["wait"]
        move = data.draw(st.sampled_from(moves), label="move")
        if move == "send":
            alice.send(at, data.draw(NAMES, label="names"))
        elif move == "late":
            alice.send(data.draw(st.sampled_from(late), label="late"), data.draw(NAMES, label="names"))
        elif move == "go on":
            flight = data.draw(st.sampled_from(alice.flights), label="flight")
            flight.one_call()
            if flight.over:
                alice.flights.remove(flight)
                alice.look(flight.land())
        else:
            alice.land()
            alice.platform.wait(seconds=data.draw(st.integers(1, 40), label="seconds"))
    alice.land()
    alice.check()


def press_on(alice: Participant) -> None:
    """Press the button every 20 seconds: this must lead to the end of the study, even if the answers are equal."""
    for _ in range(4 * 5):
        at = PAGES.index(alice.shown)
        if at == 4:
            break
        alice.send(at, "nothing")
        alice.land()
        alice.check()
        alice.platform.wait(seconds=20)
    assert alice.shown == "finalStep"
