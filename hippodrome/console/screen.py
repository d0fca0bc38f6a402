"""Prints a command's results on stdout, and progress and problems on stderr, so that scripts read only results."""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable, Mapping, Sequence
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

from hippodrome.console.problem import Exit, Problem
from hippodrome.console.program import as_typed

out = Console(highlight=False, soft_wrap=True)
err = Console(stderr=True, highlight=False, soft_wrap=True)


def info(line: str, style: str = "") -> None:
    """Print a line on the progress of the command (stderr)."""
    err.print(Text(as_typed(line), style=style))


def success(line: str) -> None:
    """Print a line on a finished piece of work (stderr)."""
    err.print(Text("✓ ", style="green") + Text(as_typed(line)))


def warning(line: str) -> None:
    """Print a warning (stderr)."""
    err.print(Text("! ", style="yellow") + Text(as_typed(line)))


def result(line: str) -> None:
    """Print a line of the command's result (stdout)."""
    out.print(Text(as_typed(line)))


def result_json(value: Any) -> None:
    """Print the result as JSON for a script (stdout). The command must print nothing else there."""
    sys.stdout.write(json.dumps(value, indent=2, default=_text, ensure_ascii=False) + "\n")


def _text(value: Any) -> str:
    """Write a date or time as ISO 8601, and any other value as `str()` does."""
    return value.isoformat() if isinstance(value, date) else str(value)


def table(columns: Sequence[str], rows: Iterable[Sequence[object]], title: str = "", right: Sequence[str] = ()) -> None:
    """Print a table as the command's result (stdout). The columns in `right` are aligned to the right."""
    printed = Table(title=title or None, title_justify="left", box=None, pad_edge=False, header_style="bold")
    for column in columns:
        printed.add_column(column, justify="right" if column in right else "left", overflow="fold")
    for row in rows:
        printed.add_row(*(Text(str(cell)) for cell in row))
    out.print(printed)


class ProgressBars(Progress):
    """Progress bars on stderr, for work that takes some seconds. Use them as a context manager.

    If stderr is no terminal, a line at the beginning of each task takes their place.
    """

    def __init__(self, *more: ProgressColumn, width: int = 40, amount: ProgressColumn | None = None) -> None:
        columns = (
            SpinnerColumn(),
            TextColumn("{task.description}", markup=False),
            BarColumn(bar_width=width),
            amount or MofNCompleteColumn(),
            TimeElapsedColumn(),
        )
        super().__init__(*columns, *more, console=err, disable=not err.is_terminal)

    def add_task(self, description: str, *args: Any, **fields: Any) -> TaskID:
        """Add a bar for a task."""
        if self.disable:
            info(f"{description} …")
        return super().add_task(description, *args, **fields)


def confirm(question: str, yes: bool = False) -> None:
    """Ask the question and return if the answer is yes. With `yes`, the command's `--yes`, it does not ask.

    Raises `Problem` with the exit code DECLINED for any other answer, and if stdin is no terminal.
    """
    if yes:
        return
    if not sys.stdin.isatty():
        advice = "Add --yes to answer it beforehand."
        raise Problem(f"This needs a yes: {question}", advice, exit_code=Exit.DECLINED)
    err.print(Text(f"{question} [y/N] "), end="")
    if read_line().lower() not in {"y", "yes"}:
        raise Problem("Nothing was changed.", exit_code=Exit.DECLINED)


def choose(question: str, answers: Mapping[str, str]) -> str | None:
    """Ask which of these is meant, each a word with its meaning, and return the word; None if stdin is no terminal.

    The first letter of a word is enough. Raises `Problem` with the exit code DECLINED for any other answer.
    """
    if not sys.stdin.isatty():
        return None
    err.print(Text(question))
    for word, meaning in answers.items():
        err.print(Text(f"  {word}: {meaning}"))
    err.print(Text(f"{' or '.join(answers)}? "), end="")
    answer = read_line().lower()
    chosen = [word for word in answers if answer and word.startswith(answer)]
    if len(chosen) != 1:
        raise Problem("Nothing was done.", f"Answer {' or '.join(answers)}.", exit_code=Exit.DECLINED)
    return chosen[0]


def read_line() -> str:
    """Return the next line of stdin without surrounding spaces; "" at its end (Ctrl-D)."""
    try:
        return input().strip()
    except EOFError:
        return ""


def show_problem(problem: Problem) -> None:
    """Print a problem with its details and advice (stderr)."""
    err.print(Text("✗ ", style="bold red") + Text(as_typed(str(problem)), style="bold"))
    for line in problem.details:
        err.print(Text(as_typed(f"  {line}")))
    if problem.advice:
        err.print(Text(as_typed(f"→ {problem.advice}")))
    for command in problem.commands:
        err.print(Text(as_typed(f"  {command}")))
