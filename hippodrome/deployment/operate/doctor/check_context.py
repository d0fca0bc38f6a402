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

    @cached_property
    def cpu(self) -> float:
        """The vCPUs of the largest server of these projects; 0 if none has a game."""
        return max((p.size.cpu for p in self.projects if p.game_steps), default=0.0)

    @cached_property
    def players(self) -> int:
        """The largest number of participants who share a server in these projects."""
        return max((p.players for p in self.projects if p.game_steps), default=1)

    @cached_property
    def warm(self) -> int:
        """The number of warm servers that these projects keep. They run beside the servers that participants use."""
        return sum(p.warm_servers for p in self.projects)

    @cached_property
    def warm_cpu(self) -> float:
        """The vCPUs of all warm servers together."""
        return sum(p.warm_servers * p.size.cpu for p in self.projects)


Check = Callable[[CheckContext], Iterable[Finding]]
