"""What a check finds, and what the checks are given."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from functools import cached_property
from typing import Any

from deploy import friendly, participants
from deploy.account import Account, Installation
from deploy.stack import Stack
from deploy.zone import Delegation, Zone, delegation
from hippodrome.aws import AwsPlatform
from hippodrome.project import Project

AT_ONCE = 8  # checks under way


class Mark(StrEnum):
    """How it stands."""

    GOOD = "good"
    LOOK = "look"  # works, but somebody should look at it; or could not be checked
    BAD = "bad"  # participants would meet it

    @property
    def sign(self) -> str:
        return {"good": "✓", "look": "!", "bad": "✗"}[self.value]


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


@dataclass
class Patient:
    """The installation that is looked at. `delegation` and `fetch` are how the Internet is asked; None: not at all."""

    account: Account
    installation: Installation
    at_once: int  # servers at the same time that a study may need
    now: datetime
    wanted: Project | None = None  # the project that is asked about; else the live ones
    delegation: Callable[[Zone], Delegation] | None = delegation
    fetch: Callable[[str], int] | None = None

    @cached_property
    def platform(self) -> AwsPlatform:
        return self.account.platform(self.installation)

    @cached_property
    def projects(self) -> Sequence[Project]:
        """The projects that matter: the wanted one, or all live ones."""
        if self.wanted is not None:
            return [self.wanted]
        return [p for p in participants.registered(self.platform.documents) if p.live]

    @cached_property
    def resources(self) -> Sequence[Mapping[str, Any]]:
        """What the stack consists of."""
        return Stack(self.account, self.installation.stack).resources()

    def of_type(self, kind: str) -> list[str]:
        """The physical ids of the stack's resources of that type."""
        return [str(one["PhysicalResourceId"]) for one in self.resources if one["ResourceType"] == kind]

    @cached_property
    def cpu(self) -> float:
        """vCPUs of the largest server that may be asked for."""
        return max((p.size.cpu for p in self.projects if p.game_steps), default=0.0)

    @cached_property
    def warm(self) -> int:
        """Servers that wait for participants, whoever plays: for each one that is taken, another is started."""
        return sum(p.warm_servers for p in self.projects)

    @cached_property
    def warm_cpu(self) -> float:
        """vCPUs of all of those."""
        return sum(p.warm_servers * p.size.cpu for p in self.projects)


Check = Callable[[Patient], Iterable[Finding]]


def examine(patient: Patient, checks: Mapping[str, Check]) -> list[Finding]:
    """All checks, at the same time and each by itself: one that cannot be made says why. In the order given."""

    def one(item: tuple[str, Check]) -> list[Finding]:
        name, check = item
        try:
            return list(check(patient))
        except Exception as error:
            problem = friendly.problem_from(error)
            if problem is None and os.environ.get("HIPPODROME_DEBUG"):
                raise
            why = str(problem) if problem else f"{type(error).__name__}: {error}"
            return [look(name, f"could not be checked: {why}", problem.advice if problem else "")]

    with ThreadPoolExecutor(AT_ONCE) as pool:
        return [finding for findings in pool.map(one, checks.items()) for finding in findings]
