"""Two participants in two real browsers, one wide and one a phone, who play examples/two-players together."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hippodrome.bots.links import with_user
from hippodrome.local.rehearsal.study_process import StudyProcess, copy_of
from hippodrome.trial.recordings.recording import read
from testing.held_study import HeldStudy
from testing.processes import ROOT
from tests.browser.conftest import GamesToEnd, Hold, note_texts, replace_lines, wait_for_noted
from tests.browser.world import PATIENCE, SHOTS

pytestmark = [pytest.mark.browser, pytest.mark.explores, pytest.mark.timeout(300)]

FLAWS = (Path(__file__).parent / "flaws.js").read_text()
SHORT = {
    "  maxEpisodes: 3\n": "  maxEpisodes: 1\n",
    "  absent: 15\n": "  absent: 4\n",
    "  countdown: 3\n": "  countdown: 2\n",
    "  patience: 30\n": "  patience: 300\n",  # on a busy machine the second participant may come late
}
ALONE = {"  patience: 30\n": "  patience: 10\n"}
SAYS = "([selector, text]) => document.querySelector(selector)?.textContent.includes(text)"
PLAYS = "() => document.getElementById('play').dataset.state === 'playing'"

Come = Callable[..., Any]


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the example with one game."""
    project = tmp_path_factory.mktemp("two-players") / "project"
    copy_of(ROOT / "examples" / "two-players", project)
    replace_lines(project, SHORT)
    return project


@pytest.fixture(scope="module")
def games(project: Path) -> GamesToEnd:
    """Ends the game."""
    return GamesToEnd(project)


@pytest.fixture(scope="module")
def study(project: Path, games: GamesToEnd) -> Iterator[StudyProcess]:
    held = HeldStudy(project, project.parent / "data")
    held.start()
    yield held
    held.clear()


@pytest.fixture(scope="module")
def without_others(hold: Hold) -> StudyProcess:
    """The example, in which a participant waits only ten seconds for another."""
    return hold("two-players", ALONE)


@pytest.fixture
def come(chromium: Any, study: StudyProcess) -> Iterator[Come]:
    """Makes a participant at the game step, in a browser of their own: `come("ada", 1280)`. Any error in it fails."""
    contexts, complaints = [], []

    def arrive(name: str, width: int, study: StudyProcess = study) -> Any:
        narrow = width < 600
        context = chromium.new_context(
            viewport={"width": width, "height": 740 if narrow else 800}, has_touch=narrow, is_mobile=narrow
        )
        contexts.append(context)
        context.set_default_timeout(PATIENCE)
        page = context.new_page()
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda said: complaints.append(said.text) if said.type == "error" else None)
        page.goto(with_user(study.link, name))
        for box in page.get_by_role("checkbox").all():
            box.check()
        page.get_by_role("button", name="I agree").click()
        page.get_by_label("Sometimes").check()
        page.get_by_role("button", name="Continue").click()
        page.wait_for_selector("body[data-step='3']")
        return page

    yield arrive
    for context in contexts:
        context.close()
    assert complaints == []


def wait_for_text(page: Any, selector: str, text: str) -> None:
    page.wait_for_function(SAYS, arg=[selector, text])


def answer(study: StudyProcess, name: str, step: str = "3") -> dict[str, Any]:
    path = study.data / "two-players" / "users" / name / "answers" / f"{step}.json"
    found: dict[str, Any] = json.loads(path.read_text())["answers"]
    return found


def recorded(study: StudyProcess, session: str) -> list[dict[str, Any]]:
    files = sorted((study.data / "two-players" / "sessions" / session / "trials").glob("*/*.gz"))
    return [line for file in files for line in read(file.read_bytes())]


def test_two_people_find_each_other_play_and_go_on(come: Come, study: StudyProcess, games: GamesToEnd) -> None:
    wide = come("ada", 1280)
    wait_for_text(wide, "#lobby-here", "You are the first of 2 people")
    phone = come("bo", 360)
    for page in (wide, phone):
        page.wait_for_selector("#play:not([hidden])")
        page.wait_for_function(PLAYS)
    # Places are drawn by lot.
    colours = ["red", "blue"] if "You are red" in wide.inner_text(".hud") else ["blue", "red"]
    for page, colour in zip((wide, phone), colours, strict=True):
        wait_for_text(page, ".hud", f"You are {colour}")
    SHOTS.mkdir(exist_ok=True)
    wide.screenshot(path=SHOTS / "1280-two-players.png")
    phone.screenshot(path=SHOTS / "360-two-players.png")
    assert phone.evaluate("document.documentElement.scrollWidth") <= 360
    assert [page.evaluate(FLAWS) for page in (wide, phone)] == [[], []]
    for _ in range(3):
        wide.keyboard.press("ArrowRight", delay=200)
        phone.get_by_role("button", name="Left", exact=True).tap()
    for colour in colours:
        games.wait_until_moved(wide, colour)
    with games.over(1):
        for page in (wide, phone):
            page.wait_for_selector("body[data-step='4']")
            page.wait_for_selector("text=How did it go?")
    ada, bo = answer(study, "ada"), answer(study, "bo")
    assert [(each["outcome"], each["player"]) for each in (ada, bo)] == [("finished", colour) for colour in colours]
    assert ada["session"] == bo["session"]
    steps = [line for line in recorded(study, ada["session"]) if line["kind"] == "step"]
    walked = {
        player: {step["players"][player]["actionName"] for step in steps if step["players"][player]["by"] == "human"}
        for player in ("red", "blue")
    }
    assert walked == {colours[0]: {"right"}, colours[1]: {"left"}}  # each participant moved only their own figure


def test_a_participant_who_goes_away_is_waited_for_replaced_and_let_in_again(
    come: Come, study: StudyProcess, games: GamesToEnd
) -> None:
    wide, phone = come("cy", 1280), come("di", 360)
    for page in (wide, phone):
        page.wait_for_function(PLAYS)
    for each in ("#overlay-title", "#overlay-hint", "#trouble"):
        note_texts(wide, each)
    phone.goto("about:blank")
    wait_for_noted(wide, "#overlay-title", "Waiting for the other participant")
    wait_for_noted(wide, "#overlay-hint", "a computer player will take their place")
    wait_for_noted(wide, "#trouble", "A computer player has replaced")
    wide.wait_for_function(PLAYS)
    phone.goto(with_user(study.link, "di"))
    wait_for_noted(wide, "#trouble", "The other participant is back")
    phone.wait_for_function(PLAYS)
    with games.over(1):
        for page in (wide, phone):
            page.wait_for_selector("body[data-step='4']")
    lines = recorded(study, answer(study, "cy")["session"])
    gone = answer(study, "di")["player"]
    what = [line["what"] for line in lines if line["kind"] == "presence" and line["player"] == gone]
    assert what == ["joined", "left", "replaced", "returned"]
    by = [step["players"][gone]["by"] for step in lines if step["kind"] == "step"]
    assert "policy" in by
    assert by[-1] != "policy"


def test_a_participant_without_a_partner_goes_on_and_gets_another_completion_code(
    come: Come, without_others: StudyProcess
) -> None:
    study = without_others
    page = come("ed", 360, study)
    wait_for_text(page, "#lobby-then", "you will continue without this game")
    page.wait_for_selector("body[data-step='4']")
    page.wait_for_selector("text=There was nobody to play with")
    page.get_by_label("Yes").check()
    page.get_by_role("button", name="Continue").click()
    page.wait_for_selector("text=You waited for a second person")
    assert answer(study, "ed") == {"outcome": "unmatched"}
    usual = json.loads((study.data / "two-players" / "users" / "ed" / "participant.json").read_text())["completionCode"]
    assert page.locator(".code").first.inner_text() != usual
