"""Mistakes: where each one stands, and what to do about it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import NamedTuple

from protocol.values import Keys, printable, where_of

__all__ = ["ConfigErrors", "Finding", "Keys", "Problem", "in_order", "printable", "where_of"]


@dataclass(frozen=True, slots=True)
class Problem:
    """One mistake: the file's name, the line (None if there is none), the key ("" for the file), what to do.

    A `remark` is about something that works, but most likely not as it was meant.
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
    """Everything that is wrong with a configuration, in line order; str() has one line for each."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = list(problems)
        super().__init__(self.problems)

    def __str__(self) -> str:
        return "\n".join(str(problem) for problem in self.problems)


class Finding(NamedTuple):
    """A mistake before it has a line: the path of keys, and what to do."""

    path: Keys
    message: str


def in_order(problems: Iterable[Problem]) -> list[Problem]:
    """By line, each once."""
    return sorted(dict.fromkeys(problems), key=lambda problem: problem.line or 0)
