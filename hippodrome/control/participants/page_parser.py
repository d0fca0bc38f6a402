"""Python's HTML parser, changed so that it reads to the end every page that browsers read."""

from __future__ import annotations

from collections.abc import Iterable
from html.parser import HTMLParser

VOID = frozenset(
    ("area", "base", "br", "col", "embed", "frame", "hr", "img", "input", "link", "meta", "param", "source", "track")
) | {"wbr"}
"""Elements without an end tag."""


class PageParser(HTMLParser):
    """An HTMLParser that reads `<![…]>` as a comment, as browsers do. Python's may raise AssertionError there."""

    def parse_marked_section(self, i: int, report: bool = True) -> int:
        """Return the index after the section that begins at `i`; -1 if the text has no end of it yet."""
        try:
            return super().parse_marked_section(i, report)
        except AssertionError:
            return self.parse_bogus_comment(i, report)


def attributes_of(attrs: Iterable[tuple[str, str | None]]) -> dict[str, str]:
    """Return a tag's attributes by name. If it has two of one name, the first counts, as in browsers."""
    attributes: dict[str, str] = {}
    for name, value in attrs:
        attributes.setdefault(name, value or "")
    return attributes
