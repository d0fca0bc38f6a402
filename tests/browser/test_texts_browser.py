"""A study's own texts in a real browser: pages show each character as it is; none becomes code or markup."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import msgspec
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hippodrome.control.model.project import Project
from hippodrome.control.model.texts import ENGLISH, LANGUAGE, PLACE, Texts, is_language, places
from hippodrome.control.participants import pages
from hippodrome.control.participants.frame import message_page
from hippodrome.control.participants.texts import in_script
from tests.control.participants.test_pages import LOBBY, PROJECT, game, step_view

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]

PARTS = (
    *("`", "$", "${", "{", "}", "{{", "\\", '"', "'", "$$", "${alert(1)}", "\\u0041", "\\x4", "\\1", "//", "/*", "*/"),
    *("</script>", "<!--", "-->", "&amp;", "<b>", "\u2028", "\u2029", "\n", "\r", "\0", "\ufeff", "😀"),
    *("{seconds}", "{time}", "{game}", "{games}", "{step}", "TEXT.start", "TEXT.seconds(1)", "$step", "__proto__"),
)
WORDS = st.lists(
    st.one_of(st.sampled_from(PARTS), st.text(st.characters(exclude_categories=["Cs"]), max_size=3)), max_size=8
).map("".join)


def with_place_names(texts: Texts, name: str) -> str:
    """Return the text with each placeholder replaced by its name."""
    known = places(ENGLISH[name])
    return PLACE.sub(lambda place: place[1] if place[1] in known else place[0], texts[name])


@example(own={"start": "{a$"})  # each text stands twice, once right behind itself
@given(own=st.dictionaries(st.sampled_from(sorted(ENGLISH)), WORDS, min_size=1, max_size=12))
def test_a_script_shows_the_studys_own_texts(tab: Any, own: dict[str, str]) -> None:
    texts, lines, wanted = Texts({name: text for name, text in own.items() if name != LANGUAGE}), [], []
    for name in own.keys() - {LANGUAGE}:
        given_places = ", ".join(map(json.dumps, places(ENGLISH[name])))
        named, text = f"TEXT.{name}" + (f"({given_places})" if given_places else ""), with_place_names(texts, name)
        lines += [named, f"`a${{{named}}}{{b`", f"`${{{named}}}${{{named}}}`"]
        wanted += [text, f"a{text}{{b", f"{text}{text}"]
    assert tab.evaluate(in_script(f"[{', '.join(lines)}]", texts)) == wanted


@given(language=st.from_regex(r"[A-Za-z]{2,3}(-[A-Za-z]{4})?(-[A-Za-z0-9]{2,3})?(-[A-Za-z0-9]{4,8})?", fullmatch=True))
def test_numbers_can_be_written_in_each_language(tab: Any, language: str) -> None:
    code = in_script("(12.5).toLocaleString(TEXT.language)", Texts({LANGUAGE: language}))
    assert re.fullmatch("12.5", tab.evaluate(code))
    valid = "language => { try { return Boolean(new Intl.Locale(language)); } catch { return false; } }"
    assert tab.evaluate(valid, language) == is_language(language)


HOSTILE = "</script><b title='x' id=\"y\">&amp;</b><!-- ${alert(1)} `\\` $step $ {x} \u2028 __proto__ $"
OWN = {name: HOSTILE + "".join(f"{{{place}}}" for place in places(text)) for name, text in ENGLISH.items()}
READ = """html => {
    const parsed = new DOMParser().parseFromString(html, "text/html");
    const Script = (async () => {}).constructor;
    const all = [...parsed.querySelectorAll("*")];
    const scripts = all.filter((each) => each.localName === "script");
    const data = scripts.find((each) => each.type === "application/json");
    for (const each of scripts) if (each !== data) new Script(each.textContent); // throws if it is none
    const read = all.filter((each) => !["script", "style"].includes(each.localName));
    const words = read.flatMap((each) => [each.getAttribute("aria-label"), each.children.length ? "" : each.textContent]);
    return {
        elements: all.map((each) => [each.localName, ...each.getAttributeNames()].join(" ")),
        words: [parsed.documentElement.lang, ...words.filter(Boolean)],
        said: (data && JSON.parse(data.textContent).said) ?? {},
    };
}"""
"""The elements of a page with the names of their attributes, and what it says. None of its scripts runs."""
VIEWS: dict[str, Callable[[Project], str]] = {
    "step": lambda study: pages.step_page(replace(step_view("<input name=a>"), project=study)).html,
    "sent": lambda study: (
        pages.step_page(replace(step_view("<input name=a>", at=4, answered=True), project=study)).html
    ),
    "waiting": lambda study: game(study).html,
    "moved": lambda study: game(study, replaces=True).html,
    "failed": lambda study: game(study, state="failed", again=True, reason="lost").html,
    "ended": lambda study: game(study, state="ended").html,
    "lobby": lambda study: game(msgspec.structs.replace(study, players=3), **LOBBY | {"players": 3}).html,
    "session": lambda study: game(msgspec.structs.replace(study, players=2), session=True, members=2).html,
    "message": lambda study: (
        message_page(
            Texts(study.texts)["studyFull"], Texts(study.texts)["studyFullText"], lang=Texts(study.texts).language
        ).html
    ),
}


@pytest.mark.parametrize("view", VIEWS)
def test_no_text_becomes_code_or_markup_in_a_page(tab: Any, view: str) -> None:
    english, hostile = (
        tab.evaluate(READ, VIEWS[view](msgspec.structs.replace(PROJECT, texts=own))) for own in ({}, OWN)
    )
    assert hostile["elements"] == english["elements"]
    assert hostile["words"][0] == HOSTILE  # the language
    theirs = [text for text, ours in zip(hostile["words"], english["words"], strict=True) if text != ours]
    assert len(theirs) > 2
    assert all(HOSTILE in text for text in theirs)
    assert set(hostile["said"].values()) == ({HOSTILE} if hostile["said"] else set())
