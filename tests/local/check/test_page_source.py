"""The check reads a page in a time that grows with its text only, and finds what Jinja fills in."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as some

from hippodrome.control.participants import markup
from hippodrome.local.check import structure, tags
from hippodrome.local.check.page_source import PageSource

PIECES = ["{{", "}}", "{%", "%}", "{#", "#}", "{", "}", "%", "x", "\n", " ", "raw ", "endraw", "-"]


@given(some.lists(some.sampled_from(PIECES), max_size=12).map("".join))
def test_a_page_keeps_its_positions_and_lines_where_jinja_is_masked(text: str) -> None:
    expressions = list(re.finditer(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}", text, re.DOTALL))
    assert list(markup.expressions(text)) == [found.span() for found in expressions]
    masked = PageSource(text).text
    assert [len(line) for line in masked.split("\n")] == [len(line) for line in text.split("\n")]
    assert "".join(text[found.start() : found.end()].replace("\n", "") for found in expressions) == "".join(
        one for one, seen in zip(text, masked, strict=True) if seen == markup.MARK
    )


PAGES = ["{{", "{%", "{#", "{% raw", "<script>", "{{{%", "{{ {# ", "<script>{{", "{{}} {%", "<!--", "<script"]


def seconds(act: Callable[[], object]) -> float:
    """Return the processor's time that it takes, the least of three times."""
    times = []
    for _ in range(3):
        begun = time.process_time()
        act()
        times.append(time.process_time() - begun)
    return min(times)


def look(text: str) -> None:
    page = PageSource(text)
    structure.check_structure("a.html", page)
    tags.Tags("steps/a.html", [], None).read(page)


@pytest.mark.parametrize("piece", PAGES)
@pytest.mark.parametrize("then", ["", "}}", "%}"])
def test_the_time_for_marks_without_an_end_grows_linearly(piece: str, then: str) -> None:
    """Thirty times is far from both: ten is what grows with the text, and a hundred what grows with its square."""
    small, large = (piece * count + then for count in (2_000, 20_000))
    assert seconds(lambda: look(large)) < 30 * max(seconds(lambda: look(small)), 0.001)
