"""Takes and gives back the places of projects that have limits; the others never come here."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime, timedelta
from functools import partial
from typing import NamedTuple

from hippodrome.limits import rules as limits
from hippodrome.limits.rules import SHARDS, ParticipantSlots, ServerSlots
from hippodrome.log import failure
from hippodrome.model import ids, server
from hippodrome.model.project import Project
from hippodrome.model.records import from_json
from hippodrome.model.server import Reason, Server
from hippodrome.ports import Platform
from hippodrome.storage.compare_and_swap import SharedDocuments

FULL_FOR = timedelta(seconds=10)  # how long a full study is not asked again


class Release(NamedTuple):
    """A server that goes, and why."""

    server: Server
    reason: Reason


class Slots:
    """One per running function: it remembers for a moment which studies were full."""

    def __init__(self, platform: Platform) -> None:
        self._platform = platform
        self._shared = SharedDocuments(platform.documents)
        self._full: dict[str, tuple[int, datetime]] = {}

    # Participants

    def admit(self, project: Project, user_id: str) -> bool:
        """Whether a newcomer may take part: two calls, or none in a project without `maxParticipants`.

        Who holds a place keeps it, also where a crash came before `participant.json` was written.
        """
        limit = project.max_participants
        if limit is None or self._is_known_full(project, limit):
            return limit is None
        label = ids.server_label(project.id, user_id)
        first = limits.first_shard(label, limit)
        for shard in range(first, first + SHARDS):
            key, usual = (
                limits.participant_slots_key(project.id, shard % SHARDS),
                limits.shard_share(limit, shard % SHARDS),
            )
            people = self._shared.change(
                key, ParticipantSlots, partial(ParticipantSlots.with_participant, label=label, usual=usual)
            ).after
            if label in people.labels:
                return True
        self._full[project.id] = (limit, self._platform.now() + FULL_FOR)
        return False

    def _is_known_full(self, project: Project, limit: int) -> bool:
        full = self._full.get(project.id)
        return full is not None and full[0] == limit and self._platform.now() < full[1]

    def set_limit(self, project: Project, user_ids: Iterable[str]) -> None:
        """Divide `maxParticipants` among the shards, when it is new or another one, and count those who came before.

        A read for each shard, and two more calls for each where something changes; newcomers find the study full then.
        """
        limit = project.max_participants
        if limit is None:
            return
        keys = [limits.participant_slots_key(project.id, shard) for shard in range(SHARDS)]
        parts = [self._shared.read(key, ParticipantSlots) for key in keys]
        known = {label for part in parts for label in part.labels}
        new: dict[int, list[str]] = {}
        for label in {ids.server_label(project.id, user_id) for user_id in user_ids} - known:
            new.setdefault(limits.first_shard(label, limit), []).append(label)
        if not new and limits.is_divided(limit, parts):
            return
        for shard, key in enumerate(keys):
            self._shared.change(key, ParticipantSlots, partial(ParticipantSlots.without_room, new=new.get(shard, ())))
        parts = [self._shared.read(key, ParticipantSlots) for key in keys]
        free = max(0, limit - sum(limits.counts(parts)))
        for shard, key in enumerate(keys):
            self._shared.change(
                key, ParticipantSlots, partial(ParticipantSlots.with_room_for, more=limits.shard_share(free, shard))
            )

    def documents_naming(self, project_id: str, user_id: str) -> list[str]:
        """The documents that name this participant: one listing, and a read of each shard that there is.

        Whether one that cannot be read names them is not known: see `unreadable`.
        """
        label, readable = ids.server_label(project_id, user_id), self._participant_slots(project_id)
        return [key for key, people in readable.items() if people and label in people.labels]

    def unreadable(self, project_id: str) -> list[str]:
        """Documents of this project's participants' places that cannot be read. As many calls."""
        return [key for key, people in self._participant_slots(project_id).items() if people is None]

    def _participant_slots(self, project_id: str) -> dict[str, ParticipantSlots | None]:
        """By key, every document of participants' places; None for those that cannot be read."""
        ours = {limits.participant_slots_key(project_id, shard) for shard in range(SHARDS)}
        found: dict[str, ParticipantSlots | None] = {}
        for entry in self._platform.documents.list(limits.participant_slots_folder(project_id)):
            if entry.key in ours:
                try:
                    found[entry.key] = self._shared.read(entry.key, ParticipantSlots)
                except (ValueError, RecursionError) as error:
                    failure("participants' places cannot be read", error, project=project_id)
                    found[entry.key] = None
        return found

    def release_participant(self, project_id: str, user_id: str) -> None:
        """Give back an erased participant's place."""
        label = ids.server_label(project_id, user_id)
        for key in self.documents_naming(project_id, user_id):
            self._shared.change(key, ParticipantSlots, partial(ParticipantSlots.without, label=label))

    # Servers

    def acquire(self, project: Project, record: Server) -> bool:
        """A place for a server whose record is written; whether there is one. Two calls, or none if it is not counted.

        Where there is none, a place kept from an earlier attempt is given back too.
        """
        if not record.counted:
            return True

        def take(running: ServerSlots) -> ServerSlots:
            return running.with_server(project, record) or running.without(record.label)

        return record.label in self._shared.change(limits.server_slots_key(project.id), ServerSlots, take).after.slots

    def release(self, project_id: str, releases: Iterable[Release]) -> None:
        """The places of servers that are gone, before their records are closed. Two calls, however many they are.

        Who will be given another server by itself keeps the place for it.
        """
        now = self._platform.now()
        released = list(releases)

        def leave(running: ServerSlots) -> ServerSlots:
            for record, reason in released:
                keep = server.next_attempt(server.close(record, reason, now)) is not None
                running = running.released(record, limits.seconds_used(record, reason, now), keep=keep)
            return running

        self._shared.change(limits.server_slots_key(project_id), ServerSlots, leave)

    def server_slots(self, projects: Iterable[Project]) -> dict[str, ServerSlots]:
        """By project, the servers that hold a place: a read for each of these projects that has limits.

        Nothing is listed: what else lies beside these documents is never read.
        """
        found = {}
        for project in projects:
            if project.limits_servers and (
                document := self._platform.documents.get(limits.server_slots_key(project.id))
            ):
                try:
                    found[project.id] = from_json(document.body, ServerSlots)
                except (ValueError, RecursionError) as error:
                    failure("a project's places cannot be read", error, project=project.id)
        return found

    def release_forgotten(self, project_id: str, forgotten: Mapping[str, Server | None]) -> None:
        """Give back what these servers forgot to, by their names: two calls, however many they are.

        With each comes its own record, closed, or None if nothing tells of it any more.
        """
        gone = dict(filter(None, (_end(name, record) for name, record in forgotten.items())))
        self._shared.change(limits.server_slots_key(project_id), ServerSlots, lambda running: running.without_all(gone))


def _end(name: str, record: Server | None) -> tuple[str, tuple[int, int | None]] | None:
    """A server's label, its attempt, and the seconds that it has used; None for these if its record does not tell."""
    label, attempt = ids.parse_server_name(name) or ("", 0)
    if not label:
        return None
    if record is None or record.attempt != attempt or record.closed is None or record.reason is None:
        return label, (attempt, None)
    return label, (attempt, limits.seconds_used(record, record.reason, record.closed))
