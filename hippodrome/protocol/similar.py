"""Finds the known name that was probably meant by an unknown one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

SIMILAR = 0.65
"""How similar an unknown name must be to a known one for a message to suggest it: difflib's ratio, from 0 to 1."""

SIMILAR_FILES = 0.75
"""The same for names of files. It is higher, because different names of files have words and endings in common."""


def nearest(name: str, names_known: Iterable[str], similar: float = SIMILAR) -> str | None:
    """Return the known name that is most similar to this one, whatever their case; None if no name is similar."""
    names = {candidate.lower(): candidate for candidate in names_known}
    matches = difflib.get_close_matches(name.lower(), names, n=1, cutoff=similar)
    return names[matches[0]] if matches else None


def did_you_mean(name: str, names_known: Iterable[str], similar: float = SIMILAR) -> str:
    """Return the end of a message about an unknown name: "; did you mean …?", or "" if no known name is similar."""
    near = nearest(name, names_known, similar)
    return f"; did you mean {near}?" if near else ""
