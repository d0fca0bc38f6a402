"""Python's HTML parser for pages as people write them: it reads to the end what browsers read."""

from __future__ import annotations

from html.parser import HTMLParser


class PageParser(HTMLParser):
    """An HTMLParser that takes `<![…]>` for a comment, as browsers do, where Python's raises AssertionError."""

    def parse_marked_section(self, i: int, report: bool = True) -> int:
        """The place after the section that begins at `i`; -1 if its end is not there yet."""
        try:
            return super().parse_marked_section(i, report)
        except AssertionError:
            return self.parse_bogus_comment(i, report)
