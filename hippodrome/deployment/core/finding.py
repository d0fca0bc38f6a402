"""The results of checks: each is good, worth a look, or bad, and says what to do about it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

from rich.console import Console
from rich.text import Text

from hippodrome.console.program import as_typed
from hippodrome.deployment.core import explain

AT_ONCE = 8  # checks that run at the same time


class Mark(StrEnum):
    """Whether a result is good, worth a look, or bad."""

    GOOD = "good"
    LOOK = "look"  # what was checked works, but is worth a look; or it could not be checked
    BAD = "bad"  # participants would be affected

    @property
    def sign(self) -> str:
        """The sign that is printed before the finding."""
        return {"good": "✓", "look": "!", "bad": "✗"}[self.value]


STYLES = {Mark.GOOD: "green", Mark.LOOK: "yellow", Mark.BAD: "bold red"}


@dataclass(frozen=True)
class Finding:
    """The result of one check, shown as a line: what was checked, the result, and what to do about it."""

    check: str
    mark: Mark
    text: str
    advice: str = ""


def good(check: str, text: str) -> Finding:
    """Make a finding that all is well."""
    return Finding(check, Mark.GOOD, text)


def look(check: str, text: str, advice: str = "") -> Finding:
    """Make a finding that is worth a look, with advice."""
    return Finding(check, Mark.LOOK, text, advice)


def bad(check: str, text: str, advice: str = "") -> Finding:
    """Make a finding that affects participants, with advice."""
    return Finding(check, Mark.BAD, text, advice)


def show(findings: Iterable[Finding], console: Console) -> None:
    """Print each finding on a line."""
    for finding in findings:
        mark = Text(f"{finding.mark.sign} ", style=STYLES[finding.mark])
        console.print(mark + Text(as_typed(f"{finding.check}: {finding.text}")))
        if finding.advice and finding.mark is not Mark.GOOD:
            console.print(Text(as_typed(f"    → {finding.advice}")))


Subject = TypeVar("Subject")


def examine(subject: Subject, checks: Mapping[str, Callable[[Subject], Iterable[Finding]]]) -> list[Finding]:
    """Run all checks at the same time, and return their findings in the order of `checks`.

    A check that raises becomes a finding that says why. With HIPPODROME_DEBUG set, an unexpected error is raised.
    """

    def run(item: tuple[str, Callable[[Subject], Iterable[Finding]]]) -> list[Finding]:
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
        return [finding for findings in pool.map(run, checks.items()) for finding in findings]
