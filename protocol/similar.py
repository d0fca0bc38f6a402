"""Which known name was probably meant by a name that is not known."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

SIMILAR = 0.65
"""How alike two names must be for a message to ask whether one was meant by the other: difflib's ratio, from 0 to 1."""

SIMILAR_FILES = 0.75
"""The same for files: their names are words and have common endings, so unlike ones look more alike."""


def nearest(name: str, known: Iterable[str], similar: float = SIMILAR) -> str | None:
    """The known name that is most like this one, in upper or lower case; None if no name is alike enough."""
    names = {each.lower(): each for each in known}
    near = difflib.get_close_matches(name.lower(), names, n=1, cutoff=similar)
    return names[near[0]] if near else None


def did_you_mean(name: str, known: Iterable[str], similar: float = SIMILAR) -> str:
    """The end of a message about an unknown name: "; did you mean …?", or nothing if no known name is alike enough."""
    near = nearest(name, known, similar)
    return f"; did you mean {near}?" if near else ""
