"""Decides which resources of servers are left over, and why. Pure.

The sweep and the commands `stop`, `erase` and `destroy` list the resources (`resources.py`), read the records that own
them (`hippodrome.control.model.server.owner`), and decide here. A resource is never left over if its name is no
server's name.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum

from hippodrome.control.model import ids
from hippodrome.control.model.server import Server
from hippodrome.control.servers.overdue import LOST_AFTER
from hippodrome.control.servers.resources import Resources


class LeftoverReason(StrEnum):
    """The reason why a resource is left over."""

    CLOSED = "its server is closed"
    REPLACED = "a later attempt has replaced its server"
    NO_RECORD = "no record owns it"
    ERASED = "its participant is erased"


@dataclass(frozen=True)
class Scope:
    """The resources that a caller may remove. By default: resources of closed servers, and of replaced attempts."""

    closed_by: datetime | None = None  # only resources of servers that were closed until this time
    project_id: str | None = None  # only resources of this project's servers
    without_record: bool = False  # also resources without an owner, if only this installation can have created them
    labels: frozenset[str] = frozenset()  # the labels of an erased participant's servers, whose resources all go
    names: frozenset[str] = frozenset()  # the names of the warm servers that were assigned to that participant

    def covers(self, owner: Server | None) -> bool:
        """Return whether this server belongs to the project `project_id`. Without `project_id`, every server counts."""
        return self.project_id is None or (owner is not None and owner.project_id == self.project_id)

    def erases(self, name: str) -> bool:
        """Return whether a resource of this name is an erased participant's."""
        return name in self.names or (ids.parse_server_name(name) or ("", 0))[0] in self.labels


def why_left_over(name: str, owner: Server | None, scope: Scope, *, ours: bool = False) -> LeftoverReason | None:
    """Return why a resource of this name is left over; None if it is not, or if it is outside `scope`.

    `owner` is the record that owns the name. `ours`: whether only this installation can have created the resource.
    Otherwise a resource without a record may be another installation's.
    """
    parsed = ids.parse_server_name(name)
    if parsed is None:
        return None
    if scope.erases(name):
        return LeftoverReason.ERASED
    if not scope.covers(owner):
        return None
    if owner is None:
        return LeftoverReason.NO_RECORD if ours and scope.without_record else None
    if owner.name != name:
        return LeftoverReason.REPLACED if owner.attempt >= parsed[1] else None
    if not owner.is_closed or (scope.closed_by and (owner.closed is None or owner.closed > scope.closed_by)):
        return None
    return LeftoverReason.CLOSED


def why_slot_left_over(name: str, owner: Server | None, now: datetime) -> LeftoverReason | None:
    """Return why the slot of the server of this name is left over; None if it is not.

    A closed server's slot is left over only after `LOST_AFTER`: before that, a task of the server may still appear (and
    be stopped), or the next attempt may take the slot over.
    """
    if ids.parse_server_name(name) is None:
        return None
    if owner is None:  # its participant was erased: a record is written before its server takes a slot
        return LeftoverReason.NO_RECORD
    return LeftoverReason.CLOSED if owner.closed is not None and now > owner.closed + LOST_AFTER else None


def leftovers(resources: Resources, owners: Mapping[str, Server], scope: Scope) -> Resources:
    """Return the resources that are left over. `owners` maps a resource's name to the record that owns it."""

    def keep(name: str, *, ours: bool = False) -> bool:
        return why_left_over(name, owners.get(name), scope, ours=ours) is not None

    return resources.only(keep, lambda name: keep(name, ours=True))
