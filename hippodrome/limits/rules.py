"""A project's limits: records of the slots that participants and servers hold, and the rules for them. Pure.

A participant keeps a slot for good. Their labels are divided among `SHARDS` documents, so that many newcomers at once
do not wait for one document. A server holds a slot while it runs. There is one document per project for these, so one
conditional write decides both limits: how many servers run at once, and how many hours all of them may use. With its
slot, a server reserves the seconds up to its deadline; when it ends, the seconds that it used are counted instead. Used
and reserved seconds together never exceed the limit. Warm servers (`warmServers`) hold slots, too, but never keep a
participant out: the pool shrinks when the slots are used up.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime

import msgspec

from hippodrome.model import ids
from hippodrome.model.project import Project
from hippodrome.model.records import Record
from hippodrome.model.server import Reason, Server

SHARDS = 16  # documents of participants' slots. Never change it: participants who hold a slot would not be found
NEVER_RAN = (Reason.REFUSED, Reason.NO_CAPACITY)  # AWS refused: nothing is billed
MIN_BILLED_SECONDS = 60  # the least that Fargate bills


def participant_slots_folder(project_id: str) -> str:
    """The folder of the participants' slots."""
    return f"{project_id}/places/"


def participant_slots_key(project_id: str, shard: int) -> str:
    """The key of one of the documents (shards) of participants' slots."""
    return f"{participant_slots_folder(project_id)}{shard}.json"


SERVER_SLOTS = "_places/"


def server_slots_key(project_id: str) -> str:
    """The key of the slots of a project's servers."""
    return f"{SERVER_SLOTS}{project_id}.json"


class ParticipantSlots(Record, frozen=True):
    """`{projectId}/places/{shard}.json`: the labels of participants who hold a slot; `room` is the most that may.

    The rooms of all shards together are the limit. Registering divides a changed limit anew. A shard that was never
    written has its `shard_share` as room.
    """

    labels: tuple[str, ...] = ()
    room: int | None = None

    def with_participant(self, label: str, usual: int) -> ParticipantSlots:
        """Add this participant; return the same record if they hold a slot here already, or if this shard is full."""
        room = usual if self.room is None else self.room
        if label in self.labels or len(self.labels) >= room:
            return self
        return ParticipantSlots((*self.labels, label), room)

    def without(self, label: str) -> ParticipantSlots:
        """Remove this participant, whose slot is then free."""
        return ParticipantSlots(tuple(other for other in self.labels if other != label), self.room)

    def without_room(self, new: Iterable[str] = ()) -> ParticipantSlots:
        """Add participants who came before there was a limit, and leave no room for others."""
        labels = tuple(dict.fromkeys((*self.labels, *new)))
        return ParticipantSlots(labels, len(labels))

    def with_room_for(self, more: int) -> ParticipantSlots:
        """Leave room for `more` participants."""
        return ParticipantSlots(self.labels, len(self.labels) + more)


def shard_share(limit: int, shard: int) -> int:
    """How many of `limit` slots one shard gets."""
    return limit // SHARDS + (shard < limit % SHARDS)


def is_divided(limit: int, parts: Sequence[ParticipantSlots]) -> bool:
    """Whether the rooms of all shards add up to the limit (or to the number of participants, if they are more).

    If a shard has more participants than room, its participants are added instead of its room.
    """
    rooms = [shard_share(limit, n) if part.room is None else part.room for n, part in enumerate(parts)]
    return sum(map(max, rooms, counts(parts))) == max(limit, sum(counts(parts)))


def counts(parts: Sequence[ParticipantSlots]) -> list[int]:
    """How many participants hold a slot in each shard."""
    return [len(part.labels) for part in parts]


def first_shard(label: str, limit: int) -> int:
    """The shard where a participant's slot is looked for first: one with a share of the limit.

    If `next_step` crashed after it took a slot and before it wrote `participant.json`, and the limit changes before the
    participant returns, they may hold two slots: then too few others are admitted, never too many.
    """
    return hashlib.sha256(label.encode()).digest()[0] % min(SHARDS, limit)


class ServerSlot(Record, frozen=True):
    """A server's slot: its attempt, and the seconds that are reserved for it."""

    attempt: int
    reserved: int = 0
    is_warm_server: bool = msgspec.field(default=False, name="spare")


class ServerSlots(Record, frozen=True):
    """`_places/{projectId}.json`: the slots of servers, by label, and the seconds that ended servers have used."""

    slots: Mapping[str, ServerSlot] = msgspec.field(default_factory=dict, name="held")
    used: int = 0  # seconds, of ended servers

    @property
    def names(self) -> list[str]:
        """The names of the servers that hold a slot."""
        return [ids.server_name(label, held.attempt) for label, held in self.slots.items()]

    def with_server(self, project: Project, server: Server) -> ServerSlots | None:
        """Give this server a slot. Return the same record if it holds one already, None if there is none.

        The slot of a lost server is kept for the participant's next attempt.
        """
        mine = self.slots.get(server.label)
        wanted = ServerSlot(server.attempt, seconds_reserved(server), server.is_warm_server)
        if mine == wanted:
            return self
        others = {label: held for label, held in self.slots.items() if label != server.label}
        before_it = [held for held in others.values() if server.is_warm_server or not held.is_warm_server]
        used = self.used + (mine.reserved if mine else 0)  # of an attempt that was never released
        if mine is None and project.max_servers is not None and len(before_it) >= project.max_servers:
            return None
        hours = project.max_server_hours
        if hours is not None and used + sum(h.reserved for h in before_it) + wanted.reserved > hours * 3600:
            return None
        return ServerSlots({**others, server.label: wanted}, used)

    def free_slots(self, project: Project, seconds: int) -> int | None:
        """How many more servers, each reserving `seconds`, would get a slot. Below 0 if there are too many servers.

        None if the project does not limit servers.
        """
        rooms = []
        if project.max_servers is not None:
            rooms.append(project.max_servers - len(self.slots))
        if project.max_server_hours is not None:
            left = project.max_server_hours * 3600 - self.used - sum(held.reserved for held in self.slots.values())
            rooms.append(left // seconds)
        return min(rooms, default=None)

    def released(self, server: Server, seconds: int, *, keep: bool = False) -> ServerSlots:
        """Release this attempt, which used so many seconds. An attempt without a slot changes nothing.

        With `keep`, the slot stays for the participant's next attempt.
        """
        mine = self.slots.get(server.label)
        if mine is None or mine.attempt != server.attempt:
            return self
        held = {label: held for label, held in self.slots.items() if label != server.label}
        if keep:
            held[server.label] = ServerSlot(server.attempt)
        return ServerSlots(held, self.used + min(seconds, mine.reserved))

    def without(self, label: str) -> ServerSlots:
        """Release a server whose use is not known: all that it reserved counts as used."""
        mine = self.slots.get(label)
        if mine is None:
            return self
        others = {other: held for other, held in self.slots.items() if other != label}
        return ServerSlots(others, self.used + mine.reserved)

    def without_all(self, gone: Mapping[str, tuple[int, int | None]]) -> ServerSlots:
        """Release these servers; `gone` has, by label, the attempt and the seconds used (None: not known).

        A slot that is held for another attempt stays.
        """
        held, used = {}, self.used
        for label, mine in self.slots.items():
            attempt, seconds = gone.get(label, (None, None))
            if attempt == mine.attempt:
                used += mine.reserved if seconds is None else min(seconds, mine.reserved)
            else:
                held[label] = mine
        return ServerSlots(held, used)


def seconds_reserved(server: Server) -> int:
    """The most seconds that a server can use: up to its deadline."""
    return math.ceil((server.deadline - server.requested).total_seconds())


def seconds_used(server: Server, reason: Reason, end: datetime) -> int:
    """The seconds that a server has used when it ends: since it was requested, as AWS bills nearly all of them."""
    if reason in NEVER_RAN:
        return 0
    return max(MIN_BILLED_SECONDS, math.ceil((end - server.requested).total_seconds()))
