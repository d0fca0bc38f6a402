"""The frame around step pages, the game page, messages, and their headers."""

from __future__ import annotations

import dataclasses
import gzip
import json
import re
import subprocess
import sys
from collections.abc import Mapping
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Reason
from hippodrome.control.model.texts import ENGLISH, IN_ENGLISH, SAID
from hippodrome.control.participants import frame, pages, scripts
from hippodrome.control.participants.frame import Page
from hippodrome.control.participants.pages import GameView, StepView
from hippodrome.control.participants.sandbox import FragmentError, records_mentioned
from hippodrome.control.participants.texts import in_script
from hippodrome.control.participants.waiting import FAILURES

ROOT = Path(__file__).resolve().parents[3]
STEPS = [
    Step("1", "consent", 2),
    Step("2", "questionnaire"),
    Step("3", "game"),
    Step("4", "survey"),
    Step("finalStep", "end"),
]
PROJECT = Project(
    id="demo", name="Cats & dogs", researcher="Ada <L>", steps=STEPS, allowed_hosts=["https://media.example.org"]
)
EXAMPLES = sorted((ROOT / "steps").glob("*.html"))


class Elements(HTMLParser):
    """Start tags with their attributes, and all text outside scripts and styles."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.all: list[tuple[str, dict[str, str | None]]] = []
        self.text = ""
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.all.append((tag, dict(attrs)))

    def handle_data(self, data: str) -> None:
        if not self.all or self.all[-1][0] not in ("script", "style"):
            self.text += data

    def named(self, name: str) -> list[dict[str, str | None]]:
        return [attrs for tag, attrs in self.all if tag == name]


def step_view(source: str, *, at: int = 1, **more: Any) -> StepView:
    values = {"project": {"name": PROJECT.name}, "completion_code": "CODE", "group": 1, "answers": {}}
    return StepView(
        PROJECT, STEPS[at], "P1", source, more.pop("values", values), "TICKET", "/next?a=1&b=2", at == 4, **more
    )


def step(source: str, **more: Any) -> Page:
    return pages.step_page(step_view(source, **more))


def game(project: Project | None = None, **state: Any) -> Page:
    present = {"state": "queued", "seconds": 3, "typical": None, "attempt": 1, "again": False, "reason": None, **state}
    view = GameView(
        project or PROJECT,
        STEPS[2],
        "P1",
        present,
        "/next?poll=1",
        "/next",
        "TICKET",
        "wss://*.example.org:*",
    )
    return pages.game_page(view)


def policy(headers: Mapping[str, str]) -> dict[str, list[str]]:
    directives = [part.split() for part in headers["Content-Security-Policy"].split(";")]
    return {name: sources for name, *sources in directives}


def kinds() -> dict[str, Page]:
    return {
        "step": step("<p>Hi</p>"),
        "final": step("<h1>Bye</h1>", at=4),
        "waiting": game(),
        "failed": game(state="failed", again=True),
        "message": frame.message_page("Broken", "It is broken."),
    }


# Headers


@pytest.mark.parametrize("kind", kinds())
def test_only_scripts_and_styles_with_the_pages_nonce_may_run(kind: str) -> None:
    page = kinds()[kind]
    found = policy(page.headers)
    (source,) = found["script-src"]
    nonce = re.fullmatch(r"'nonce-([A-Za-z0-9_-]{22})'", source)
    assert nonce is not None
    assert found["default-src"] == found["base-uri"] == found["frame-ancestors"] == ["'none'"]
    assert found["form-action"] == ["'self'"]
    assert "unsafe-eval" not in str(found)
    for attrs in Elements(page.html).named("script"):
        assert attrs.get("nonce") == nonce[1] or attrs["type"] == "application/json"
    assert page.headers["Cache-Control"] == "private, no-cache"
    assert page.headers["Referrer-Policy"] == "no-referrer"
    assert page.headers["X-Content-Type-Options"] == "nosniff"
    assert "camera=()" in page.headers["Permissions-Policy"]


def test_every_page_has_its_own_nonce() -> None:
    assert len({str(policy(step("x").headers)["script-src"]) for _ in range(20)}) == 20


def test_only_the_game_page_connects_elsewhere() -> None:
    assert policy(game().headers)["connect-src"] == ["'self'", "wss://*.example.org:*"]
    assert policy(step("x").headers)["connect-src"] == ["'self'"]


def test_allowed_hosts_show_pictures_and_cannot_add_directives() -> None:
    found = policy(step("x").headers)
    for name in ("img-src", "media-src", "frame-src"):
        assert "https://media.example.org" in found[name]
    evil = Project(id="x", steps=STEPS, allowed_hosts=["https://a.example; script-src *", "*", "'unsafe-inline'"])
    view = StepView(evil, STEPS[0], "P", "x", {}, "T", "/", False)
    assert "a.example" not in pages.step_page(view).headers["Content-Security-Policy"]
    assert "*" not in pages.step_page(view).headers["Content-Security-Policy"]


@pytest.mark.parametrize("kind", kinds())
def test_pages_load_nothing_from_other_hosts(kind: str) -> None:
    for _, attrs in Elements(kinds()[kind].html).all:
        for name in ("src", "href", "srcset", "poster"):
            assert not re.match(r"(https?:)?//", attrs.get(name) or "")


# Step pages


def test_the_only_form_is_that_of_the_frame() -> None:
    found = Elements(step('<form action="/evil" id=f><input name=age></form></form><form>').html)
    assert found.named("form") == [
        {"class": "page", "method": "post", "action": "/next?a=1&b=2", "accept-charset": "utf-8"}
    ]
    hidden = {attrs["name"]: attrs["value"] for attrs in found.named("input") if attrs.get("type") == "hidden"}
    assert hidden == {"hippodrome-step": "2", "hippodrome-ticket": "TICKET"}


@pytest.mark.parametrize(("source", "ours"), [("<input name=a>", 1), ("x", 1), ("<button>Mine</button>", 0)])
def test_a_page_without_a_button_gets_one(source: str, ours: int) -> None:
    html = step(source).html
    assert html.count(">Continue</button>") == ours
    assert len(Elements(html).named("button")) == 1


def test_the_final_page_has_a_form_only_if_it_has_questions() -> None:
    assert "<form" not in step("<h1>Bye</h1>", at=4).html
    asking = step("<input name=a>", at=4).html
    assert ">Send</button>" in asking
    saved = Elements(step("<h1>Bye</h1><p>{{ completion_code }}</p><input name=a>", at=4, answered=True).html)
    assert not saved.named("form")
    assert "Your answers have been saved" in saved.text
    assert "CODE" in saved.text
    assert "disabled" in saved.named("fieldset")[0]


def test_the_frame_names_study_step_and_researcher() -> None:
    page = step("<p>x</p>")
    found = Elements(page.html)
    assert "Cats & dogs" in found.text
    assert "Step 2 of 5" in found.text
    assert "Ada <L>" in found.text
    assert found.named("progress") == [{"max": "4", "value": "1"}]
    for landmark in ("header", "main", "footer"):
        assert len(found.named(landmark)) == 1
    assert found.named("html") == [{"lang": "en"}]


@pytest.mark.parametrize("source", ["<p>x</p>", "<h1>Mine</h1>", "<h2>x</h2>"])
def test_there_is_always_one_main_heading(source: str) -> None:
    assert len(Elements(step(source).html).named("h1")) == 1


def test_a_page_in_a_right_to_left_language_has_the_attribute_dir() -> None:
    study = msgspec.structs.replace(PROJECT, texts={"language": "ar"})

    def in_study(source: str) -> Page:
        return pages.step_page(dataclasses.replace(step_view(source), project=study))

    hebrew = '<html lang="he-IL"><h1>x'
    for page in (in_study("<h1>x"), game(project=study), step(hebrew), frame.message_page("x", "y", lang="ur")):
        assert [each.get("dir") for each in Elements(page.html).named("html")] == ["rtl"]
        assert ".board{direction:ltr}" in page.html
    for page in (in_study('<html lang="de"><h1>x'), step("<h1>x"), game(), frame.message_page("x", "y")):
        assert "dir" not in Elements(page.html).named("html")[0]
        assert "direction:ltr" not in page.html


def test_the_language_and_title_of_the_page_are_kept() -> None:
    found = Elements(step('<html lang="de"><title>Fragen</title>').html)
    assert found.named("html") == [{"lang": "de"}]
    assert "Fragen · step 2 of 5" in found.text


def test_a_study_of_one_page_has_no_progress_and_without_a_name_it_is_called_by_its_id() -> None:
    project = Project(id="one", steps=[Step("1", "only")])
    view = StepView(project, project.steps[0], "P", "x", {}, "T", "/", True)
    found = Elements(pages.step_page(view).html)
    assert "Step 1" not in found.text
    assert not found.named("progress")
    assert not found.named("footer")
    assert "<title>one</title>" in pages.step_page(view).html
    assert '<h1 class="study">one</h1>' in pages.step_page(view).html
    titled = dataclasses.replace(view, source="<title>Mine</title>")
    assert "<title>Mine</title>" in pages.step_page(titled).html


def test_a_study_of_two_pages_has_progress() -> None:
    project = Project(id="two", steps=[Step("1", "a"), Step("2", "b")])
    html = pages.step_page(StepView(project, project.steps[0], "P", "x", {}, "T", "/", False)).html
    assert "<title>two · step 1 of 2</title>" in html
    assert Elements(html).named("progress") == [{"max": "1", "value": "0"}]


def test_a_message_for_a_program_with_a_form_of_its_own_names_no_step_unless_it_is_given() -> None:
    fields = '<input type="hidden" name="hippodrome-step" value="{}">\n<input type="hidden" name="hippodrome-ticket" value="{}">\n'
    message = '<div class="page">\n<h1>A &amp; b</h1>\n<p>c</p>\n</div>'
    assert frame.form_message("A & b", "c") == fields.format("", "") + message
    given = frame.form_message("A & b", "c", step="3", ticket="T", also="<hr>")
    assert given == f"{fields.format('3', 'T')}<hr>{message}"


@given(answer=st.text() | st.just("</script><script>alert(1)</script>"), user=st.text(max_size=5))
def test_values_are_never_markup(answer: str, user: str) -> None:
    bare = Elements(step("<p>{{ answers['1'].a }}</p>").html)
    page = step("<p>{{ answers['1'].a }}</p>", values={"answers": {"1": {"a": answer}}})
    found = Elements(page.html)
    assert [tag for tag, _ in found.all] == [tag for tag, _ in bare.all]
    nonce = policy(page.headers)["script-src"][0][7:-1]
    assert [attrs for attrs in found.named("script") if attrs.get("nonce") != nonce] == []


def test_a_broken_page_raises_with_its_line() -> None:
    with pytest.raises(FragmentError) as caught:
        step("<p>\n{{ 1 / 0 }}")
    assert caught.value.line == 2


def test_clients_with_their_own_frame_get_the_researchers_page_with_the_step_and_ticket_fields() -> None:
    text = pages.fragment(step_view("<form>\n<p>{{ completion_code }}<script>1</script><input name=a></form>"))
    named = '<input type="hidden" name="hippodrome-step" value="2">\n<input type="hidden" name="hippodrome-ticket" value="TICKET">\n'
    assert text == f"{named}\n<p>CODE<script>1</script><input name=a>"


def test_pages_without_expressions_do_not_import_jinja() -> None:
    code = (
        "import sys; from hippodrome.control.participants import pages; "
        "from hippodrome.control.model.design import Step; from hippodrome.control.model.project import Project;"
        "p = Project(id='a', steps=[Step('1', 'x'), Step('2', 'y')]);"
        "pages.step_page(pages.StepView(p, p.steps[0], 'u', '<p>x</p>', {}, 't', '/', False));"
        "print('jinja2' in sys.modules, 'html.parser' in sys.modules)"
    )
    out = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert out.stdout.split() == ["False", "False"]


def test_pictures_come_from_the_folder_of_the_projects_files() -> None:
    source = "<img src=a.png>"
    view = step_view(source)
    reading = GameView(
        PROJECT,
        STEPS[2],
        "P1",
        {"state": "queued"},
        "/next?poll=1",
        "/next",
        "TICKET",
        "",
        reading={"instructions": (source, {})},
    )
    for html in (pages.step_page(view).html, pages.fragment(view), pages.game_page(reading).html):
        assert Elements(html).named("img") == [{"src": "/steps/demo/a.png"}]


# The game page


def data_of(page: Page) -> Any:
    found = re.search(r'<script type="application/json" id="data">(.*?)</script>', page.html, re.DOTALL)
    assert found is not None
    return json.loads(found[1])


@pytest.mark.parametrize(
    ("state", "present", "past"),
    [("queued", 0, 0), ("starting", 1, 1), ("naming", 2, 2), ("ready", 3, 3), ("new", 0, 0)],
)
def test_the_waiting_page_marks_the_present_stage(state: str, present: int, past: int) -> None:
    stages = Elements(game(state=state).html).named("li")
    assert [at for at, attrs in enumerate(stages) if attrs.get("aria-current") == "step"] == [present]
    assert [attrs.get("class") for attrs in stages].count("past") == past


def test_without_javascript_the_waiting_page_reloads_itself_and_says_that_javascript_is_needed() -> None:
    html = game().html
    assert '<noscript><meta http-equiv="refresh" content="5"></noscript>' in html
    assert "The game needs JavaScript" in html
    assert "http-equiv" not in game(state="ended").html


def test_the_game_page_is_in_the_frame_of_the_study() -> None:
    page = game().html
    assert "<title>Cats &amp; dogs · step 3 of 5</title>" in page
    assert '<p class="study">Cats &amp; dogs</p>' in page
    assert re.search("</footer>\n<script", page)
    assert re.search('<script type="module" nonce=', page)
    assert page.split("<style>\n")[1].split("</style>")[0] == frame.style("game")
    assert '<h1 id="over-title"></h1>\n<p></p>' in page, "nothing is over"


def test_the_texts_of_a_page_are_the_studys_own_also_in_its_script() -> None:
    own = {"language": "de", "sending": "Wird gesendet", "score": "Punkte", "studyBy": "Von {researcher}"}
    study = msgspec.structs.replace(PROJECT, texts=own)
    first = pages.step_page(dataclasses.replace(step_view("<p>x</p>"), project=study)).html
    assert "Wird gesendet" in first.split("<script")[-1]
    assert "Von Ada" in first
    assert "Punkte" in game(study).html
    in_english = game().html + step("<p>x</p>").html
    assert "Punkte" not in in_english
    assert "Wird gesendet" not in in_english


def test_the_game_page_hands_the_servers_sentences_in_the_studys_own_words_to_its_script() -> None:
    said = next(iter(SAID))
    study = msgspec.structs.replace(PROJECT, texts={said: "In eigenen Worten"})
    assert data_of(game(study))["said"] == {ENGLISH[said]: "In eigenen Worten"}
    assert "said" not in data_of(game())


TOGETHER = msgspec.structs.replace(PROJECT, players=2)
LOBBY = {"state": "lobby", "players": 2, "here": 1, "seconds": 3, "patience": 300, "then": "unmatched"}


def test_in_the_lobby_the_page_waits_for_others_and_not_for_a_server() -> None:
    found = {attrs["id"]: attrs for _, attrs in Elements(game(project=TOGETHER, **LOBBY).html).all if "id" in attrs}
    assert "hidden" not in found["wait"]
    assert "hidden" not in found["lobby"]
    matched = game(project=TOGETHER, state="queued", session=True, members=2)
    found = {attrs["id"]: attrs for _, attrs in Elements(matched.html).all if "id" in attrs}
    assert "hidden" in found["lobby"]


def test_in_the_lobby_a_page_without_javascript_does_not_reload_itself() -> None:
    html = game(project=TOGETHER, **LOBBY).html
    assert "http-equiv" not in html
    assert "The game needs JavaScript" in html
    assert "http-equiv" in game(project=TOGETHER, state="queued").html


def test_the_lobby_names_how_many_others_it_waits_for() -> None:
    pair = game(project=TOGETHER, **LOBBY).html
    assert '<h1 id="lobby-title">Waiting for another participant</h1>' in pair
    three = game(project=TOGETHER, **{**LOBBY, "players": 3}).html
    assert '<h1 id="lobby-title">Waiting for other participants</h1>' in three
    assert re.search('<p id="lobby-text">[^<]*3', three)
    assert not re.search('<p id="lobby-text">[^<]*[0-9]', pair)
    assert [data_of(game(project=TOGETHER, players=players))["players"] for players in (2, 3)] == [2, 3]


def test_the_page_of_a_game_for_several_has_its_own_text_and_style() -> None:
    together, alone = game(project=TOGETHER).html, game().html
    assert ("Your game is being prepared" in together, "Your game is being prepared" in alone) == (True, False)
    assert ("Preparing your game" in together, "Preparing your game" in alone) == (False, True)
    style = together.split("<style>\n")[1].split("</style>")[0]
    assert style.startswith(frame.style("game"))
    assert "#people" in style.removeprefix(frame.style("game"))


def test_the_game_page_hands_the_players_names_to_its_script() -> None:
    named = msgspec.structs.replace(TOGETHER, trial={"playerNames": {"a": "The red one"}})
    assert data_of(game(project=named))["names"] == {"a": "The red one"}
    assert "names" not in data_of(game(project=TOGETHER))
    assert "names" not in data_of(game(project=msgspec.structs.replace(named, players=1)))


@pytest.mark.parametrize(("after", "ends"), [("end", True), (None, True), ("policy", False)])
def test_the_page_gets_whether_the_game_ends_if_a_participant_stays_away(after: str | None, ends: bool) -> None:
    trial = {"afterAbsent": after} if after else {}
    data = data_of(game(project=msgspec.structs.replace(TOGETHER, trial=trial)))
    assert (data["players"], data["absentEnds"]) == (2, ends)
    assert not {"players", "absentEnds"} & data_of(game()).keys()


@given(st.dictionaries(st.text(), st.text()) | st.just({"reason": "</script><script>alert(1)//"}))
def test_the_state_reaches_the_script_unchanged_and_escaped(more: dict[str, str]) -> None:
    more = {"x" + key: value for key, value in more.items()}
    page = game(**more)
    data = data_of(page)
    assert {key: data["state"][key] for key in more} == more
    assert (data["poll"], data["page"], data["step"]) == ("/next?poll=1", "/next", "3")
    assert len(Elements(page.html).named("script")) == 2


@pytest.mark.parametrize("state", ["ended", "failed"])
@pytest.mark.parametrize(
    ("offered", "actions"),
    [
        ({"again": True}, ["restart"]),
        ({"without": True}, ["without"]),
        ({"again": True, "without": True}, ["without", "restart"]),
        ({}, []),
    ],
)
def test_a_page_whose_game_is_over_has_a_form_to_go_on(
    state: str, offered: dict[str, bool], actions: list[str]
) -> None:
    found = Elements(game(state=state, **offered).html)
    sections = {attrs["id"]: attrs for attrs in found.named("section")}
    assert "hidden" in sections["wait"]
    assert "hidden" not in sections["over"]
    (form,) = found.named("form")
    assert ("hidden" in form) is not bool(offered)
    fields = {attrs["name"]: attrs["value"] for attrs in found.named("input")}
    assert fields == {"hippodrome-step": "3", "hippodrome-ticket": "TICKET"}
    buttons = [attrs["value"] for attrs in found.named("button") if attrs.get("name") == "hippodrome-action"]
    assert buttons == actions


def test_a_participant_whose_game_failed_reads_how_to_go_on_and_whom_to_ask() -> None:
    project = msgspec.structs.replace(PROJECT, contact="study@example.org <b>")
    failed: dict[str, Any] = {"state": "failed", "reason": Reason.LOST, "without": True}
    code = ids.completion_code(PROJECT.secret, "P1", "failed")
    for again, way in (
        (True, "without this game, or try the game again."),
        (False, "continue the study without this game."),
    ):
        text = Elements(game(project=project, again=again, **failed).html).text
        assert way in text
        assert "You can contact the researchers here: study@example.org <b>" in text
        assert f"your ID P1 and the code {code}." in text
    assert "Please contact the researchers who invited you." in Elements(game(**failed).html).text


@pytest.mark.parametrize("reason", [*Reason, None])
def test_the_page_of_a_closed_server_shows_the_reason(reason: Reason | None) -> None:
    state = "failed" if reason in FAILURES else "ended"
    _, over = game(state=state, reason=reason, again=True).html.split('<section id="over"')
    text = Elements(f"<section {over}").text
    assert ("The time limit was reached." in text) is (reason == Reason.DEADLINE)
    assert ("researchers ended your game" in text) is (reason == Reason.STOPPED)
    assert ("The game was inactive for too long" in text) is (reason == Reason.ENDED)
    assert ("not your fault" in text) is (state == "failed")
    assert ("No server is available" in text) is (reason == Reason.NO_CAPACITY)
    assert "Your earlier answers and games are saved." in text
    button = "Try again" if state == "failed" else "Start again"
    later = "Please try again in a few minutes, here or with your study link."
    advice = later if reason in (Reason.NO_CAPACITY, Reason.FULL) else f"Press “{button}” to continue."
    assert advice in text
    assert advice not in Elements(game(state=state, reason=reason).html).text


@pytest.mark.parametrize(
    ("reason", "title", "report"),
    [
        (Reason.LOST, "The game could not be played", True),
        (Reason.FULL, "The study is full right now", False),
        (Reason.REFUSED, "The game could not start", True),
        (Reason.NO_CAPACITY, "The game could not start", False),
        (Reason.DEADLINE, "The game has ended", False),
    ],
)
def test_the_page_of_a_closed_server_says_what_happened_and_whom_to_tell(
    reason: Reason, title: str, report: bool
) -> None:
    state = "failed" if reason in FAILURES else "ended"
    again = game(state=state, reason=reason, again=True).html
    assert f'<h1 id="over-title">{title}</h1>' in again
    assert ("If this happens again, please contact" in again) is report
    assert "Please contact the researchers who invited you." not in again
    last = game(state=state, reason=reason).html
    assert "If this happens again" not in last
    assert "Please contact the researchers who invited you." in last


@pytest.mark.parametrize(
    ("reason", "words"),
    [
        ("lost", "did not work on any of the servers"),
        ("refused", "Your game cannot start because of a problem"),
        ("full", "All places in this game are taken"),
        ("unheard of", "The game server has stopped."),
    ],
)
def test_each_reason_has_its_sentence(reason: str, words: str) -> None:
    assert words in game(state="failed", reason=reason).html


@pytest.mark.parametrize(("state", "says"), [("failed", "Try again"), ("ended", "Start again")])
def test_the_button_of_a_closed_server_names_what_it_does(state: str, says: str) -> None:
    page = game(state=state, again=True, without=True).html
    buttons = re.findall(r'<button type="submit" name="hippodrome-action" value="(\w+)">(.*)</button>', page)
    assert buttons == [("without", "Continue without the game"), ("restart", says)]


@pytest.mark.parametrize("replaces", [False, True])
def test_the_waiting_page_shows_when_a_server_replaces_one_that_failed(replaces: bool) -> None:
    sections = {
        attrs.get("id"): attrs for attrs in Elements(game(state="starting", replaces=replaces).html).named("div")
    }
    assert ("hidden" in sections["wait-first"]) is replaces
    assert ("hidden" in sections["wait-moved"]) is not replaces


# Messages


def test_a_message_is_text() -> None:
    found = Elements(frame.message_page("<b>", "a & b <i>", lang="de").html)
    assert "a & b <i>" in found.text
    assert found.named("html") == [{"lang": "de"}]
    assert not {"b", "i", "script"} & {tag for tag, _ in found.all}


# Size


def test_pages_are_small(capsys: pytest.CaptureFixture[str]) -> None:
    sizes = {kind: len(gzip.compress(page.html.encode())) for kind, page in kinds().items()}
    sizes |= {path.stem: len(gzip.compress(step(path.read_text()).html.encode())) for path in EXAMPLES}
    with capsys.disabled():
        print("\ncompressed pages, bytes:", sizes)
    assert max(sizes.values()) < 14_500  # what a server may send before the first acknowledgement: 10 x 1,460 bytes


def test_the_page_of_a_game_drawn_by_objects_is_small(capsys: pytest.CaptureFixture[str]) -> None:
    drawn = msgspec.structs.replace(PROJECT, trial={"scene": {"width": 600}})
    size = len(gzip.compress(game(project=drawn).html.encode()))
    with capsys.disabled():
        print("\ncompressed page of a game drawn by objects, bytes:", size)
    assert len(gzip.compress(game().html.encode())) + 1_000 < size < 40_000


def test_the_page_of_a_game_for_several_participants_is_small_and_no_other_page_has_its_parts(
    capsys: pytest.CaptureFixture[str],
) -> None:
    size = len(gzip.compress(game(project=TOGETHER, **LOBBY).html.encode()))
    with capsys.disabled():
        print("\ncompressed page of a game for several participants, bytes:", size)
    assert size < 18_500
    assert not [part for part in ("lobby", "company", "#people", "sendBeacon") if part in game().html]


def test_a_page_has_the_style_of_its_kind_only() -> None:
    whole, found = frame.style(), {kind: frame.style(kind) for kind in ("step", "game", "message")}
    assert ".likert" in found["step"]
    assert ".stages" in found["game"]
    for kind, others in {"step": (".stages", ".hud"), "game": (".likert",), "message": (".likert", ".stages")}.items():
        assert not [name for name in others if name in found[kind]]
        rules = iter(whole.split("}"))
        assert all(rule in rules for rule in found[kind].split("}")), "the order of the rules is kept"
    assert set(whole.split("}")) == {rule for style in found.values() for rule in style.split("}")}


# The example


@pytest.mark.parametrize("path", EXAMPLES, ids=lambda path: path.stem)
def test_every_field_of_the_example_has_a_label(path: Path) -> None:
    found = Elements(step(path.read_text()).html)
    labelled = {attrs.get("for") for attrs in found.named("label")}
    for tag, attrs in found.all:
        if tag in ("input", "select", "textarea") and attrs.get("type") not in ("hidden", "checkbox", "radio"):
            assert attrs["id"] in labelled
    text = path.read_text()
    for box in re.finditer(r'<input type="(checkbox|radio)"', text):
        assert text.rfind("<label>", 0, box.start()) > text.rfind("</label>", 0, box.start())


def test_the_examples_last_page_has_a_text_for_every_group() -> None:
    source = (ROOT / "steps" / "debrief.html").read_text()
    for group in (None, 0, 1):
        text = Elements(step(source, at=4, values={"answers": {}, "group": group, "completion_code": "CODE"}).html).text
        assert "CODE" in text
        assert ("personal request." in text) is (group == 1)


def test_the_examples_last_page_reads_no_record() -> None:
    assert records_mentioned((ROOT / "steps" / "debrief.html").read_text()) == frozenset()  # each would cost a call


def test_no_page_shows_jinja_expressions_to_participants() -> None:
    for path in EXAMPLES:
        assert "{{" not in step(path.read_text()).html


def test_each_kind_of_page_has_exactly_these_headers() -> None:
    def told(page: Page) -> dict[str, str]:
        headers = dict(page.headers)
        headers["Content-Security-Policy"] = re.sub("nonce-[^']+", "nonce-N", headers["Content-Security-Policy"])
        return headers

    others = {
        "Referrer-Policy": "no-referrer",
        "X-Content-Type-Options": "nosniff",
        "Cache-Control": "private, no-cache",
        "Permissions-Policy": "camera=(), microphone=(), geolocation=(), payment=(), usb=(), browsing-topics=()",
    }
    assert told(frame.message_page("a", "b")) == others | {
        "Content-Security-Policy": "default-src 'none'; script-src 'nonce-N'; style-src 'self' 'unsafe-inline'; "
        "img-src 'self' data:; media-src 'self'; font-src 'self'; frame-src 'none'; connect-src 'self'; "
        "form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    }
    media = "https://media.example.org"
    assert told(game()) == others | {
        "Content-Security-Policy": "default-src 'none'; script-src 'nonce-N'; style-src 'self' 'unsafe-inline'; "
        f"img-src 'self' data: {media}; media-src 'self' {media}; font-src 'self'; frame-src {media}; "
        "connect-src 'self' wss://*.example.org:*; form-action 'self'; base-uri 'none'; frame-ancestors 'none'"
    }


def test_the_frame_of_a_step_shows_the_progress() -> None:
    page = Elements(step("<title>Age</title><p>x</p>").html)
    (progress,) = page.named("progress")
    assert progress == {"max": "4", "value": "1"}
    assert "Step 2 of 5" in page.text
    (body,) = page.named("body")
    assert {name: body[name] for name in ("class", "data-project", "data-user", "data-step")} == {
        "class": "step",
        "data-project": "demo",
        "data-user": "P1",
        "data-step": "2",
    }
    (html,) = page.named("html")
    assert html["lang"] == "en"
    assert "Age · step 2 of 5" in page.text
    first = Elements(step("<p>x</p>", at=0).html)
    assert first.named("progress") == [{"max": "4", "value": "0"}]
    assert "Cats & dogs · step 1 of 5" in first.text


@pytest.mark.parametrize(("source", "study"), [("<p>x</p>", "h1"), ("<h1>x</h1>", "p")])
def test_the_studys_name_is_the_heading_of_a_page_without_one(source: str, study: str) -> None:
    page = Elements(step(source).html)
    assert [tag for tag, attributes in page.all if attributes.get("class") == "study"] == [study]


def test_a_final_page_tells_its_script_whether_it_is_done() -> None:
    asks, thanks = "<input name=a>", "<p>Thanks</p>"
    done = [
        "data-done" in Elements(step(source, at=at, answered=answered).html).named("body")[0]
        for source, at, answered in (
            (asks, 4, False),
            (asks, 4, True),
            (thanks, 4, False),
            (thanks, 4, True),
            (thanks, 1, True),
        )
    ]
    assert done == [False, True, True, True, False]


def test_the_game_page_hands_the_necessary_data_to_its_script() -> None:
    page = game(state="starting").html
    found = re.search(r'<script[^>]*type="application/json"[^>]*>(.*?)</script>', page, re.DOTALL)
    assert found
    data = json.loads(found[1])
    assert data["state"]["state"] == "starting"
    assert {name: data[name] for name in ("poll", "page", "project", "step")} == {
        "poll": "/next?poll=1",
        "page": "/next",
        "project": "demo",
        "step": "3",
    }
    fields = {field["name"]: field["value"] for field in Elements(page).named("input") if field.get("name")}
    assert fields["hippodrome-step"] == "3"
    assert fields["hippodrome-ticket"] == "TICKET"


def code(text: str) -> str:
    """Return the lines of a script or style that are neither empty nor comments."""
    lines = map(str.strip, re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL).splitlines())
    return "".join(f"{line}\n" for line in lines if line and not line.startswith("//"))


def texts(script: str) -> list[str]:
    """Return the texts in a script; of templates, the parts that are no code.

    No regular expression in the scripts has quotes.
    """
    found: list[str] = []
    within = ["{"]  # what is open: the quote of a text, a template or a bracket
    at = 0
    while at < len(script):
        char, here = script[at], within[-1]
        if here in '"`' and char == "\\":
            found[-1] += script[at : at + 2]
            at += 1
        elif char == here and here in '"`':
            within.pop()
        elif here == "`" and script.startswith("${", at):
            within.append("{")
            at += 1
        elif here in '"`':
            found[-1] += char
        elif char in '"`':
            within.append(char)
            found.append("")
        elif char == "{":
            within.append(char)
        elif char == "}":
            within.pop()
            if within[-1] == "`":
                found.append("")
        at += 1
    return found


@pytest.mark.parametrize(("name", "page"), [("step.js", step("<p>x</p>")), ("game/main.js", game())])
def test_a_page_has_its_script_and_style_without_comments(name: str, page: Page) -> None:
    script = in_script(code(re.sub(r" // .*", "", scripts.join(ROOT / "hippodrome" / "web" / name))), IN_ENGLISH)
    carried = re.findall(r'<script(?: type="module")? nonce="[^"]+">\n(.*?)</script>', page.html, re.DOTALL)[-1]
    spare = r"\s|;(?=\s*})|,(?=\n\s*[}\])])"  # and semicolons and commas in front of a closing bracket
    assert re.sub(r"\s", "", carried) == re.sub(spare, "", script)
    assert texts(carried) == texts(script)
    assert frame.style("game" if name.startswith("game") else "step") in page.html
    plain = code((ROOT / "hippodrome" / "web" / "style.css").read_text())
    dense = re.sub(r" ?([{};>~]) ?|([:,]) ", r"\1\2", plain)
    assert frame.style() == re.sub(r"([{;,}])\n", r"\1", dense).replace(";}", "}")


def test_each_class_in_the_html_of_the_pages_has_a_rule_in_a_style_sheet() -> None:
    written = [*(ROOT / "hippodrome" / "web").glob("*.html"), Path(frame.__file__), Path(pages.__file__)]
    quoted = [each for file in written for each in re.findall('class="([^"$]+)"', file.read_text())]
    styles = "".join(file.read_text() for file in (ROOT / "hippodrome" / "web").glob("*.css"))
    names = {name for each in quoted for name in each.split()}
    assert not [name for name in names if not re.search(rf"\.{name}\b", styles)]


def test_spaces_that_have_a_meaning_in_a_style_stay() -> None:
    quoted = re.findall('"[^"]*"', code((ROOT / "hippodrome" / "web" / "style.css").read_text()))
    assert not [text for text in quoted if re.search(" [{};>~]|[{};>~:,] ", text)]
    assert 'font:100%/1.55 system-ui,-apple-system,"Segoe UI",' in frame.style()


def test_the_game_page_loads_no_other_script() -> None:
    assert not [attrs for attrs in Elements(game().html).named("script") if attrs.get("src")]
    assert not re.search(r"^\s*(import|export)\b", game().html, re.MULTILINE)
