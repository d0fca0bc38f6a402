"""The texts that Hippodrome shows to participants: one table, and a study's own words instead of it."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest
import yaml

from hippodrome.control.config.__main__ import main as command
from hippodrome.control.model.texts import ENGLISH, GROUPS, IN_ENGLISH, IN_TALK, PLACE, SAID, Texts, places, texts_of
from hippodrome.control.participants import frame, game_modules, scripts
from hippodrome.control.participants.texts import NAMED, in_script, in_template
from hippodrome.trial.core import session, trial

ROOT = Path(__file__).resolve().parents[3]
WEB = ROOT / "hippodrome" / "web"
SOURCES = [*sorted(WEB.rglob("*.js")), *sorted(WEB.rglob("*.html"))]
PYTHON = sorted((ROOT / "hippodrome" / "control" / "participants").rglob("*.py"))
ALL_MODULES = (*game_modules.MODULES, *game_modules.OWN_WORDS, *game_modules.TOGETHER)
NO_TEXTS = re.compile(r"new Error\([^)]*\)|addStyle\(`[^`]*`\)")
WORD = re.compile(r"\b[A-Z][a-z]+\b")
NO_WORDS = {
    "ArrowUp",
    "ArrowLeft",
    "ArrowRight",
    "ArrowDown",
    "Digit",
    "Tab",
    "Numpad",
    "Key",
    "Space",
    "Meta",
    "Enter",
    "Escape",
    "Unreachable",
    "Arial",
    "Accept",
}
"""Names of keys, as browsers call them, of a font and of a header."""

OF_GAMES = {
    *("movedProgramTitle", "movedProgram", "picture", "pictures", "timeUpEnds"),
    *("playComputer", "beginWithFew", "aloneWithOne", "aloneWithSome", "playWithBoth"),
}
"""Texts that do not stand on a page of talk: on pictures, turns, computer players, and other front ends."""


@pytest.mark.parametrize("file", SOURCES, ids=lambda path: path.name)
def test_each_text_that_scripts_and_templates_name_is_in_the_table(file: Path) -> None:
    assert set(NAMED.findall(file.read_text())) <= ENGLISH.keys()


def test_each_text_is_used() -> None:
    named = {name for file in SOURCES for name in NAMED.findall(file.read_text())}
    python = "".join(file.read_text() for file in PYTHON)
    named |= set(NAMED.findall(python)) | set(re.findall(r"[\"'](\w+)[\"']", python))
    named |= set(IN_TALK.values())
    named |= {f"{name}Text" for name in named} | {"endedTitle", "failedTitle"} | set(SAID)
    assert ENGLISH.keys() - named == {"language"} - named


@pytest.mark.parametrize("file", sorted(WEB.rglob("*.js")), ids=lambda path: path.name)
def test_scripts_show_only_texts_of_the_table(file: Path) -> None:
    code = re.sub(r"(?m)^\s*//.*|\s// .*", "", file.read_text())
    literals = [found["text"] for found in frame._CODE_OR_TEXT.finditer(NO_TEXTS.sub("", code)) if found["text"]]
    words = {word for text in literals for word in WORD.findall(re.sub(r"\$\{[^}]*\}", "", text))}
    assert words - NO_WORDS == set()


def test_templates_show_only_texts_of_the_table() -> None:
    templates = [(WEB / name).read_text() for name in ("frame.html", "game.html", "lobby.html")]
    for template in [
        *templates,
        *(part for name, part in frame._PARTS.items() if name not in ("data", "end", "least")),
    ]:
        read = " ".join([re.sub(r"<[^>]*>", " ", template), *re.findall(r'aria-label="([^"]*)"', template)])
        assert re.findall(r"[A-Za-z]{2,}", re.sub(r"TEXT\.\w+|\$\w+", " ", read)) == []


@pytest.mark.parametrize(("name", "also"), [("game/main.js", ALL_MODULES), ("step.js", ())])
def test_each_text_gets_values_for_its_placeholders(name: str, also: tuple[str, ...]) -> None:
    # Raises ValueError if a value is missing.
    assert not NAMED.search(in_script(scripts.join(WEB / name, also), IN_ENGLISH))


def test_messages_of_servers_are_in_the_table() -> None:
    said = {
        *(getattr(session, name) for name in ("PARTNER_LEFT", "PARTNER_STOPPED", "PARTNER_MISSING", "LEFT", "PING")),
        *(getattr(trial, name) for name in ("EPISODE_FAILED", "EPISODE_BEGINS_AGAIN", "TRIAL_FAILED")),
    }
    assert set(SAID.values()) == said


def test_the_page_for_researchers_lists_all_texts() -> None:
    _, *sections = (ROOT / "docs" / "texts.md").read_text(encoding="utf-8").split("\n## ")
    listed = {part.split("\n")[0]: re.findall(r"^\| `(\w+)` \| (.*) \|$", part, re.MULTILINE) for part in sections}
    assert listed == {group: list(texts.items()) for group, texts in GROUPS.items()}


def test_the_english_texts_can_be_copied_and_lack_only_the_language(capsys: pytest.CaptureFixture[str]) -> None:
    file = (ROOT / "docs" / "texts.en.yml").read_text(encoding="utf-8")
    assert yaml.safe_load(file)["project"]["texts"] == {**ENGLISH, "language": None}
    assert command(["texts"]) == 0
    assert capsys.readouterr().out == file


def test_the_german_texts_are_complete() -> None:
    given = yaml.safe_load((ROOT / "docs" / "texts.de.yml").read_text(encoding="utf-8"))["project"]["texts"]
    assert list(given) == list(ENGLISH)
    assert given["language"] == "de"
    for name, text in given.items():
        assert set(places(text)) == set(places(ENGLISH[name])), name
    assert {name for name, text in given.items() if text == ENGLISH[name]} == {"start", "pause", "minutes"}


# A study's own words


def test_a_study_has_its_own_texts_and_otherwise_the_english_ones() -> None:
    texts = Texts({"start": "Los", "seconds": "{seconds} Sekunden", "unknown": "x"})
    assert texts["start"] == "Los"
    assert texts["pause"] == "Pause"
    assert texts.say("seconds", seconds=5) == "5 Sekunden"
    assert texts.say("minutes", minutes=1) == "1 min {seconds} s"
    assert texts.say("back", name="Ann") == "Ann is back."
    assert texts.language == "en"
    assert texts == Texts({"seconds": "{seconds} Sekunden", "start": "Los"}) != IN_ENGLISH
    assert hash(texts) == hash(Texts({"seconds": "{seconds} Sekunden", "start": "Los"}))


def test_a_page_of_talk_speaks_of_rounds_and_a_conversation_and_not_of_a_score() -> None:
    texts = Texts({"gameOf": "Runde {game}", "endRound": "Schluss", "reset": "Neu"}).in_talk()
    assert texts["gameOf"] == "Runde {game}"
    assert texts["reset"] == "Schluss"
    assert texts["gameOver"] == "Round {game} of {games} is over"
    assert texts["yourScore"] == ""
    assert Texts({})["gameOver"] == ENGLISH["gameOver"]
    for name, own in IN_TALK.items():
        assert set(places(ENGLISH[own])) == set(places(ENGLISH[name])), name


def test_a_page_of_talk_has_no_word_of_a_game() -> None:
    texts = Texts({}).in_talk()
    of_games = re.compile(r"\b(games?|play(ed|ing)?)\b", re.IGNORECASE)
    said = {name: PLACE.sub("", texts[name]) for name in texts_of(has_game=True, has_sessions=True) if name not in SAID}
    assert {name for name, text in said.items() if of_games.search(text)} == OF_GAMES
    assert not any(of_games.search(text) for text in texts.of_server().values())
    assert texts.of_server().keys() == set(SAID.values())


def test_the_page_gets_texts_for_messages_of_servers_only_if_the_study_has_its_own() -> None:
    assert IN_ENGLISH.of_server() == Texts({"start": "Los"}).of_server() == {}
    assert Texts({"saidPing": "Zu langsam."}).of_server() == {ENGLISH["saidPing"]: "Zu langsam."}


@pytest.mark.parametrize(
    ("code", "own", "filled"),
    [
        ("say(TEXT.start);", {}, 'say("Start");'),
        ("say(TEXT.seconds(left));", {}, "say(`${left} seconds`);"),
        ("say(TEXT.gameOver(f(a, [b, c]), { d }));", {}, "say(`Game ${f(a, [b, c])} of ${{ d }} is over`);"),
        ('say(TEXT.theirTurn(names.join(", ")));', {}, 'say(`Turn: ${names.join(", ")}`);'),
        ("say(`${TEXT.start}: ${TEXT.seconds(a)}!`);", {}, "say(`Start: ${a} seconds!`);"),
        ("say(TEXT.ifNobody(TEXT.seconds(a), TEXT.goWithout));", {"goWithout": "b", "ifNobody": "{next}"}, 'say(`${"b"}`);'),
        ("say(TEXT.gameOf(a, b));", {"gameOf": "{games}: {game}, {game}"}, "say(`${b}: ${a}, ${a}`);"),
        ("say(TEXT.gameOf(a, b));", {"gameOf": "Spiel"}, "say(`Spiel`);"),
    ],
)  # fmt: skip
def test_texts_stand_where_a_script_names_them(code: str, own: dict[str, str], filled: str) -> None:
    assert in_script(code, Texts(own)) == filled


def test_numbers_are_written_as_in_the_language_with_western_digits() -> None:
    code = "n.toLocaleString(TEXT.language)"
    assert in_script(code, IN_ENGLISH) == 'n.toLocaleString("en")'
    assert in_script(code, Texts({"language": "fa"})) == 'n.toLocaleString("fa-u-nu-latn")'
    assert in_script(code, Texts({"language": "zh-cmn"})) == 'n.toLocaleString("en")', "or no number could be written"


EVIL = "\"`\\ ${alert(1)} </script><!-- \u2028 {game} // '$game"


def test_texts_cannot_become_code() -> None:
    script = in_script(
        "say(TEXT.start); say(TEXT.gameOf(a, b)); say(`x${TEXT.start}`);", Texts({"start": EVIL, "gameOf": EVIL})
    )
    plain = json.dumps(EVIL, ensure_ascii=False).replace("<", "\\u003c").replace("\u2028", "\\u2028")
    inner = plain[1:-1].replace('\\"', '"').replace("`", "\\`").replace("$", "\\$")
    assert script == f"say({plain}); say(`{inner.replace('{game}', '${a}')}`); say(`x{inner}`);"
    assert "</" not in script
    assert "\u2028" not in script


def test_texts_cannot_become_html() -> None:
    own = Texts({"tell": '<b title="x">&$user ${x} {step}', "step": "{step} $user {x}"})
    assert in_template("TEXT.tell", own) == "&lt;b title=&quot;x&quot;&gt;&amp;$$user $${x} {step}"
    assert in_template("TEXT.step", own) == "${step} $$user {x}"
    assert frame.fill("progress", own, step=1, steps=2, done=0, all=1).startswith(
        '<label class="progress">1 $user {x} '
    )


def test_each_placeholder_of_a_text_is_listed_once() -> None:
    assert places("{a} {b} {a} {} {C} {b") == ("a", "b")
