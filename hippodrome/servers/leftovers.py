"""Which resources of servers are left over, and why. Pure.

The sweep and the commands `stop`, `erase` and `destroy` list what exists (`resources.py`), read the records that own it
(`hippodrome.model.server.owner`), and decide here. A resource is never left over if its name is no server's name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from hippodrome.model import ids
from hippodrome.model.server import Server
from hippodrome.servers.overdue import LOST_AFTER
from hippodrome.servers.resources import Resources


class Why(StrEnum):
    """The reason why a resource is left over."""

    CLOSED = "its server is closed"
    REPLACED = "a later attempt has replaced its server"
    NO_RECORD = "no record owns it"
    ERASED = "its participant is erased"


@dataclass(frozen=True)
class Scope:
    """What a caller may remove. By default: the resources of closed servers, and of attempts that were replaced."""

    closed_by: datetime | None = None  # only of servers closed until this time
    project_id: str | None = None  # of this project's servers alone
    without_record: bool = False  # also what no record owns, where only this installation's resources can be
    labels: frozenset[str] = frozenset()  # servers of an erased participant: all they have
    names: frozenset[str] = frozenset()  # and the warm servers that were assigned to the participant

    def covers(self, owner: Server | None) -> bool:
        """Whether this server is of the project."""
        return self.project_id is None or (owner is not None and owner.project_id == self.project_id)

    def erases(self, name: str) -> bool:
        """Whether a resource of this name is an erased participant's."""
        return name in self.names or (ids.parse_server_name(name) or ("", 0))[0] in self.labels


def why_left_over(name: str, owner: Server | None, scope: Scope, *, ours: bool = False) -> Why | None:
    """Why a resource of this name is left over; None if it is not, or if it is not the caller's to remove.

    `owner`: the record that owns the name. A resource without a record may be another installation's, unless it is
    `ours`: lies where only this installation's resources can be.
    """
    parsed = ids.parse_server_name(name)
    if parsed is None:
        return None
    if scope.erases(name):
        return Why.ERASED
    if not scope.covers(owner):
        return None
    if owner is None:
        return Why.NO_RECORD if ours and scope.without_record else None
    if owner.name != name:
        return Why.REPLACED if owner.attempt >= parsed[1] else None
    closed = owner.is_closed and (scope.closed_by is None or _closed_by(owner, scope.closed_by))
    return Why.CLOSED if closed else None


def why_slot_left_over(name: str, owner: Server | None, now: datetime) -> Why | None:
    """Why the slot of the server of this name is left over; None if it is not.

    Not at once: the server's task may still appear (and is stopped then), or the next attempt may take over the slot.
    """
    if ids.parse_server_name(name) is None:
        return None
    if owner is None:  # erased: a server's record is written before it takes its slot
        return Why.NO_RECORD
    return Why.CLOSED if owner.closed is not None and now > owner.closed + LOST_AFTER else None


def leftovers(found: Resources, owners: Mapping[str, Server], scope: Scope) -> Resources:
    """The resources that are left over. `owners`: the records that own them, by the names of resources."""

    def keep(name: str, *, ours: bool = False) -> bool:
        return why_left_over(name, owners.get(name), scope, ours=ours) is not None

    return found.only(keep, lambda name: keep(name, ours=True))


def _closed_by(owner: Server, moment: datetime) -> bool:
    return owner.closed is not None and owner.closed <= moment
