"""The key `texts`: the message for each mistake, and the remarks on texts that stay English."""

from __future__ import annotations

import json
from pathlib import Path

import msgspec
import pytest

from hippodrome.control.config import parse_registration, read_project
from hippodrome.control.config.remarks import remarks_on
from hippodrome.control.model.project import Project
from hippodrome.control.model.texts import ENGLISH, texts_of
from tests.control.config.folder import SMALL, only_mistake, read, small

ROOT = Path(__file__).parents[3]
GERMAN = (ROOT / "docs" / "texts.de.yml").read_text(encoding="utf-8")
PAGES = """\
project:
  id: small
  steps:
    1: consent
    2: thanks
"""


def with_lines_of_texts(config: str, texts: str) -> str:
    """Return the configuration with these lines of texts."""
    return config.replace("project:\n", f"project:\n  texts:\n{texts}", 1)


def remarks(folder: Path, config: str) -> list[str]:
    """Return the remarks on texts."""
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
        (
            '{step: "{step} {of {steps}"}',
            "project.texts.step: participants would read {, a brace too many; there are {step} and {steps}",
        ),
        (
            '{seconds: "{{seconds}}"}',
            "project.texts.seconds: participants would read {, a brace too many; there is {seconds}",
        ),
        (
            '{start: "Los }"}',
            "project.texts.start: participants would read }, a brace too many; this text has no placeholders",
        ),
        (
            "{language: fr-FRA}",
            'project.texts.language: must be a language as pages name it, such as de or pt-BR, not "fr-FRA"',
        ),
        ('{start: "Los {}"}', "project.texts.start: nothing stands for {} here; this text has no placeholders"),
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
        (
            "{language: zh-cmn}",
            'project.texts.language: must be a language as pages name it, such as de or pt-BR, not "zh-cmn"',
        ),
        ("Los", 'project.texts: must be a section: indented lines such as "start: "Los"" below it, not "Los"'),
    ],
)
def test_a_mistake_in_texts_gets_a_message(folder: Path, texts: str, said: str) -> None:
    assert only_mistake(folder, small(project=f"texts: {texts}\n")) == said


def test_a_mistake_is_named_with_its_line(folder: Path) -> None:
    (folder / "config.yml").write_text(with_lines_of_texts(SMALL, '    start: Los\n    seconds: "{s}"\n'))
    with pytest.raises(Exception, match=r"config\.yml:4: project\.texts\.seconds: nothing stands for \{s\}"):
        read_project(folder)


def test_empty_texts_count_as_not_given(folder: Path) -> None:
    config = read(folder, with_lines_of_texts(SMALL, "    start: Los\n    pause:\n    goOn: ''\n    second: 1\n"))
    assert config.registration()["texts"] == {"start": "Los", "second": "1"}


def test_texts_are_registered_unchanged(folder: Path) -> None:
    registration = read(
        folder, with_lines_of_texts(SMALL, "    start: <b> & „Los“\n    language: pt-BR\n")
    ).registration()
    found = parse_registration(json.loads(json.dumps(registration)))
    assert msgspec.convert(found, Project).texts == {"start": "<b> & „Los“", "language": "pt-BR"}


def test_the_german_texts_are_without_mistakes_and_remarks(folder: Path) -> None:
    together = SMALL.replace("project:\n", "project:\n  players: 2\n") + "  players: {a: human, b: human}\n"
    config = together.replace("project:\n", GERMAN[GERMAN.index("project:\n") :], 1)
    assert remarks(folder, config) == []
    assert read(folder, config).project.own_texts.keys() == ENGLISH.keys()


def test_texts_that_stay_english_get_one_remark(folder: Path) -> None:
    pages = texts_of(has_game=False, has_sessions=False)
    said = remarks(folder, with_lines_of_texts(PAGES, "    language: de\n    step: Schritt\n    continue: Weiter\n"))
    which = f"the study is in another language (de), and {len(pages) - 3} of Hippodrome's texts stay English"
    assert said == [f"config.yml:2: remark: project.texts: {which}: titleStep, studyBy, send …; see docs/texts.md"]


ALL_ENGLISH = (ROOT / "docs" / "texts.en.yml").read_text(encoding="utf-8").partition("project:\n")[2]


def test_sentences_that_were_copied_and_not_translated_stay_english(folder: Path) -> None:
    texts = ALL_ENGLISH.replace("    language:", "    language: fr").replace("A study by", "Une étude de")
    (said,) = remarks(folder, PAGES.replace("  id: small\n", f"  id: small\n{texts}"))
    assert "(fr), and 40 of Hippodrome's texts stay English: saved, stillSending, noReply …; see" in said


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
    (said,) = remarks(folder, with_lines_of_texts(PAGES, f"    language: de\n{own}"))
    assert said.endswith("and one of Hippodrome's texts stays English: send; see docs/texts.md")


@pytest.mark.parametrize("texts", ["    continue: Next page\n", "    language: en-GB\n    continue: Next page\n"])
def test_a_study_in_english_gets_no_remark(folder: Path, texts: str) -> None:
    assert remarks(folder, with_lines_of_texts(SMALL, texts)) == []


@pytest.mark.parametrize(
    "language", ["en", "fil", "pt-BR", "es-419", "zh-Hant-TW", "sr-Latn", "de-CH-1996", "ca-ES-valencia"]
)
def test_a_language_with_its_script_region_and_variant(folder: Path, language: str) -> None:
    assert read(folder, with_lines_of_texts(SMALL, f"    language: {language}\n")).project.own_texts == {
        "language": language
    }
