"""Parts of messages."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

from hippodrome.config.diagnostics import printable

LIMIT = 300  # characters of a message that is not ours


def short(text: str) -> str:
    """The text on one line, cut short, with nothing invisible in it."""
    return printable(" ".join(text.split()), LIMIT)


def nearest(name: str, known: Iterable[str]) -> str:
    """ "; did you mean …?" if one of the known names is nearly this one; otherwise nothing."""
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.75)
    return f"; did you mean {near[0]}?" if near else ""
