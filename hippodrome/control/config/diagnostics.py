"""Mistakes and remarks: the place of each in a file, and the message that says what to do."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from hippodrome.protocol.values import KeyPath


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """A mistake or a remark as people read it. `str()` is one line, such as `config.yml:17: trial.game: missing; …`.

    `line` is None if the message is about no line, and `where` is the path of the key, or "" for the file. A `remark`
    is about something that works, but most likely not as intended.
    """

    file: str
    line: int | None
    where: str
    message: str
    remark: bool = False

    def __str__(self) -> str:
        place = self.file if self.line is None else f"{self.file}:{self.line}"
        parts = (place, "remark" if self.remark else "", self.where, self.message)
        return ": ".join(part for part in parts if part)


class ConfigErrors(Exception):
    """A configuration has mistakes. `diagnostics` has all of them in line order; `str()` has a line for each."""

    def __init__(self, problems: Iterable[Diagnostic]) -> None:
        self.diagnostics = list(problems)
        super().__init__(self.diagnostics)

    def __str__(self) -> str:
        return "\n".join(str(problem) for problem in self.diagnostics)


class Mistake(NamedTuple):
    """A mistake in the value at a path of keys; `message` says what to do.

    `line` is the line of the mistake in the file; None stands for the line of the value at `path`.
    """

    path: KeyPath
    message: str
    line: int | None = None


class Remark(NamedTuple):
    """A remark on the value at a path of keys."""

    path: KeyPath
    message: str


def in_order(problems: Iterable[Diagnostic]) -> list[Diagnostic]:
    """Return the diagnostics in the order of their lines, each once."""
    return sorted(dict.fromkeys(problems), key=lambda problem: problem.line or 0)
