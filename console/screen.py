"""What people see: answers on stdout, progress and problems on stderr, so that scripts read only answers."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Sequence
from datetime import date
from typing import Any

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    ProgressColumn,
    SpinnerColumn,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
)
from rich.table import Table
from rich.text import Text

from console.problem import Exit, Problem

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)


def info(line: str, style: str = "") -> None:
    """One line about what is going on (stderr)."""
    err.print(Text(line, style=style))


def success(line: str) -> None:
    """One line about what has been done (stderr)."""
    err.print(Text("✓ ", style="green") + Text(line))


def warning(line: str) -> None:
    """One line about what should be looked at (stderr)."""
    err.print(Text("! ", style="yellow") + Text(line))


def result(line: str) -> None:
    """One line of the answer itself (stdout)."""
    out.print(Text(line))


def result_json(value: Any) -> None:
    """The answer for a script (stdout); nothing else may be printed there."""
    sys.stdout.write(json.dumps(value, indent=2, default=_plain, ensure_ascii=False) + "\n")


def _plain(value: Any) -> str:
    """Times as ISO 8601 has them, anything else as it prints itself."""
    return value.isoformat() if isinstance(value, date) else str(value)


def table(columns: Sequence[str], rows: Iterable[Sequence[object]], title: str = "", right: Sequence[str] = ()) -> None:
    """A table as the answer (stdout); the columns in `right` are numbers."""
    made = Table(title=title or None, title_justify="left", box=None, pad_edge=False, header_style="bold")
    for column in columns:
        made.add_column(column, justify="right" if column in right else "left", overflow="fold")
    for row in rows:
        made.add_row(*(Text(str(cell)) for cell in row))
    out.print(made)


class ProgressBars(Progress):
    """Progress bars on stderr. Where that is no terminal (a log, a pipe), one line when a piece of work begins."""

    def __init__(self, *more: ProgressColumn, width: int = 40) -> None:
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=width),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
        )
        super().__init__(*columns, *more, console=err, disable=not err.is_terminal)

    def add_task(self, description: str, *args: Any, **fields: Any) -> TaskID:
        """A new bar."""
        if self.disable:
            info(f"{description} …")
        return super().add_task(description, *args, **fields)


def progress() -> Progress:
    """A progress bar on stderr, for work that takes longer than a breath. Use as a context manager."""
    return ProgressBars()


def confirm(question: str, yes: bool = False) -> None:
    """Go on only if the answer is yes. `yes` is the command's `--yes`. Raises `Problem` (declined) otherwise."""
    if yes:
        return
    if not sys.stdin.isatty():
        advice = "Add --yes (with make: ARGS=--yes) to answer it beforehand."
        raise Problem(f"This needs a yes: {question}", advice, exit_code=Exit.DECLINED)
    err.print(Text(f"{question} [y/N] "), end="")
    if read_line().lower() not in {"y", "yes"}:
        raise Problem("Nothing was changed.", exit_code=Exit.DECLINED)


def read_line() -> str:
    """Return the line that is typed; "" at the end of the input (Ctrl-D)."""
    try:
        return input().strip()
    except EOFError:
        return ""


def show_problem(problem: Problem) -> None:
    """The last thing a failed command prints."""
    err.print(Text("✗ ", style="bold red") + Text(str(problem), style="bold"))
    for line in problem.details:
        err.print(Text(f"  {line}"))
    if problem.advice:
        err.print(Text(f"→ {problem.advice}"))
