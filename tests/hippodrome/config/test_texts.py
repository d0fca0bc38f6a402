"""The key `texts`: what each mistake is answered with, and what a study in another language leaves in English."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from hippodrome.config import parse_registration, read_project
from hippodrome.config.remarks import remarks_on
from hippodrome.model.project import Project
from hippodrome.model.texts import ENGLISH, texts_of
from tests.hippodrome.config.folder import SMALL, folder, one, read, small

__all__ = ["folder"]

GERMAN = (Path(__file__).parents[3] / "docs" / "texts.de.yml").read_text(encoding="utf-8")
PAGES = """\
project:
  id: small
  steps:
    1: consent
    2: thanks
"""


def with_texts(config: str, texts: str) -> str:
    """The configuration with these lines of texts."""
    return config.replace("project:\n", f"project:\n  texts:\n{texts}", 1)


def remarks(folder: Path, config: str) -> list[str]:
    """The remarks on texts."""
    return [str(said) for said in remarks_on(folder, read(folder, config)) if "another language" in str(said)]


@pytest.mark.parametrize(
    ("texts", "said"),
    [
        ("{strat: Los}", "project.texts.strat: unknown text; did you mean start?"),
        ("{Start: Los}", "project.texts.Start: unknown text; did you mean start?"),
        ("{qqqqqq: Los}", "project.texts.qqqqqq: unknown text; docs/texts.md lists all"),
        (
            '{seconds: "{sekunden} s"}',
            "project.texts.seconds: nothing stands for {sekunden} here; there is {seconds}",
        ),
        (
            '{gameOf: "{game} {of} {games}"}',
            "project.texts.gameOf: nothing stands for {of} here; there are {game} and {games}",
        ),
        ('{start: "Los {}"}', "project.texts.start: nothing stands for {} here; this text has no places"),
        ("{start: [Los]}", 'project.texts.start: must be text, in quotes: "…", not a list'),
        (
            "{start: no}",
            'project.texts.start: must be text, in quotes: "…"; YAML reads no as true or false, so write "no" in quotes',
        ),
        (f"{{start: {'x' * 501}}}", "project.texts.start: must be at most 500 characters long, not 501"),
        (
            "{language: German}",
            'project.texts.language: must be a language as pages name it, such as de or pt-BR, not "German"',
        ),
        ("Los", 'project.texts: must be a section: indented lines such as "start: "Los"" below it, not "Los"'),
    ],
)
def test_a_mistake_in_texts(folder: Path, texts: str, said: str) -> None:
    assert one(folder, small(project=f"texts: {texts}\n")) == said


def test_a_mistake_is_named_with_its_line(folder: Path) -> None:
    (folder / "config.yml").write_text(with_texts(SMALL, '    start: Los\n    seconds: "{s}"\n'))
    with pytest.raises(Exception, match=r"config\.yml:4: project\.texts\.seconds: nothing stands for \{s\}"):
        read_project(folder)


def test_texts_that_are_empty_are_not_given(folder: Path) -> None:
    config = read(folder, with_texts(SMALL, "    start: Los\n    pause:\n    goOn: ''\n    second: 1\n"))
    assert config.registration()["texts"] == {"start": "Los", "second": "1"}


def test_texts_reach_the_pages_as_they_are(folder: Path) -> None:
    registration = read(folder, with_texts(SMALL, "    start: <b> & „Los“\n    language: pt-BR\n")).registration()
    found = parse_registration(json.loads(json.dumps(registration)))
    assert msgspec.convert(found, Project).texts == {"start": "<b> & „Los“", "language": "pt-BR"}


def test_the_german_texts_are_without_mistakes_and_remarks(folder: Path) -> None:
    together = SMALL.replace("project:\n", "project:\n  players: 2\n") + "  players: {a: human, b: human}\n"
    config = together.replace("project:\n", GERMAN[GERMAN.index("project:\n") :], 1)
    assert remarks(folder, config) == []
    assert read(folder, config).project.own_texts.keys() == ENGLISH.keys()


def test_texts_that_stay_english_get_one_remark(folder: Path) -> None:
    pages = texts_of(has_game=False, has_sessions=False)
    said = remarks(folder, with_texts(PAGES, "    language: de\n    step: Schritt\n    continue: Weiter\n"))
    which = f"the study is in another language (de), and {len(pages) - 3} texts of ours stay English"
    assert said == [f"config.yml:2: remark: project.texts: {which}: titleStep, studyBy, send …; see docs/texts.md"]


def test_a_page_says_which_language_the_study_is_in(folder: Path) -> None:
    (folder / "steps" / "consent.html").write_text("<!doctype html>\n<HTML class=x lang='de-AT'><p>Hallo")
    (said,) = remarks(folder, SMALL)
    assert said.startswith("config.yml:1: remark: project: the study is in another language (de-AT), and ")
    (folder / "steps" / "consent.html").write_text('<html lang="en-GB"><p>Hello')
    assert remarks(folder, SMALL) == []


def test_only_one_text_that_stays_english_is_named(folder: Path) -> None:
    own = "".join(
        f"    {name}: x\n" for name in texts_of(has_game=False, has_sessions=False) if name not in ("send", "language")
    )
    (said,) = remarks(folder, with_texts(PAGES, f"    language: de\n{own}"))
    assert said.endswith("and one text of ours stays English: send; see docs/texts.md")


@pytest.mark.parametrize("texts", ["    continue: Next page\n", "    language: en-GB\n    continue: Next page\n"])
def test_a_study_in_english_gets_no_remark(folder: Path, texts: str) -> None:
    assert remarks(folder, with_texts(SMALL, texts)) == []


def test_a_study_needs_only_the_texts_that_its_participants_may_read() -> None:
    pages = texts_of(has_game=False, has_sessions=False)
    alone, together = texts_of(has_game=True, has_sessions=False), texts_of(has_game=True, has_sessions=True)
    assert {"continue", "studyFull"} <= set(pages) < set(alone) < set(together) == ENGLISH.keys()
    assert {"start", "saidGameFailed"} <= set(alone) - set(pages)
    assert {"firstOf", "you", "saidPing"} <= set(together) - set(alone)
