"""Mistakes and remarks: where each one is, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from protocol.values import Keys, path_text, printable

__all__ = ["ConfigErrors", "Diagnostic", "Keys", "Mistake", "Remark", "in_order", "path_text", "printable"]


@dataclass(frozen=True, slots=True)
class Diagnostic:
    """A mistake or a remark as it is shown: file name, line (None if there is none), key ("" for the file), what to do.

    A `remark` is about something that works, but most likely not as intended.
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
    """All mistakes in a configuration, in line order; str() has one line for each."""

    def __init__(self, problems: Iterable[Diagnostic]) -> None:
        self.diagnostics = list(problems)
        super().__init__(self.diagnostics)

    def __str__(self) -> str:
        return "\n".join(str(problem) for problem in self.diagnostics)


class Mistake(NamedTuple):
    """What is wrong with the value at a path of keys, and what to do. `line` is given if it is not the path's own."""

    path: Keys
    message: str
    line: int | None = None


class Remark(NamedTuple):
    """What to say about the value at a path of keys, which works."""

    path: Keys
    message: str


def in_order(problems: Iterable[Diagnostic]) -> list[Diagnostic]:
    """The diagnostics in the order of their lines, each once."""
    return sorted(dict.fromkeys(problems), key=lambda problem: problem.line or 0)
