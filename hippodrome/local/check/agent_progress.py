"""The report of a tried agent: its process (`agent_process.py`) writes it, `agent_report.py` reads it."""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hippodrome.local.check.deadline import Deadline
from hippodrome.local.check.pace import PLAY_STEPS, Pace
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.recorded_values import Values

REPORT_BYTES = 2**20  # a report of this size begins anew
_LOOKED_AT = 1_000  # the most values, and elements of an array, in which objects that are kept as text are looked for


class AgentProgress:
    """Reports each method before it is called: if the process ends or hangs, the last line names the method.

    Each line holds all that is known. Two lines are appended to the file for each step: to write a new file for each
    would take longer than a step of many environments.
    """

    def __init__(
        self,
        report: Path,
        folder: Path,
        early: Sequence[tuple[str, str, int]] = (),
        deadline: Deadline | None = None,
    ) -> None:
        """`early`: the project's lines that read the participant too early: variable, file, line. It may still grow.

        `deadline` limits each call.
        """
        self._deadline = deadline
        self._report, self._folder = report, folder
        self._early = early
        self._file: io.FileIO | None = None
        self.episodes = self.steps = 0
        self.matched: int | None = None
        """How many sessions `match` made of made-up participants; None if it was not called."""
        self.action: Any = 0  # the last action, or the last actions by player
        self.known: dict[str, Any] = {}
        self.foreign: list[int] = []
        self.undrawn: list[str] = []
        self.callbacks: Any = None
        self._callback_errors: list[dict[str, Any]] = []
        self.pace = Pace()
        self.result: Any = None
        self._loaded_before = _installed_modules()
        self._until = math.inf

    def time_over(self) -> bool:
        """Return whether no more steps should be taken: there were enough, or the time of playing is over.

        The time counts from the end of the first step.
        """
        if self.steps == 1 and self._until == math.inf:
            self._until = time.monotonic() + float(os.environ.get("PLAY_SECONDS", "10"))
        return self.steps >= PLAY_STEPS or time.monotonic() > self._until

    def call(self, name: str, function: Callable[[], Any]) -> bool:
        """Report the name, call the function and keep its `result`. Return False if it raised, which is reported."""
        within = self._deadline.begin(name) if self._deadline else None
        self._write(call=name, within=within)
        try:
            self.result = function()
        except BaseException as error:  # noqa: BLE001 - SystemExit in a researcher's code is a failure too
            self._write(call=name, error=_described(error, self._folder))
            return False
        return True

    def callback_failed(self, name: str, error: BaseException) -> None:
        """Note that a callback of the agent has raised this error."""
        self._callback_errors.append({"name": name, **_described(error, self._folder)})

    def returned(
        self, observations: Iterable[Any], infos: Iterable[Mapping[str, Any]], extra: Mapping[str, Any] | None
    ) -> None:
        """Note the first value of a step that is too large for the recording, and the first that is kept as text.

        `extra` are the further values that `step` returned. `observations` are those that are recorded.
        """
        values = (*(("info", info) for info in infos), ("what step() returns", extra or {}))
        if "onlyText" not in self.known:
            for where, value in (*(("an observation", observation) for observation in observations), *values):
                reader = Values(most=_LOOKED_AT, longest=_LOOKED_AT)
                reader.keep(value)
                if reader.only_text:
                    self.known["onlyText"] = {"type": reader.only_text[:100], "where": where}
                    break
        if "tooLarge" in self.known:
            return
        for where, value in values:
            if where == "info" and not recording.is_too_large(value):
                continue
            for name, size in recording.bounded_extra(value)[1].items():
                self.known["tooLarge"] = {"name": name[:100], "size": size, "where": where}
                return

    def over(self) -> None:
        """Report that everything has been tried."""
        self._write(call="close", over=True, loaded=sorted(_installed_modules() - self._loaded_before))

    def _write(self, **fields: Any) -> None:
        progress_facts = {"episodes": self.episodes, "steps": self.steps, "action": self.action, "early": self._early}
        progress_facts["pace"], progress_facts["matched"] = vars(self.pace), self.matched
        if self.callbacks is not None:
            progress_facts["callbacks"] = {"errors": self._callback_errors, "late": self.callbacks.first_late}
        if self.undrawn:
            progress_facts["undrawn"] = self.undrawn
        self._append(
            json.dumps({**progress_facts, **self.known, "foreign": bool(self.foreign), **fields}).encode() + b"\n"
        )

    def _append(self, line: bytes) -> None:
        with contextlib.suppress(OSError):  # the agent has closed the file
            if self._file is not None and self._file.tell() < REPORT_BYTES:
                self._file.write(line)
                return
        if self._file is not None:
            with contextlib.suppress(OSError):
                self._file.close()
        part = self._report.with_suffix(".part")
        self._file = part.open("wb", buffering=0)
        self._file.write(line)
        part.replace(self._report)


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
