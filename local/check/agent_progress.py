"""How far the tried agent has come: its process (`agent_process.py`) writes it down, `agent_report.py` reads it."""

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

from local.check.outside import Outside
from local.check.pace import Pace
from trial.recordings import recording

PLAY_STEPS = 5_000  # in each group
REPORT_BYTES = 2**20  # after which the report begins anew


class AgentProgress:
    """Writes down each method before it calls it: if the process ends or hangs, the last line names the method.

    A line holds all that is known. There are two for each step, and to make a new file for each would take longer than
    many an environment's step.
    """

    def __init__(
        self, report: Path, folder: Path, outside: Outside, early: Sequence[tuple[str, str, int]] = ()
    ) -> None:
        """`early`: the lines of the project that have asked for the participant too early, which others add to."""
        self._report, self._folder, self._outside = report, folder, outside
        self._early = early
        self._file: io.FileIO | None = None
        self.episodes = self.steps = 0
        self.matched: int | None = None
        """How many sessions `match` made of made-up participants, if it was asked."""
        self.action: Any = 0  # or by player
        self.known: dict[str, Any] = {}
        self.foreign: list[int] = []
        self.undrawn: list[str] = []
        self.callbacks: Any = None
        self._callback_errors: list[dict[str, Any]] = []
        self.pace = Pace()
        self.result: Any = None
        self._ours = _installed_modules()
        self._until = math.inf

    def time_over(self) -> bool:
        """Whether enough has been played. The time counts from the first step on."""
        if self.steps == 1 and self._until == math.inf:
            self._until = time.monotonic() + float(os.environ.get("PLAY_SECONDS", "10"))
        return self.steps >= PLAY_STEPS or time.monotonic() > self._until

    def call(self, name: str, function: Callable[[], Any]) -> bool:
        """Call it; whether that went well."""
        self._write(call=name)
        try:
            self.result = function()
        except BaseException as error:  # noqa: BLE001 - SystemExit in a researcher's code is a failure like another
            self._write(call=name, error=_told(error, self._folder))
            return False
        if name == "render":
            self._outside.see(self.result)
        return True

    def callback_failed(self, name: str, error: BaseException) -> None:
        """A callback of the agent has raised."""
        self._callback_errors.append({"name": name, **_told(error, self._folder)})

    def returned(self, infos: Iterable[Mapping[str, Any]], extra: Mapping[str, Any] | None) -> None:
        """Note the first value of these that is too large for the recording."""
        if "tooLarge" in self.known:
            return
        for where, values in (
            *(("info", info) for info in infos if recording.is_too_large(info)),
            ("what it returns", extra),
        ):
            found = recording.bounded_extra(values)[1] if values else {}
            for name, size in found.items():
                self.known["tooLarge"] = {"name": name[:100], "size": size, "where": where}
                return

    def over(self) -> None:
        """All has been tried."""
        self.known["outside"] = self._outside.found()
        self._write(call="close", over=True, loaded=sorted(_installed_modules() - self._ours))

    def _write(self, **what: Any) -> None:
        far = {"episodes": self.episodes, "steps": self.steps, "action": self.action, "early": self._early}
        far["pace"], far["matched"] = vars(self.pace), self.matched
        if self.callbacks is not None:
            far["callbacks"] = {"errors": self._callback_errors, "late": self.callbacks.first_late}
        if self.undrawn:
            far["undrawn"] = self.undrawn
        self._append(json.dumps({**far, **self.known, "foreign": bool(self.foreign), **what}).encode() + b"\n")

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


def _told(error: BaseException, folder: Path) -> dict[str, Any]:
    """The error in its own words, and the last line of the project's code that was on the way to it."""
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
