"""Shows a build's log line by line, and finds advice in it if the build fails."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Iterable

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.config import agent_imports
from hippodrome.trial import check

SHOWN = 12  # lines of a failed build's log in the problem; all lines were shown before

_CONTROL = re.compile(r"\x1b\[[0-9;?]*[A-Za-z]|[\x00-\x08\x0b-\x1f\x7f-\x9f]")  # what controls a terminal
_ADVICE: tuple[tuple[str, str], ...] = (
    (
        r"No matching distribution found for (?P<what>\S+)",
        "requirements.txt asks for {what}, which does not exist for Python 3.13 on Linux. Correct its name or version.",
    ),
    (
        r"ResolutionImpossible|conflicting dependencies|depends on .* but .* constraint",
        "requirements.txt asks for other versions than the trial needs (requirements/trial.txt). Relax it.",
    ),
    (r"Invalid requirement: '?(?P<what>[^':]+)", "requirements.txt has a line that pip cannot read: {what}"),
    (
        r"(gcc|cc|g\+\+|cmake|cargo|rustc)'? (failed|: not found)|command '(gcc|cc|g\+\+|cmake)'|Rust compiler|"
        r"No such file or directory: '(gcc|cc|g\+\+|cmake)'",
        "requirements.txt asks for a package that would have to be compiled, and the image has no compiler. "
        "Choose a version that has a wheel for Python 3.13.",
    ),
    (r"has requirement|which is not installed|is not supported on this platform", "Correct requirements.txt."),
    (
        r"toomanyrequests|429 Too Many Requests|Rate exceeded",
        "The base image is in great demand. Wait a few minutes, or name a mirror of it with --base.",
    ),
    (r"[Nn]o space left on device|ENOSPC", "The image is too large to be built. Leave large files or packages out."),
    (
        r"public\.ecr\.aws.*(403 Forbidden|denied)|authorization token has expired",
        "Docker on this machine has an old login to AWS's public gallery, which needs none: "
        "`docker logout public.ecr.aws`, then run the same command again.",
    ),
    (
        r"denied|403 Forbidden|not authorized",
        "Run it again. If it fails again, ask the administrator to run `hippodrome deploy`.",
    ),
)


class BuildLog:
    """The log of a build. It shows each line, and keeps the last lines."""

    def __init__(self) -> None:
        self._last: deque[str] = deque(maxlen=400)

    def add(self, text: str) -> None:
        """Show the lines of this text, without control characters and empty lines, and keep the last ones."""
        for raw in text.splitlines():
            line = _CONTROL.sub("", raw).rstrip()
            if line:
                self._last.append(line)
                screen.info(f"  {line}", style="dim")

    def failure(self, summary: str, more: Iterable[str] = ()) -> Problem:
        """Return the problem to raise for a failed build, with advice.

        Its details are the log's lines on errors (if there are none, its last lines), and `more`.
        """
        more, lines = list(more), list(self._last)
        missing = _missing("\n".join(lines))
        if missing:
            return Problem(f"{summary.rstrip('.')}: {missing[0]}", missing[1])
        of_errors = [line for line in lines if re.search(r"\bERROR\b|\b[Ee]rror:", line)]
        return Problem(summary, advice("\n".join([*lines, *more])), [*(of_errors or lines)[-SHOWN:], *more])


def advice(log: str) -> str:
    """Return advice on a failed build, by the first known message in its log."""
    for pattern, text in _ADVICE:
        match = re.search(pattern, log)
        if match:
            return text.format(**{name: value.strip() for name, value in match.groupdict().items() if value})
    return "Mend what the log says and run the same command again: what is done stays done."


def _missing(log: str) -> tuple[str, str] | None:
    """Find the line of trial/check.py that says what the agent needs and the image lacks, and what to do about it."""
    match = re.search(f"{check.LACKS}(?P<what>.+){check.REMEDY}(?P<remedy>.+)", log)
    if match is None:
        return None
    remedy = re.sub(
        rf"{check.PACKAGE}(\S+)", lambda module: agent_imports.requirement_line(module[1]) or module[0], match["remedy"]
    )
    return match["what"], f"{remedy[:1].upper()}{remedy[1:]}; then run the same command again."
