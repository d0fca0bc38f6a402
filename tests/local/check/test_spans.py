"""Spans between marks: the same as a regular expression finds, but in a time that grows with the text only."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as some

from hippodrome.local.check import spans, structure, tags

PIECES = ["{{", "}}", "{%", "%}", "{#", "#}", "{", "}", "%", "x", "\n", " ", "raw ", "endraw", "-"]


@given(some.lists(some.sampled_from(PIECES), max_size=12).map("".join))
def test_spans_are_those_of_a_regular_expression(text: str) -> None:
    expected = re.sub(r"\{\{.*?\}\}|\{%.*?%\}|\{#.*?#\}", "_", text, flags=re.DOTALL)
    assert spans.replace(text, lambda span: "_", spans.VALUE, spans.BLOCK, spans.NOTE) == expected
    raw = re.sub(r"\{%-?\s*raw\b.*?endraw\s*-?%\}", "_", text, flags=re.DOTALL)
    assert spans.replace(text, lambda span: "_", spans.RAW) == raw


@given(some.lists(some.sampled_from(["<script", ">", " src=x", "</script", "x", "\n"]), max_size=12).map("".join))
def test_scripts_are_those_of_a_regular_expression(text: str) -> None:
    expected = [found[1] for found in re.finditer(r"<script\b[^>]*>(.*?)</script\s*(?:>|\Z)", text, re.DOTALL)]
    assert [text[span.inside : span.until] for span in spans.spans(text, spans.SCRIPT)] == expected


PAGES = ["{{", "{%", "{#", "{% raw", "<script>", "{{{%", "{{ {# ", "<script>{{", "{{}} {%"]
MARKS = [(spans.COMMENT, "<!--"), (spans.SCRIPT, "<script"), (spans.SCRIPT, "<script>"), (spans.RAW, "{% raw %}")]


def seconds(act: Callable[[], object]) -> float:
    """Return the processor's time that it takes, the least of three times."""
    times = []
    for _ in range(3):
        begun = time.process_time()
        act()
        times.append(time.process_time() - begun)
    return min(times)


def look(text: str) -> None:
    structure.check_structure("a.html", text)
    tags.Tags("steps/a.html", [], None).read(text)


@pytest.mark.parametrize("piece", PAGES)
@pytest.mark.parametrize("then", ["", "}}", "%}"])
def test_the_time_for_marks_without_an_end_grows_linearly(piece: str, then: str) -> None:
    """Thirty times is far from both: ten is what grows with the text, and a hundred what grows with its square."""
    small, large = (piece * count + then for count in (2_000, 20_000))
    assert seconds(lambda: look(large)) < 30 * max(seconds(lambda: look(small)), 0.001)


@pytest.mark.parametrize(("kind", "piece"), MARKS)
def test_the_time_of_the_html_parser_grows_linearly(kind: spans.Marks, piece: str) -> None:
    small, large = (piece * count for count in (2_000, 20_000))
    few, many = (seconds(lambda text=text: list(spans.spans(text, kind))) for text in (small, large))
    assert many < 30 * max(few, 0.001)
