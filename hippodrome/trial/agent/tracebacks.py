"""Formats errors of the researcher's code for the log, and keeps participants' ids out of it."""

from __future__ import annotations

import logging
import re
import traceback
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

_OURS = Path(__file__).resolve().parents[1]
_MAX_CHAIN = 20


def report(error: BaseException, folder: Path, private: Iterable[str] = ()) -> str:
    """Format the traceback, and after it the place in the folder's files and the error: `agent.py:30: NameError: …`.

    The last line has the whole message of the error. The participants' ids in `private` are replaced (`without`).
    """
    whole, last = traceback.format_exception(error), traceback.format_exception_only(error)
    frames = whole[: -len(last)] if whole[-len(last) :] == last else whole
    indented = [part for part in last if part.startswith(" ")]  # a SyntaxError quotes the line of the file
    message = " ".join("".join(part for part in last if part not in indented).split())
    message = message.removeprefix("hippodrome.trial.agent.loading.").removeprefix("hippodrome.trial.core.effects.")
    place = where(error, folder)
    return without(private, "".join([*frames, *indented]) + (f"{place}: {message}" if place else message))


def where(error: BaseException, folder: Path) -> str | None:
    """Return the innermost line of the researcher's code in the traceback, as `agent.py:30`; None if it has none."""
    for each in _chain(error):
        places = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(each.__traceback__)]
        if isinstance(each, SyntaxError) and each.filename:
            places.append((each.filename, each.lineno))
        for filename, number in reversed(places):
            own = _own_path(Path(filename), folder)
            if own is not None and number:
                return f"{own}:{number}"
    return None


def _own_path(path: Path, folder: Path) -> str | None:
    """Return the file's path in the folder; None if it is outside, or of an installed package or of Hippodrome."""
    if not path.is_relative_to(folder) or path.is_relative_to(_OURS):
        return None
    inside = path.relative_to(folder)
    library = any(part == "site-packages" or part.startswith(".") for part in inside.parts)
    return None if library else inside.as_posix()


def _chain(error: BaseException) -> Iterator[BaseException]:
    """Yield the error and the errors that led to it, the latest first."""
    cause: BaseException | None = error
    for _ in range(_MAX_CHAIN):
        if cause is None:
            return
        yield cause
        cause = cause.__cause__ or (None if cause.__suppress_context__ else cause.__context__)


def without(private: Iterable[str], text: str) -> str:
    """Replace these ids of participants by `(participant)`, except ids that are numbers of up to five digits."""
    # Ids that are small numbers stay, since every traceback has such numbers. The longest id comes first, since a
    # shorter one may be its beginning.
    ids = [each for each in sorted(private, key=len, reverse=True) if each and not (each.isdigit() and len(each) < 6)]
    if not ids:
        return text
    return re.sub(rf"(?<!\w)(?:{'|'.join(map(re.escape, ids))})(?!\w)", "(participant)", text)


class IdFilter(logging.Filter):
    """Removes participants' ids from the logger's lines and tracebacks. `ids` returns the ids of those who play now."""

    def __init__(self, ids: Callable[[], Iterable[str]]) -> None:
        super().__init__()
        self._ids = ids

    def filter(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = without(self._ids(), record.getMessage()), None
        if record.exc_info:  # handlers write `exc_text` if it is there, and make none of their own
            record.exc_text = without(self._ids(), logging.Formatter().formatException(record.exc_info))
        return True
