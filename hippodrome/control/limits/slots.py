"""Takes and releases the slots of projects that have limits. For other projects it makes no call."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from datetime import datetime, timedelta
from functools import partial
from typing import NamedTuple

from hippodrome.control.limits import rules as limits
from hippodrome.control.limits.rules import SHARDS, ParticipantSlots, ServerSlots
from hippodrome.control.log import failure
from hippodrome.control.model import ids
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Reason, Server
from hippodrome.control.ports import Platform
from hippodrome.control.storage.compare_and_swap import SharedDocuments

FULL_FOR = timedelta(seconds=10)  # so long a function remembers that a study is full, and makes no call for it


class Release(NamedTuple):
    """A server that ends, the reason, and whether its slot is kept for the next attempt."""

    server: Server
    reason: Reason
    keep: bool = False


class Slots:
    """The slots of all projects. Each running function has one `Slots`, which remembers full studies for `FULL_FOR`."""

    def __init__(self, platform: Platform) -> None:
        self._platform = platform
        self._shared = SharedDocuments(platform.documents)
        self._full: dict[str, tuple[int, datetime]] = {}  # by project: the limit, and until when it is reached

    # Participants

    def admit(self, project: Project, user_id: str) -> bool:
        """Give a newcomer a slot; return False if none is free. In a project without `maxParticipants`, return True.

        A participant who holds a slot keeps it, even if `participant.json` was not written because of a crash. AWS
        calls: usually two; none without `maxParticipants`.
        """
        limit = project.max_participants
        if limit is None or self._is_known_full(project, limit):
            return limit is None
        label = ids.server_label(project.id, user_id)
        first = limits.first_shard(label, limit)
        for shard in range(first, first + SHARDS):
            key = limits.participant_slots_key(project.id, shard % SHARDS)
            usual = limits.shard_share(limit, shard % SHARDS)
            add = partial(ParticipantSlots.with_participant, label=label, usual=usual)
            if label in self._shared.change(key, ParticipantSlots, add).after.labels:
                return True
        self._full[project.id] = (limit, self._platform.now() + FULL_FOR)
        return False

    def _is_known_full(self, project: Project, limit: int) -> bool:
        full = self._full.get(project.id)
        return full is not None and full[0] == limit and self._platform.now() < full[1]

    def set_limit(self, project: Project, user_ids: Iterable[str]) -> None:
        """Divide a new or changed `maxParticipants` among the shards; `user_ids` are the participants so far.

        AWS calls: one read of each shard. If something has to change, each shard is written twice, and until that is
        over the study is full for newcomers.
        """
        limit = project.max_participants
        if limit is None:
            return
        keys = [limits.participant_slots_key(project.id, shard) for shard in range(SHARDS)]
        parts = [self._shared.read(key, ParticipantSlots) for key in keys]
        labels = {label for part in parts for label in part.labels}
        new: dict[int, list[str]] = {}
        for label in {ids.server_label(project.id, user_id) for user_id in user_ids} - labels:
            new.setdefault(limits.first_shard(label, limit), []).append(label)
        if not new and limits.is_divided(limit, parts):
            return
        for shard, key in enumerate(keys):
            self._shared.change(key, ParticipantSlots, partial(ParticipantSlots.without_room, new=new.get(shard, ())))
        parts = [self._shared.read(key, ParticipantSlots) for key in keys]
        free = max(0, limit - sum(limits.counts(parts)))
        for shard, key in enumerate(keys):
            more = limits.shard_share(free, shard)
            self._shared.change(key, ParticipantSlots, partial(ParticipantSlots.with_room_for, more=more))

    # Servers

    def acquire(self, project: Project, record: Server) -> bool:
        """Take a slot for a server whose record is written; return False if none is free.

        If none is free, a slot that was kept from an earlier attempt is released, too. AWS calls: two; none if the
        project does not limit servers.
        """
        if not record.counted:
            return True

        def take(running: ServerSlots) -> ServerSlots:
            return running.with_server(project, record) or running.without(record.label)

        return record.label in self._shared.change(limits.server_slots_key(project.id), ServerSlots, take).after.slots

    def release(self, project_id: str, releases: Iterable[Release]) -> None:
        """Release the slots of servers that have ended, before their records are closed.

        AWS calls: two for all of them.
        """
        now = self._platform.now()
        released = list(releases)

        def leave(running: ServerSlots) -> ServerSlots:
            for record, reason, keep in released:
                running = running.released(record, limits.seconds_used(record, reason, now), keep=keep)
            return running

        self._shared.change(limits.server_slots_key(project_id), ServerSlots, leave)

    def server_slots(self, projects: Iterable[Project]) -> dict[str, ServerSlots]:
        """Return the slots of servers, by project. A project whose slots cannot be read is left out.

        AWS calls: one read for each of these projects that limits servers. There is no listing, so no other document in
        that folder is read.
        """
        server_slots = {}
        for project in projects:
            if project.limits_servers:
                try:
                    server_slots[project.id] = self._shared.read(limits.server_slots_key(project.id), ServerSlots)
                except ValueError as error:
                    failure("a project's slots cannot be read", error, project=project.id)
        return server_slots

    def release_forgotten(self, project_id: str, forgotten: Mapping[str, Server | None]) -> None:
        """Release slots that servers still hold although they have ended. AWS calls: two for all of them.

        `forgotten` maps a server's name to its closed record; None if the server has no record any more.
        """
        ended = {}
        for name, record in forgotten.items():
            if (parsed := ids.parse_server_name(name)) is not None:
                label, attempt = parsed
                ended[label] = attempt, _seconds_used(record, attempt)
        self._shared.change(limits.server_slots_key(project_id), ServerSlots, lambda slots: slots.without_all(ended))


def _seconds_used(record: Server | None, attempt: int) -> int | None:
    """The seconds that this attempt used; None if there is no record, or if it is at another attempt or not closed."""
    if record is None or record.attempt != attempt or record.closed is None or record.reason is None:
        return None
    return limits.seconds_used(record, record.reason, record.closed)
