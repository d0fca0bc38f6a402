"""Shortens texts that others wrote, such as an error of the agent, so that messages can quote them."""

from __future__ import annotations

from hippodrome.protocol.values import printable

LIMIT = 300  # characters of a quoted text


def short(text: str) -> str:
    """Return the text on one line, without invisible characters and cut after LIMIT characters."""
    return printable(" ".join(text.split()), LIMIT)
