"""Errors of the researcher's code, for the log."""

from __future__ import annotations

import re
import traceback
from collections.abc import Iterable, Iterator
from pathlib import Path

_OURS = Path(__file__).resolve().parents[1]
_LONGEST_CHAIN = 20


def report(error: BaseException, folder: Path, private: Iterable[str] = ()) -> str:
    """The traceback. Its last line says where in the folder's files, and what: `agent.py:30: NameError: …`.

    The whole message of the error is in that line. `private`, ids of participants, are left out.
    """
    whole, only = traceback.format_exception(error), traceback.format_exception_only(error)
    frames = whole[: -len(only)] if whole[-len(only) :] == only else whole
    indented = [part for part in only if part.startswith(" ")]  # the line that is no Python
    words = " ".join("".join(part for part in only if part not in indented).split()).removeprefix("trial.agent.agent.")
    place = where(error, folder)
    return without(private, "".join([*frames, *indented]) + (f"{place}: {words}" if place else words))


def where(error: BaseException, folder: Path) -> str | None:
    """The innermost line of the researcher's own that led to the error, as `agent.py:30`; None if there is none."""
    for each in _chain(error):
        places = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(each.__traceback__)]
        if isinstance(each, SyntaxError) and each.filename:
            places.append((each.filename, each.lineno))
        for filename, number in reversed(places):
            own = _own(Path(filename), folder)
            if own is not None and number:
                return f"{own}:{number}"
    return None


def _own(path: Path, folder: Path) -> str | None:
    """The file's name within the folder, unless it is a library's or ours."""
    if not path.is_relative_to(folder) or path.is_relative_to(_OURS):
        return None
    inside = path.relative_to(folder)
    library = any(part == "site-packages" or part.startswith(".") for part in inside.parts)
    return None if library else inside.as_posix()


def _chain(error: BaseException) -> Iterator[BaseException]:
    each: BaseException | None = error
    for _ in range(_LONGEST_CHAIN):
        if each is None:
            return
        yield each
        each = each.__cause__ or (None if each.__suppress_context__ else each.__context__)


def without(private: Iterable[str], text: str) -> str:
    """The text without these ids of participants."""
    # Short numbers are left: they are in every traceback. Of two ids that begin alike, the longer one is found first.
    ids = [each for each in sorted(private, key=len, reverse=True) if each and not (each.isdigit() and len(each) < 6)]
    if not ids:
        return text
    return re.sub(rf"(?<!\w)(?:{'|'.join(map(re.escape, ids))})(?!\w)", "(participant)", text)
