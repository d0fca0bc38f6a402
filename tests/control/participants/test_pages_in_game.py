"""Pages that the game page shows: instructions, and a page between two games."""

from __future__ import annotations

import re

import msgspec
import pytest

from hippodrome.control.model import ids
from hippodrome.control.model.project import Project, step_key
from hippodrome.control.storage import uploaded_pages
from hippodrome.functions import installed as place
from testing.fake_platform import FakePlatform
from testing.studies import installed, study
from testing.visitors import Browser

STUDY = study(
    trial={"game": "x/Y-v0", "instructions": "rules", "betweenEpisodes": "pause"},
    game_pages={"instructions": 2, "betweenEpisodes": 0},
)
RULES = (
    "<html><body><form><h1>Rules {{ group }}</h1><img src='a.png'><p>{{ answers['2'].age }}</p></form></body></html>"
)


@pytest.fixture
def platform() -> FakePlatform:
    return with_pages(STUDY)


def with_pages(project: Project, **pages: str) -> FakePlatform:
    platform = installed(project)
    sources = {"rules-0": RULES, "rules-1": RULES, "pause": "<p>Rest.</p><script>rest()</script>", **pages}
    for file, source in sources.items():
        if source:
            platform.documents.put(step_key(project.id, file), source.encode())
    return platform


def game_page(platform: FakePlatform) -> str:
    """Return the page that alice gets at the game step, whatever its status."""
    alice = Browser(platform)
    alice.answer(alice.get(), consent="yes")
    alice.answer(alice.get(), age="33")
    return str(alice.send()["body"])


def test_the_game_page_has_the_pages_filled_in_for_the_participants_group(platform: FakePlatform) -> None:
    page = game_page(platform)
    group = ids.group("maze", "alice", 2)
    assert f"<h1>Rules {group}</h1>" in page
    assert "<p>33</p>" in page
    assert "/steps/maze/a.png" in page
    assert "<p>Rest.</p>" in page
    assert re.findall(r'<form class="page" id="text-([^"]*)"', page) == ["instructions", "betweenEpisodes"]
    (nonce,) = set(re.findall(r'nonce="([^"]+)"', page))
    assert f'<script nonce="{nonce}">rest()' in page
    assert page.index("Rules") > page.index('id="screen"'), "no id of theirs hides one of the page's own"


def test_the_modules_of_such_pages_are_in_no_other_game_page(platform: FakePlatform) -> None:
    assert "reading-button" in game_page(platform)
    place.use(None)
    assert "reading-button" not in game_page(installed())


@pytest.mark.parametrize(("source", "title"), [("", "This page is missing"), ("{% if %}", "This page cannot be shown")])
def test_a_page_that_cannot_be_shown_gets_an_error_page(source: str, title: str) -> None:
    platform = with_pages(STUDY, pause=source)
    try:
        assert title in game_page(platform)
    finally:
        place.use(None)


def test_pages_that_hippos_script_uploaded_are_found_with_their_groups() -> None:
    platform = FakePlatform()
    for file in (
        "consent-0",
        "consent-1",
        "questionnaire",
        "survey",
        "debrief",
        "rules-0",
        "rules-1",
        "rules-2",
        "pause",
    ):
        platform.documents.put(f"maze/{file}.html", b"<p>x</p>")
    project, problems = uploaded_pages.located(platform.documents, msgspec.structs.replace(STUDY, game_pages={}))
    assert (project.page_folder, project.game_pages, problems) == ("", {"instructions": 3, "betweenEpisodes": 0}, [])
