"""A project's limits: records of the slots that participants and servers hold, and the rules for them. Pure.

A participant keeps a slot for good. The participants' labels are divided among `SHARDS` documents, so that many
newcomers at once do not wait for one document. A server holds a slot while it runs. One document per project has the
slots of all servers, so one conditional write decides both limits: how many servers run at once, and how many hours all
of them may use. With its slot, a server reserves the seconds up to its deadline; when it ends, the seconds that it used
are counted instead. Used and reserved seconds together never exceed the limit. Warm servers (`warmServers`) hold slots,
too, but never keep a participant out: the pool shrinks when the slots are used up.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime

import msgspec

from hippodrome.control.model import ids
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import Record
from hippodrome.control.model.server import Reason, Server

SHARDS = 16  # documents of participants' slots. Never change it: participants who hold a slot would not be found
NEVER_RAN = (Reason.REFUSED, Reason.NO_CAPACITY)  # AWS ran no task, so nothing is billed
MIN_BILLED_SECONDS = 60  # the least that Fargate bills


def participant_slots_folder(project_id: str) -> str:
    """Return the folder of the participants' slots."""
    return f"{project_id}/slots/"


def participant_slots_key(project_id: str, shard: int) -> str:
    """Return the key of one shard of the participants' slots; `shard` counts from 0."""
    return f"{participant_slots_folder(project_id)}{shard}.json"


SERVER_SLOTS = "_slots/"
"""The folder of the slots of all projects' servers."""


def server_slots_key(project_id: str) -> str:
    """Return the key of the slots of a project's servers."""
    return f"{SERVER_SLOTS}{project_id}.json"


class ParticipantSlots(Record, frozen=True):
    """`{projectId}/slots/{shard}.json`: the labels of participants who hold a slot, and the room for them.

    A label is a hash of a participant's id (`ids.server_label`). `room` is how many participants may hold a slot in
    this shard. The rooms of all shards add up to the limit; a registration with another limit divides it anew. A shard
    that was never written has its `shard_share` as room.
    """

    labels: tuple[str, ...] = ()
    room: int | None = None

    def with_participant(self, label: str, usual: int) -> ParticipantSlots:
        """Add this participant; return the same record if they hold a slot here already, or if this shard is full.

        `usual` is the room of a shard that was never written.
        """
        room = usual if self.room is None else self.room
        if label in self.labels or len(self.labels) >= room:
            return self
        return ParticipantSlots((*self.labels, label), room)

    def without(self, label: str) -> ParticipantSlots:
        """Remove this participant, so that their slot is free."""
        return ParticipantSlots(tuple(other for other in self.labels if other != label), self.room)

    def without_room(self, new: Iterable[str] = ()) -> ParticipantSlots:
        """Add the labels `new`, of participants who came before there was a limit, and leave no room for others."""
        labels = tuple(dict.fromkeys((*self.labels, *new)))
        return ParticipantSlots(labels, len(labels))

    def with_room_for(self, more: int) -> ParticipantSlots:
        """Set the room to the present participants and `more` others."""
        return ParticipantSlots(self.labels, len(self.labels) + more)


def shard_share(limit: int, shard: int) -> int:
    """Return how many of `limit` slots one shard gets."""
    return limit // SHARDS + (shard < limit % SHARDS)


def is_divided(limit: int, parts: Sequence[ParticipantSlots]) -> bool:
    """Return whether the rooms of all shards add up to the limit, or to the number of participants if that is greater.

    If a shard has more participants than room, it counts with its participants.
    """
    rooms = [shard_share(limit, n) if part.room is None else part.room for n, part in enumerate(parts)]
    return sum(map(max, rooms, counts(parts))) == max(limit, sum(counts(parts)))


def counts(parts: Sequence[ParticipantSlots]) -> list[int]:
    """Return how many participants hold a slot in each shard."""
    return [len(part.labels) for part in parts]


def first_shard(label: str, limit: int) -> int:
    """Return the shard in which a participant looks for a slot first. Its share of the limit is at least one slot.

    Another limit may mean another shard. So a participant holds two slots if `next_step` crashed between taking the
    first slot and writing `participant.json`, and the limit changed before they came back. Then too few others are
    admitted, never too many.
    """
    return hashlib.sha256(label.encode()).digest()[0] % min(SHARDS, limit)


class ServerSlot(Record, frozen=True):
    """A server's slot: the server's attempt, and the seconds that are reserved for it."""

    attempt: int
    reserved: int = 0
    is_warm_server: bool = False


class ServerSlots(Record, frozen=True):
    """`_slots/{projectId}.json`: the slots of servers, by label, and the seconds that ended servers have used."""

    slots: Mapping[str, ServerSlot] = msgspec.field(default_factory=dict)
    used: int = 0  # the seconds of ended servers, added up

    @property
    def names(self) -> list[str]:
        """The names of the servers that hold a slot."""
        return [ids.server_name(label, held.attempt) for label, held in self.slots.items()]

    def with_server(self, project: Project, server: Server) -> ServerSlots | None:
        """Give this server a slot; return the same record if it holds one already, and None if no slot is free.

        If an earlier attempt's slot is still held, this attempt takes it over.
        """
        mine = self.slots.get(server.label)
        server_slot = ServerSlot(server.attempt, seconds_reserved(server), server.is_warm_server)
        if mine == server_slot:
            return self
        others = {label: held for label, held in self.slots.items() if label != server.label}
        before_it = [held for held in others.values() if server.is_warm_server or not held.is_warm_server]
        # If the slot of an earlier attempt was never released, all that it reserved counts as used.
        used = self.used + (mine.reserved if mine else 0)
        if mine is None and project.max_servers is not None and len(before_it) >= project.max_servers:
            return None
        hours = project.max_server_hours
        if hours is not None and used + sum(h.reserved for h in before_it) + server_slot.reserved > hours * 3600:
            return None
        return ServerSlots({**others, server.label: server_slot}, used)

    def free_slots(self, project: Project, seconds: int) -> int | None:
        """Return how many more servers that reserve `seconds` each would get a slot.

        The number is below 0 if more servers hold a slot than the limits allow. None: the project has no such limit.
        """
        rooms = []
        if project.max_servers is not None:
            rooms.append(project.max_servers - len(self.slots))
        if project.max_server_hours is not None:
            seconds_left = (
                project.max_server_hours * 3600 - self.used - sum(held.reserved for held in self.slots.values())
            )
            rooms.append(seconds_left // seconds)
        return min(rooms, default=None)

    def released(self, server: Server, seconds: int, *, keep: bool = False) -> ServerSlots:
        """Release the slot of this attempt, which used `seconds`. An attempt without a slot changes nothing.

        With `keep` the slot stays, without reserved seconds, for the next attempt.
        """
        mine = self.slots.get(server.label)
        if mine is None or mine.attempt != server.attempt:
            return self
        held = {label: held for label, held in self.slots.items() if label != server.label}
        if keep:
            held[server.label] = ServerSlot(server.attempt)
        return ServerSlots(held, self.used + min(seconds, mine.reserved))

    def without(self, label: str) -> ServerSlots:
        """Release the slot of a server whose used seconds are not known: all that it reserved count as used."""
        mine = self.slots.get(label)
        return self.without_all({label: (mine.attempt, None)}) if mine else self

    def without_all(self, ended: Mapping[str, tuple[int, int | None]]) -> ServerSlots:
        """Release the slots of servers. `ended` maps a label to the attempt and the seconds used (None: not known).

        A slot that is held for another attempt stays.
        """
        held, used = {}, self.used
        for label, mine in self.slots.items():
            attempt, seconds = ended.get(label, (None, None))
            if attempt == mine.attempt:
                used += mine.reserved if seconds is None else min(seconds, mine.reserved)
            else:
                held[label] = mine
        return ServerSlots(held, used)


def seconds_reserved(server: Server) -> int:
    """Return the seconds that a slot reserves for this server: as many as it can run until its deadline."""
    return math.ceil((server.deadline - server.requested).total_seconds())


def seconds_used(server: Server, reason: Reason, end: datetime) -> int:
    """Return the seconds that a server used until `end`. They begin with its request: AWS bills nearly all of them."""
    if reason in NEVER_RAN:
        return 0
    return max(MIN_BILLED_SECONDS, math.ceil((end - server.requested).total_seconds()))
