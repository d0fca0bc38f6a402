"""Fixtures for tests in a real Chromium: pages, held studies, and participants whose pages are checked for errors."""

from __future__ import annotations

import contextlib
import gzip
import json
import os
import time
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from hippodrome.bots.links import with_user
from hippodrome.local.rehearsal.study_process import StudyProcess, copy_of
from hippodrome.trial.recordings.recording import read
from testing import exploration
from testing.browser import ARGUMENTS, NoChromium, chromium_path, headless_path
from testing.held_study import HeldStudy
from testing.processes import ROOT
from tests.browser.world import PATIENCE, SHOTS, world  # noqa: F401 - a fixture

NO_CHROMIUM = "there is no Chromium; to run these tests: apt-get install chromium"
HERE = Path(__file__).parent
LOOK_EVERY = 50
"""ms between two looks of `Page.wait_for_function`. By default it looks 60 times a second, and has the page draw as often."""
WHOLE_STUDIES = ("test_study.py", "test_two_participants.py")
ONE_PROCESS = "--renderer-process-limit=1"
"""All pages of a context share a process of the browser, which takes as long to start as a page to load."""


class SharedBrowser:
    """One Chromium for many files of this folder, because its start takes as long as some tests."""

    def __init__(self) -> None:
        self._open = contextlib.ExitStack()
        self._playwright: Any = None
        self._browser: Any = None
        self._path = ""

    def browser(self, path: str | None = None) -> Any:
        """Return the browser in this file, or the one that runs, or else `headless_path`.

        Started if it does not run. Raises NoChromium.
        """
        path = path or self._path or headless_path()
        if self._browser is None or not self._browser.is_connected() or path != self._path:
            if self._playwright is None:
                from playwright.sync_api import Page, sync_playwright

                Page.wait_for_function.__kwdefaults__["polling"] = LOOK_EVERY
                self._playwright = self._open.enter_context(sync_playwright())
            if self._browser is not None:
                self._browser.close()
            self._browser = self._playwright.chromium.launch(executable_path=path, args=[*ARGUMENTS, ONE_PROCESS])
            self._path = path
        return self._browser

    def close(self) -> None:
        """End the browser and Playwright, if they run."""
        with self._open:
            if self._browser is not None:
                self._browser.close()
        self._playwright, self._browser, self._path = None, None, ""


SHARED_BROWSER = SharedBrowser()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_teardown(item: pytest.Item, nextitem: pytest.Item | None) -> Iterator[None]:
    """End the browser after this folder's last test: while Playwright runs, its thread cannot run another event loop."""
    try:
        return (yield)
    finally:
        if nextitem is None or not nextitem.path.is_relative_to(HERE):
            SHARED_BROWSER.close()


@pytest.fixture(scope="module")
def chromium(request: pytest.FixtureRequest) -> Iterator[Any]:
    """The browser. Without one, its tests are skipped; with BROWSER_TESTS=required they fail.

    Participants walk through whole studies in the Chromium that people have: some in `make test`, all in `make hunt`.
    Other tests of pages need no window. Contexts that a file leaves open are closed after its last test.
    """
    try:
        whole = request.path.name in WHOLE_STUDIES or exploration.TIMES
        browser = SHARED_BROWSER.browser(chromium_path() if whole else headless_path())
    except NoChromium:
        if os.environ.get("BROWSER_TESTS") == "required":
            pytest.fail(NO_CHROMIUM)
        pytest.skip(NO_CHROMIUM)
    yield browser
    for context in browser.contexts:
        context.close()


@contextlib.contextmanager
def own_page(context: Any) -> Iterator[Any]:
    """A new page in this context. At its end, the data that its sites have stored in the browser are deleted."""
    page, origins = context.new_page(), set()
    page.on("framenavigated", lambda shown: origins.add("/".join(shown.url.split("/", 3)[:3])))
    try:
        yield page
    finally:
        devtools = context.new_cdp_session(page)
        for origin in origins:
            if origin.startswith("http"):  # another test may get the same port
                devtools.send("Storage.clearDataForOrigin", {"origin": origin, "storageTypes": "all"})
        page.close()


@contextlib.contextmanager
def without_errors(page: Any) -> Iterator[Any]:
    """Fail the test if the page's scripts raise an error, or if the Content Security Policy refuses something."""
    problems: list[str] = []
    page.on("pageerror", lambda error: problems.append(str(error)))

    def listen(said: Any) -> None:
        if "Content Security Policy" in said.text:
            problems.append(said.text)

    page.on("console", listen)
    yield page
    assert not problems


NARROW = {"viewport": {"width": 360, "height": 640}}


@pytest.fixture(scope="module")
def narrow(chromium: Any) -> Iterator[Any]:
    """The browser context that all pages of a file share."""
    context = chromium.new_context(**NARROW)
    context.set_default_timeout(PATIENCE)
    context.new_page()  # keeps a window open: a new one for each page takes Chromium longer than some tests
    yield context
    context.close()


@pytest.fixture
def tab(narrow: Any) -> Iterator[Any]:
    """A page in the file's context. A test that sets the context's clock, network or permissions takes `lone_tab`."""
    with own_page(narrow) as page, without_errors(page):
        yield page


@pytest.fixture
def lone_tab(chromium: Any) -> Iterator[Any]:
    """A page in a context of its own."""
    context = chromium.new_context(**NARROW)
    context.set_default_timeout(PATIENCE)
    with without_errors(context.new_page()) as page:
        yield page
        context.close()


@pytest.fixture
def stopped_clock_tab(lone_tab: Any) -> Any:
    """A page whose clock is stopped: its time passes only in `stopped_clock_tab.clock.run_for(ms)`."""
    lone_tab.clock.install(time="2026-01-01T00:00:00Z")
    lone_tab.clock.pause_at("2026-01-01T01:00:00Z")  # the page's clock must not be past it yet, on the slowest machine
    return lone_tab


HOLD_TIMERS = """(() => {
    const lengths = %s, held = new Map(), { setTimeout: begin, clearTimeout: end } = window;
    let last = 0;
    window.setTimeout = (done, ms, ...more) => {
        if (!lengths.includes(ms)) return begin(done, ms, ...more);
        held.set(last -= 1, done);
        return last;
    };
    window.clearTimeout = (id) => { if (!held.delete(id)) end(id); };
    window.letGo = () => { for (const [id, done] of [...held]) if (held.delete(id)) done(); };
})()"""


def hold_timers(page: Any, *lengths: int) -> None:
    """Hold the page's timers of these lengths (ms) until `window.letGo()`, so that short-lived words can be checked.

    Call it before the page is opened.
    """
    page.add_init_script(HOLD_TIMERS % json.dumps(lengths))


NOTE_TEXTS = """selector => {
    const found = document.querySelector(selector), texts = [found.textContent];
    (window.noted ??= {})[selector] = texts;
    new MutationObserver(() => texts.push(found.textContent)).observe(found, { childList: true, characterData: true, subtree: true });
}"""


def note_texts(page: Any, selector: str) -> None:
    """Note each text of this element from now on, for `wait_for_noted`: some are shown for less than a second."""
    page.evaluate(NOTE_TEXTS, selector)


def wait_for_noted(page: Any, selector: str, text: str) -> None:
    """Wait until the element has shown this text at any time since `note_texts`."""
    page.wait_for_function(
        "([selector, text]) => window.noted[selector].some((each) => each.includes(text))", arg=[selector, text]
    )


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Iterator[StudyProcess]:
    """The example study, in a copy whose game can be ended with a button.

    It runs at a third of its speed: otherwise the game is over after half a minute in which nobody presses a key.
    """
    folder = tmp_path_factory.mktemp("example")
    copy_of(ROOT, folder / "project")
    replace_lines(folder / "project", {"  startingFrameRate: 30\n": "  startingFrameRate: 10\n"})
    held = HeldStudy(folder / "project", folder / "data", stalled=60)
    try:
        held.start()
        yield held
        assert held.interrupt(PATIENCE / 1000)
    finally:
        left = held.clear()
    assert left == 0


Hold = Callable[..., StudyProcess]


def replace_lines(project: Path, changes: Mapping[str, str]) -> None:
    """Replace lines of the project's config.yml."""
    config = project / "config.yml"
    for line, instead in changes.items():
        assert config.read_text().count(line) == 1, line
        config.write_text(config.read_text().replace(line, instead))


GAMES_TO_END = """

class Agent(Agent):
    games = 0

    def reset(self, seed=None):
        self.games += 1
        return super().reset(seed)

    def step(self, actions):
        observations, rewards, terminations, truncations, infos = super().step(actions)
        for player, action in actions.items():
            if action:
                (self.notes / f"{player} has moved").touch()
        over = (self.notes / f"game {self.games} is over").exists()
        return observations, rewards, terminations | {"__all__": over}, truncations, infos
"""


class GamesToEnd:
    """Notes between a test and the games of a copy of examples/two-players: the test ends a game, and learns who has moved."""

    def __init__(self, project: Path) -> None:
        self._notes = project.parent / "notes"
        self._notes.mkdir()
        agent = project / "agent.py"
        text = agent.read_text(encoding="utf-8")
        agent.unlink()  # a link to the example's
        notes = f"    notes = __import__('pathlib').Path({str(self._notes)!r})\n"
        agent.write_text(text + GAMES_TO_END.replace("    games = 0\n", f"    games = 0\n{notes}"), encoding="utf-8")

    @contextlib.contextmanager
    def over(self, game: int) -> Iterator[None]:
        """End this game of each session that plays within the block."""
        note = self._notes / f"game {game} is over"
        note.touch()
        yield
        note.unlink()

    def wait_until_moved(self, page: Any, player: str) -> None:
        """Wait until the player has moved, in any game."""
        until = time.monotonic() + PATIENCE / 1000
        while not (self._notes / f"{player} has moved").exists():
            assert time.monotonic() < until, player
            page.wait_for_timeout(50)


@pytest.fixture(scope="module")
def hold(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Hold]:
    """An example, held once for all tests of the file, in a copy whose game can be ended with a button.

    Call it as `hold("gridworld")`. `changes` has lines of config.yml and their replacements; `stalled` is HeldStudy's.
    """
    studies: dict[tuple[str, ...], HeldStudy] = {}

    def start(name: str, changes: Mapping[str, str] | None = None, stalled: float = 60) -> StudyProcess:
        key = (name, *(changes or {}).values())
        if key not in studies:
            folder = tmp_path_factory.mktemp(name)
            copy_of(ROOT / "examples" / name, folder / "project")
            replace_lines(folder / "project", changes or {})
            studies[key] = HeldStudy(folder / "project", folder / "data", stalled=stalled)
            studies[key].start()
        return studies[key]

    yield start
    for study in studies.values():
        study.clear()


class Visitor:
    """A participant in a browser of their own."""

    def __init__(
        self, browser: Any, study: StudyProcess, name: str, width: int, pictures: bool, **options: Any
    ) -> None:
        self.name, self.width, self.study, self.pictures = name, width, study, pictures
        self.invited = ""  # the heading of the consent page, which has two wordings
        narrow = width < 600
        self.context = browser.new_context(
            viewport={"width": width, "height": 740 if narrow else 800},
            has_touch=narrow,
            is_mobile=narrow,
            reduced_motion="reduce",
            **options,
        )
        self.context.set_default_timeout(PATIENCE)
        self.context.on("request", self._asks)
        self.hosts: set[str] = set()
        self.resource_types: set[str] = set()
        self.complaints: list[str] = []
        self.sockets: list[str] = []
        self.sizes: dict[str, int] = {}
        self.link = with_user(study.link, name)
        self.page = self.tab()

    def tab(self) -> Any:
        page = self.context.new_page()
        page.on(
            "console", lambda said: self.complaints.append(said.text) if said.type in ("error", "warning") else None
        )
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("websocket", self._connects)
        return page

    def _asks(self, request: Any) -> None:
        self._goes_to(request.url)
        if not request.url.startswith("data:"):
            self.resource_types.add(request.resource_type)

    def _goes_to(self, url: str) -> None:
        if not url.startswith(("data:", "blob:")):
            self.hosts.add(str(urlsplit(url).hostname))

    def _connects(self, socket: Any) -> None:
        self._goes_to(socket.url)
        self.sockets.append(socket.url)

    def open(self) -> None:
        """Open the link."""
        answer = self.page.goto(self.link)
        assert answer is not None
        assert answer.status == 200

    def record_size(self, what: str) -> None:
        """Record the page's compressed size, which is all that it loads (`check_all` proves that)."""
        self.sizes[what] = len(gzip.compress(self.context.request.get(self.page.url).body(), 6))

    @property
    def step(self) -> str:
        return str(self.page.locator("body").get_attribute("data-step"))

    def send(self, following: str) -> None:
        """Press the button, and wait for the next step."""
        self.page.locator("form.page button:not([type=button])").last.click()
        self.page.wait_for_selector(f"body[data-step='{following}']")

    def shot(self, what: str) -> None:
        """Save a screenshot of the page, for people to look at."""
        if not self.pictures:
            return
        SHOTS.mkdir(exist_ok=True)
        self.page.screenshot(path=SHOTS / f"{self.width}-{what}.png", full_page=True)

    def answers(self, step: str) -> dict[str, Any]:
        path = self.study.data / "ms-pacman" / "users" / self.name / "answers" / f"{step}.json"
        answers: dict[str, Any] = json.loads(path.read_text())["answers"]
        return answers

    def steps_played(self) -> list[dict[str, Any]]:
        """Return the steps in all recordings, in the order of their files."""
        folder = self.study.data / "ms-pacman" / "users" / self.name / "trials"
        lines = [line for path in sorted(folder.glob("*/*.gz")) for line in read(path.read_bytes())]
        return [line for line in lines if line["kind"] == "step"]

    def check_all(self) -> None:
        """Check that the page asked nobody else, loaded nothing unexpected, complained of nothing, and was small."""
        assert self.hosts <= {"127.0.0.1"}
        assert self.resource_types <= {"document", "fetch"}  # fetch: the game page asks for the server's state
        assert self.complaints == []
        assert all(size < 40_000 for size in self.sizes.values()), self.sizes


@pytest.fixture
def visit(chromium: Any, study: StudyProcess) -> Iterator[Any]:
    """Makes participants, each in a browser of their own: `visit("ada", 1280)`."""
    visitors: list[Visitor] = []

    def come(name: str, width: int = 1280, *, pictures: bool = False, **options: Any) -> Visitor:
        visitor = Visitor(chromium, study, name, width, pictures, **options)
        visitors.append(visitor)
        return visitor

    yield come
    for visitor in visitors:
        visitor.context.close()
