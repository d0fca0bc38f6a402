"""The input of the checks of `doctor`."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property

from hippodrome.control.aws import AwsPlatform
from hippodrome.control.model.project import Project
from hippodrome.deployment.aws.account import Account, Installation
from hippodrome.deployment.aws.hosted_zone import Delegation, Zone, delegation
from hippodrome.deployment.core import participants
from hippodrome.deployment.core.finding import Finding


@dataclass
class CheckContext:
    """The installation to check. `delegation` asks DNS, and `fetch` asks the site; None: do not ask."""

    account: Account
    installation: Installation
    at_once: int  # the most servers that a study may need at the same time
    now: datetime
    wanted: Project | None = None  # check this project; None: the live ones
    delegation: Callable[[Zone], Delegation] | None = delegation
    fetch: Callable[[str], int] | None = None

    @cached_property
    def platform(self) -> AwsPlatform:
        return self.account.platform(self.installation)

    @cached_property
    def projects(self) -> Sequence[Project]:
        """The projects to check: the wanted one, or all live ones."""
        if self.wanted is not None:
            return [self.wanted]
        return [p for p in participants.registered_projects(self.platform.documents, []) if p.live]


Check = Callable[[CheckContext], Iterable[Finding]]
