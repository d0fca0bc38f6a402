"""Texts of others as parts of messages."""

from __future__ import annotations

from hippodrome.config.diagnostics import printable

LIMIT = 300  # characters of a text of others


def short(text: str) -> str:
    """The text on one line, cut after LIMIT characters, without invisible characters."""
    return printable(" ".join(text.split()), LIMIT)
