"""A researcher's page as the check reads it: what Jinja fills in is masked, and each tag has its line."""

from __future__ import annotations

import re
from collections.abc import Iterator

from hippodrome.control.participants import markup
from hippodrome.control.participants.markup import MARK, Token

_RAW = re.compile(r"\{%[-+]?\s*(?P<end>end)?raw\b")


class PageSource:
    """The text of a page. In `text` each character of a Jinja expression is a MARK, so that all positions stay."""

    def __init__(self, source: str) -> None:
        self.values: list[tuple[int, str]] = []
        """The expressions `{{ … }}` and their positions; none inside of `{% raw %}`."""
        self.blocks: list[int] = []
        """The positions of `{% … %}`, between which a page may show one thing or another."""
        parts, at, is_raw = [], 0, False
        for start, end in markup.expressions(source):
            expression = source[start:end]
            parts += [source[at:start], re.sub(r"[^\n]", MARK, expression)]
            at = end
            if raw := _RAW.match(expression):
                is_raw = raw["end"] is None
            elif not is_raw and expression.startswith("{{"):
                self.values.append((start, expression))
            elif not is_raw and expression.startswith("{%"):
                self.blocks.append(start)
        self.text = "".join([*parts, source[at:]])

    def tokens(self) -> Iterator[tuple[int, Token]]:
        """Yield the line of each tag, comment and declaration, and the token itself."""
        line, at = 1, 0
        for token in markup.tokens(self.text):
            line += self.text.count("\n", at, token.at)
            at = token.at
            yield line, token
