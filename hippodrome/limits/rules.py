"""What a project's limits allow: pure records of who holds a place, and the rules that give and take one.

Two kinds of places. Participants keep theirs for good; there are `SHARDS` documents of them, so that a crowd does not
wait for one. Servers hold theirs while they run; there is one document per project, in which a single conditional
write settles both how many run at once and how many hours they may have in all. A server reserves the hours up to its
deadline when it takes its place, and pays what it used when it leaves: what is used and reserved together never
exceeds the limit. Warm servers for somebody (`warmServers`) hold places, too, but keep no participant out: they
are given up when the project fills.
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

SHARDS = 16  # documents of participants; never another number, or those who are there are not found again
NEVER_RAN = (Reason.REFUSED, Reason.NO_CAPACITY)  # AWS said no: nothing is billed
MIN_BILLED_SECONDS = 60  # seconds that Fargate bills at least


def participant_slots_folder(project_id: str) -> str:
    """Where the participants' places lie."""
    return f"{project_id}/places/"


def participant_slots_key(project_id: str, shard: int) -> str:
    """Where one part of them lies."""
    return f"{participant_slots_folder(project_id)}{shard}.json"


SERVER_SLOTS = "_places/"


def server_slots_key(project_id: str) -> str:
    """Where the places of a project's servers lie."""
    return f"{SERVER_SLOTS}{project_id}.json"


class ParticipantSlots(Record, frozen=True):
    """`{projectId}/places/{shard}.json`: the labels of those who hold a place, and how many may.

    The rooms of all shards together are the limit. Registering divides it anew when it changes; a shard that was never
    written has its `share` of it.
    """

    labels: tuple[str, ...] = ()
    room: int | None = None

    def with_participant(self, label: str, usual: int) -> ParticipantSlots:
        """With this participant; the same record if they are there already, or if this shard is full."""
        room = usual if self.room is None else self.room
        if label in self.labels or len(self.labels) >= room:
            return self
        return ParticipantSlots((*self.labels, label), room)

    def without(self, label: str) -> ParticipantSlots:
        """Without this participant, whose place is free again."""
        return ParticipantSlots(tuple(other for other in self.labels if other != label), self.room)

    def without_room(self, new: Iterable[str] = ()) -> ParticipantSlots:
        """With those who came before there was a limit, and room for nobody else."""
        labels = tuple(dict.fromkeys((*self.labels, *new)))
        return ParticipantSlots(labels, len(labels))

    def with_room_for(self, more: int) -> ParticipantSlots:
        """With room for so many more than are there."""
        return ParticipantSlots(self.labels, len(self.labels) + more)


def shard_share(limit: int, shard: int) -> int:
    """How many of `limit` places one shard gives out."""
    return limit // SHARDS + (shard < limit % SHARDS)


def is_divided(limit: int, parts: Sequence[ParticipantSlots]) -> bool:
    """Whether the shards together have the limit as their room; where more are there already, room for no more."""
    rooms = [shard_share(limit, n) if part.room is None else part.room for n, part in enumerate(parts)]
    return sum(map(max, rooms, counts(parts))) == max(limit, sum(counts(parts)))


def counts(parts: Sequence[ParticipantSlots]) -> list[int]:
    """How many are in each shard."""
    return [len(part.labels) for part in parts]


def first_shard(label: str, limit: int) -> int:
    """The shard where somebody's place is looked for first: one that has a share.

    Who took a place, crashed before `participant.json`, and comes back under another limit may hold two: too few
    others are let in then, never too many.
    """
    return hashlib.sha256(label.encode()).digest()[0] % min(SHARDS, limit)


class ServerSlot(Record, frozen=True):
    """A server's place: for which attempt, and the seconds it may still use."""

    attempt: int
    reserved: int = 0
    warm_server: bool = msgspec.field(default=False, name="spare")


class ServerSlots(Record, frozen=True):
    """`_places/{projectId}.json`: the servers that hold a place, by label, and the seconds that others have used."""

    slots: Mapping[str, ServerSlot] = msgspec.field(default_factory=dict, name="held")
    used: int = 0  # seconds, of servers that are gone

    @property
    def names(self) -> list[str]:
        """The servers by their names."""
        return [ids.server_name(label, held.attempt) for label, held in self.slots.items()]

    def with_server(self, project: Project, server: Server) -> ServerSlots | None:
        """With this server; the same record if it holds its place already; None if there is no room.

        A participant whose server was lost holds their place until the next attempt takes it over.
        """
        mine, wanted = (
            self.slots.get(server.label),
            ServerSlot(server.attempt, seconds_reserved(server), server.is_warm_server),
        )
        if mine == wanted:
            return self
        others = {label: held for label, held in self.slots.items() if label != server.label}
        before_it = [held for held in others.values() if server.is_warm_server or not held.warm_server]
        used = self.used + (mine.reserved if mine else 0)  # of an attempt that never said what it used
        if mine is None and project.max_servers is not None and len(before_it) >= project.max_servers:
            return None
        hours = project.max_server_hours
        if hours is not None and used + sum(h.reserved for h in before_it) + wanted.reserved > hours * 3600:
            return None
        return ServerSlots({**others, server.label: wanted}, used)

    def free_slots(self, project: Project, seconds: int) -> int | None:
        """How many more servers find a place that reserve so many seconds each; below 0 if there are too many.

        None if the project has no limits.
        """
        rooms = []
        if project.max_servers is not None:
            rooms.append(project.max_servers - len(self.slots))
        if project.max_server_hours is not None:
            left = project.max_server_hours * 3600 - self.used - sum(held.reserved for held in self.slots.values())
            rooms.append(left // seconds)
        return min(rooms, default=None)

    def released(self, server: Server, seconds: int, *, keep: bool = False) -> ServerSlots:
        """Without this attempt, which used so many seconds; an equal record if that has been said before.

        With `keep` the place waits for the participant's next attempt.
        """
        mine = self.slots.get(server.label)
        if mine is None or mine.attempt != server.attempt:
            return self
        held = {label: held for label, held in self.slots.items() if label != server.label}
        if keep:
            held[server.label] = ServerSlot(server.attempt)
        return ServerSlots(held, self.used + min(seconds, mine.reserved))

    def without(self, label: str) -> ServerSlots:
        """Without a server of which nothing is known any more: it counts with all that it reserved."""
        mine = self.slots.get(label)
        if mine is None:
            return self
        return ServerSlots(
            {other: held for other, held in self.slots.items() if other != label}, self.used + mine.reserved
        )

    def without_all(self, gone: Mapping[str, tuple[int, int | None]]) -> ServerSlots:
        """Without these servers, by label: which attempt it was, and the seconds it used, None if nobody knows.

        One that holds its place for another attempt stays.
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
    """The seconds that a server may use at most: it ends at its deadline."""
    return math.ceil((server.deadline - server.requested).total_seconds())


def seconds_used(server: Server, reason: Reason, end: datetime) -> int:
    """The seconds that a server has used when it ends so: from its request on, as AWS bills nearly all of them."""
    if reason in NEVER_RAN:
        return 0
    return max(MIN_BILLED_SECONDS, math.ceil((end - server.requested).total_seconds()))
