"""Parts of messages."""

from __future__ import annotations

from hippodrome.config.diagnostics import printable

LIMIT = 300  # characters of a message that is not ours


def short(text: str) -> str:
    """The text on one line, cut short, with nothing invisible in it."""
    return printable(" ".join(text.split()), LIMIT)
