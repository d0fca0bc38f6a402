"""What the process of a tried agent reports, as JSON, before it makes each call; `agent_report.py` reads it."""

from __future__ import annotations

import faulthandler
import json
import math
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hippodrome.local.check.remedies import remedy
from hippodrome.local.check.wording import short
from hippodrome.protocol.values import printable
from hippodrome.trial.agent import match
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.recorded_values import Values

_LOOKED_AT = 1_000  # the most values, and elements of an array, in which objects that are kept as text are looked for


class AgentProgress:
    """Reports each call before it is made: if the process ends or hangs in it, the report names it.

    When the time is over, the process ends, and `report.stack` says in which line each thread was.
    """

    def __init__(self, report: Path, folder: Path, settings: Mapping[str, Any], early: Sequence[Any] = ()) -> None:
        """`folder` has agent.py.

        `settings`: the seconds for all calls together (`seconds`), for each that a server limits (`callSeconds`) and of
        playing (`playSeconds`), and the most steps (`playSteps`).

        `early`: lines that read the participant too early, as variable, file and line.
        """
        self._report, self._folder = report, folder
        self._stack = report.with_suffix(".stack").open("w")
        self._over_at, self._settings = time.monotonic() + settings["seconds"], settings
        self._limits = {"match": match.SECONDS, **dict.fromkeys(("reset", "step", "render"), settings["callSeconds"])}
        self._played_at = math.inf
        self._kinds: set[str] = set()  # the kinds of values on which a remark was made
        self._problems: list[dict[str, Any]] = []
        self.facts: dict[str, Any] = {
            "episodes": 0,
            "steps": 0,
            "action": 0,
            "early": early,
            "problems": self._problems,
        }
        self.callbacks: Any = None
        self.result: Any = None
        """What the last call returned."""
        self._loaded_before = _installed_modules()
        report.touch()
        self._end_after(settings["seconds"])

    def time_over(self) -> bool:
        """Return whether no more steps should be taken: there were enough, or the time of playing is over.

        The time counts from the end of the first step.
        """
        if self.facts["steps"] == 1 and self._played_at == math.inf:
            self._played_at = time.monotonic() + self._settings["playSeconds"]
        return self.facts["steps"] >= self._settings["playSteps"] or time.monotonic() > self._played_at

    def call(self, name: str, function: Callable[[], Any]) -> bool:
        """Report the name, call the function and keep its `result`. Return False if it raised, which is reported."""
        seconds_left = max(0.001, self._over_at - time.monotonic())  # faulthandler refuses 0
        limit = self._limits.get(name, math.inf)
        self._end_after(min(limit, seconds_left))
        self._write(call=name, within=limit if limit < seconds_left else None)
        try:
            self.result = function()
        except BaseException as error:  # noqa: BLE001 - SystemExit in a researcher's code is a failure too
            self._write(call=name, error=_described(error, self._folder))
            return False
        return True

    def problem(self, place: str | tuple[Any, ...], message: str, *, remark: bool = True) -> None:
        """Report a problem with which the game goes on, once.

        `place` is a method of the agent, a file and its line, or the path of a key that begins with `trial`.
        """
        problem = {"place": place, "message": message, "remark": remark}
        if problem not in self._problems:
            self._problems.append(problem)

    def callback_failed(self, name: str, error: BaseException) -> None:
        """Report that a callback of the agent has raised this error."""
        failure = _described(error, self._folder)
        place = (failure["file"], failure["line"]) if failure["file"] else name
        message = f"{name}() fails: {short(failure['text'])}{remedy(failure['type'], failure['text'])}"
        self.problem(place, message, remark=False)

    def returned(
        self, observations: Iterable[Any], infos: Iterable[Mapping[str, Any]], extra: Mapping[str, Any] | None
    ) -> None:
        """Remark on the first value of a step that is too large for the recording, and the first that is kept as text.

        `extra` are the further values that `step` returned. `observations` are those that are recorded.
        """
        values = [*(("info", info) for info in infos), ("what step() returns", extra or {})]
        for where, value in [*(("an observation", observation) for observation in observations), *values]:
            reader = Values(most=_LOOKED_AT, longest=_LOOKED_AT)
            reader.keep(value)
            if reader.only_text and self._is_first("only text"):
                message = (
                    f"{where} has an object of the class {printable(reader.only_text[:100])}, of which only str() is "
                    "recorded, at most 1000 characters; return numbers, texts, arrays, lists, dicts or dataclasses"
                )
                self.problem("step", message)
        for where, value in values:
            if where == "info" and not recording.is_too_large(value):
                continue
            for name, size in recording.bounded_extra(value)[1].items():
                if self._is_first("too large"):
                    message = (
                        f"{name[:100]!r} in {where} is too large for the recording ({size} bytes; all values of a step "
                        "may have a megabyte as JSON): its size is recorded instead"
                    )
                    self.problem("step", message)

    def over(self) -> None:
        """Report that everything has been tried."""
        self._write(call="close", over=True, loaded=sorted(_installed_modules() - self._loaded_before))

    def _is_first(self, kind: str) -> bool:
        is_first = kind not in self._kinds
        self._kinds.add(kind)
        return is_first

    def _end_after(self, seconds: float) -> None:
        faulthandler.dump_traceback_later(seconds, exit=True, file=self._stack)

    def _write(self, **facts: Any) -> None:
        late = None if self.callbacks is None else self.callbacks.first_late
        line = json.dumps({**self.facts, **facts, "late": late})
        with self._report.open("r+b", buffering=0) as file:  # opened anew, since the agent may close all files
            file.write(line.encode() + b"\n")  # over the last line: what follows the first line end is older


def _installed_modules() -> set[str]:
    """The top-level modules of installed packages that are loaded."""
    files = ((name, getattr(module, "__file__", None) or "") for name, module in list(sys.modules.items()))
    return {name.partition(".")[0] for name, file in files if "site-packages" in Path(file).parts}


def _described(error: BaseException, folder: Path) -> dict[str, Any]:
    """The error's type and text, and the last line of the project's code in its traceback."""
    frames = [(Path(frame.filename), frame.lineno) for frame in traceback.extract_tb(error.__traceback__)]
    if isinstance(error, SyntaxError) and error.filename:
        frames.append((Path(error.filename), error.lineno))
    ours = [(path.name, line) for path, line in frames if path.parent == folder]
    file, line = ours[-1] if ours else (None, None)
    name = type(error).__name__
    if isinstance(error, SyntaxError):
        text = f"{name}: {error.msg}"
    else:
        text = " ".join(part.strip() for part in traceback.format_exception_only(error))
    return {"type": name, "text": text, "file": file, "line": line}
