"""Reads the tags of a page as browsers do: what participants get, the check, bots and tables all read pages by this.

A researcher's page may hold Jinja: `expressions` finds it, so that it can be set aside, and `a < b` in it is no tag.
"""

from __future__ import annotations

import html
import re
from collections.abc import Iterator
from typing import NamedTuple

VOID = frozenset(
    ("area", "base", "br", "col", "embed", "frame", "hr", "img", "input", "link", "meta", "param", "source", "track")
) | {"wbr"}
"""Elements without an end tag."""
RAW = frozenset({"script", "style", "textarea", "title", "iframe", "xmp", "noembed", "noframes"})
"""Elements whose content is text: no tag begins in it."""
MARK = "\ue000"
"""A private character that may take the place of a Jinja expression, whose value is not known."""

_JINJA_START = re.compile(rf"\{{[{{%#]|{MARK}")
_JINJA_END = {"{{": "}}", "{%": "%}", "{#": "#}"}
_TOKEN = re.compile(
    r"""
      <!--(?:>|->|(?P<comment>.*?)(?:--!?>|(?P<open>\Z)))
    | <[!?](?P<declaration>[^>]*+)>?
    | </(?P<end>[a-zA-Z][^\s/>]*+)[^>]*+>?
    | <(?P<start>[a-zA-Z][^\s/>]*+)(?P<attributes>(?:=\s*+(?:"[^"]*+"|'[^']*+')|[^>])*+)>?
    """,
    re.VERBOSE | re.DOTALL,
)
ATTRIBUTE = re.compile(
    r"""(?P<name>[^\s/>=][^\s/>=]*+)(?:\s*+=\s*+(?P<value>"[^"]*+"|'[^']*+'|[^\s>"'][^\s>]*+))?""", re.DOTALL
)
"""One attribute of a tag, with the quotes around its value."""


class Token(NamedTuple):
    """A tag, comment or declaration. The last one of a page is empty: the text before it ends the page."""

    before: str
    """The text between the last token and this one."""
    source: str
    """The token as it is written."""
    at: int
    """Where it begins in the page."""
    start: str = ""
    """The name of a start tag, in lower case."""
    end: str = ""
    """The name of an end tag, in lower case."""
    attributes: str = ""
    """Those of a start tag, as they are written (`attributes`)."""
    content: str = ""
    """For an element in `RAW`: all up to its end tag."""
    end_tag: str = ""
    """For an element in `RAW`: its end tag as it is written; empty if it never ends."""
    is_comment: bool = False
    is_closed: bool = True
    """Whether the token ends before the page does."""


def tokens(page: str) -> Iterator[Token]:
    """Yield the tags, comments and declarations of a page. No page makes this raise, or takes more than linear time."""
    at = 0
    while found := _TOKEN.search(page, at):
        before, at = page[at : found.start()], found.end()
        start, end = (found["start"] or "").lower(), (found["end"] or "").lower()
        content = end_tag = ""
        if start in RAW and found[0].endswith(">"):
            content, end_tag = _content(page, start, at)
            at += len(content) + len(end_tag)
        attributes = found["attributes"] or ""
        is_comment = found[0].startswith("<!--")
        is_closed = found["open"] is None if is_comment else found[0].endswith(">")
        yield Token(before, found[0], found.start(), start, end, attributes, content, end_tag, is_comment, is_closed)
    yield Token(page[at:], "", len(page))


def attributes(written: str) -> dict[str, str]:
    """Return the values of attributes by their names in lower case. Of two with one name, the first counts."""
    values: dict[str, str] = {}
    for attribute in ATTRIBUTE.finditer(written):
        value = attribute["value"] or ""
        value = value[1:-1] if value[:1] in ('"', "'") else value
        values.setdefault(attribute["name"].lower(), html.unescape(value))
    return values


def expressions(source: str) -> Iterator[tuple[int, int]]:
    """Yield the place of each Jinja expression, from its begin to its end. A MARK in the source counts as one."""
    at = 0
    unclosed: set[str] = set()
    while opening := _JINJA_START.search(source, at):
        at = opening.end()
        if closer := _JINJA_END.get(opening[0]):
            if closer in unclosed or (end := source.find(closer, at)) == -1:
                unclosed.add(closer)
                continue
            at = end + 2
        yield opening.start(), at


def _content(page: str, name: str, at: int) -> tuple[str, str]:
    """The content from `at` on of an element in `RAW`, and its end tag, which is empty if the element never ends.

    Only the first end tag counts: if no ">" follows it, none follows a later one either.
    """
    end = re.compile(rf"</{name}(?=[\s/>])", re.IGNORECASE).search(page, at)
    if end is None or (close := page.find(">", end.end())) == -1:
        return page[at:], ""
    return page[at : end.start()], page[end.start() : close + 1]
