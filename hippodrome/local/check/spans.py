"""Finds the parts of a text between an opening and a closing mark, such as `{{ … }}`, in linear time.

A regular expression like `\\{\\{.*?\\}\\}` takes quadratic time: it reads the rest of the text at each unclosed mark.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import NamedTuple


class Marks(NamedTuple):
    """The opening and the closing mark of a span."""

    opening: re.Pattern[str]
    closing: re.Pattern[str]


VALUE = Marks(re.compile(r"\{\{"), re.compile(r"\}\}"))
BLOCK = Marks(re.compile(r"\{%"), re.compile(r"%\}"))
NOTE = Marks(re.compile(r"\{#"), re.compile(r"#\}"))
RAW = Marks(re.compile(r"\{%-?\s*+raw\b"), re.compile(r"endraw\s*+-?%\}"))
COMMENT = Marks(re.compile(r"<!--"), re.compile(r"-->"))
SCRIPT = Marks(
    re.compile(r"<script\b[^>]*+(?:>|\Z)", re.IGNORECASE), re.compile(r"</script\s*+(?:>|\Z)", re.IGNORECASE)
)

JINJA = (VALUE, BLOCK, NOTE)
MARK = "\ue000"
"""A private character that takes the place of each Jinja expression, whose value is not known."""


class Span(NamedTuple):
    """The positions of a span (`start` to `end`) and of its inside (`inside` to `until`)."""

    start: int
    inside: int
    until: int
    end: int


def spans(text: str, *kinds: Marks) -> Iterator[Span]:
    """Yield the spans of these kinds, from left to right. No span begins inside of another or at an unclosed mark."""
    at = 0
    following = {kind: kind.opening.search(text) for kind in kinds}
    while True:
        for kind, following_match in following.items():
            if following_match and following_match.start() < at:
                following[kind] = kind.opening.search(text, at)
        first = min(((match.start(), n) for n, match in enumerate(following.values()) if match), default=None)
        if first is None:
            return
        kind = list(following)[first[1]]
        opening = following[kind]
        closing = kind.closing.search(text, opening.end()) if opening else None
        if opening is None or closing is None:
            following[kind] = None  # as this one is not closed, no later one is
            continue
        at = closing.end()
        yield Span(opening.start(), opening.end(), closing.start(), at)


def replace(text: str, by: Callable[[str], str], *kinds: Marks) -> str:
    """Return the text with each span of these kinds replaced by what `by` returns for the text of the span."""
    parts, at = [], 0
    for span in spans(text, *kinds):
        parts += [text[at : span.start], by(text[span.start : span.end])]
        at = span.end
    return "".join([*parts, text[at:]])


def lines(text: str) -> str:
    """Return only the line ends of a text. If they take the text's place, later lines keep their numbers."""
    return "\n" * text.count("\n")
