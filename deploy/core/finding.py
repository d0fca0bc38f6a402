"""The results of checks: lines that are good, to be looked at, or bad, each with what to do about it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from rich.console import Console
from rich.text import Text

from deploy.core import explain

AT_ONCE = 8  # checks under way


class Mark(StrEnum):
    """Whether a line is good, to be looked at, or bad."""

    GOOD = "good"
    LOOK = "look"  # works, but should be looked at; or could not be checked
    BAD = "bad"  # participants would meet it

    @property
    def sign(self) -> str:
        return {"good": "✓", "look": "!", "bad": "✗"}[self.value]


STYLES = {Mark.GOOD: "green", Mark.LOOK: "yellow", Mark.BAD: "bold red"}


@dataclass(frozen=True)
class Finding:
    """One line: what was checked, how it stands, and what to do about it."""

    check: str
    mark: Mark
    text: str
    advice: str = ""


def good(check: str, text: str) -> Finding:
    return Finding(check, Mark.GOOD, text)


def look(check: str, text: str, advice: str = "") -> Finding:
    return Finding(check, Mark.LOOK, text, advice)


def bad(check: str, text: str, advice: str = "") -> Finding:
    return Finding(check, Mark.BAD, text, advice)


def show(findings: Iterable[Finding], console: Console) -> None:
    """Print the findings, a line for each."""
    for finding in findings:
        mark = Text(f"{finding.mark.sign} ", style=STYLES[finding.mark])
        console.print(mark + Text(f"{finding.check}: {finding.text}"))
        if finding.advice and finding.mark is not Mark.GOOD:
            console.print(Text(f"    → {finding.advice}"))


Subject = TypeVar("Subject")


def examine(subject: Subject, checks: Mapping[str, Callable[[Subject], Iterable[Finding]]]) -> list[Finding]:
    """All checks, at the same time and each by itself: one that cannot be made says why. In the order given."""

    def one(item: tuple[str, Callable[[Subject], Iterable[Finding]]]) -> list[Finding]:
        name, check = item
        try:
            return list(check(subject))
        except Exception as error:
            problem = explain.problem_from(error)
            if problem is None and os.environ.get("HIPPODROME_DEBUG"):
                raise
            why = str(problem) if problem else f"{type(error).__name__}: {error}"
            return [look(name, f"could not be checked: {why}", problem.advice if problem else "")]

    with ThreadPoolExecutor(AT_ONCE) as pool:
        return [finding for findings in pool.map(one, checks.items()) for finding in findings]
