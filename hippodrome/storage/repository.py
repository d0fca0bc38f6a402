"""What is written about participants and their servers, read from and put into documents."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import msgspec

from hippodrome.log import logger
from hippodrome.model import ids, participant, server
from hippodrome.model.participant import Participant, Progress
from hippodrome.model.records import from_json, to_json
from hippodrome.model.server import Server
from hippodrome.ports import Conflict, Documents
from protocol.answer import Answer
from protocol.keys import answer_key, participant_folder

TRIES = 8  # at a compare-and-swap before the queue has to bring the message again


class RetryLater(Exception):
    """Not possible yet: the queue should bring the message again."""

    expected = True  # nothing to be alarmed about, see `log.failure`


@dataclass(frozen=True)
class Versioned:
    """A server's record together with the ETag of the version we read or wrote."""

    server: Server
    etag: str


class Repository:
    """Typed reads and writes over the documents port. Each method is one call unless it says otherwise."""

    def __init__(self, documents: Documents) -> None:
        self._documents = documents

    # Participants

    def progress(self, project_id: str, user_id: str) -> Progress:
        """How far somebody has come, by a listing of their folder."""
        folder = participant_folder(project_id, user_id)
        return Progress.from_listing(folder, self._documents.list(folder))

    def participant(self, project_id: str, user_id: str) -> Participant | None:
        """Who they are; None if they have never opened the link, or if what is there is no record of anybody."""
        found = self._documents.get(participant.participant_key(project_id, user_id))
        try:
            return from_json(found.body, Participant) if found else None
        except (ValueError, RecursionError):
            logger.error("a participant's record cannot be read", extra={"project": project_id})
            return None

    def create_participant(self, record: Participant) -> bool:
        """Write down somebody's first visit; False if that has been done."""
        return self._create(participant.participant_key(record.project_id, record.user_id), to_json(record))

    def answers(self, project_id: str, user_id: str, step: str) -> Mapping[str, Any]:
        """What somebody answered at a step; empty if they have not, or if the document holds no answers.

        Trials write documents of this kind too, so that the code of an agent decides what is in them.
        """
        found = self._documents.get(answer_key(project_id, user_id, step))
        try:
            return msgspec.json.decode(found.body, type=Answers).answers if found else {}
        except (ValueError, RecursionError):
            logger.warning("an answer's document holds no answers", extra={"project": project_id, "step": step})
            return {}

    def create_answer(self, project_id: str, user_id: str, record: Answer) -> bool:
        """Keep an answer, which moves its author on; False if the step has been answered: the first answer stands."""
        body = msgspec.json.format(msgspec.json.encode(record), indent=1)
        return self._create(answer_key(project_id, user_id, record.step), body)

    def _create(self, key: str, body: bytes) -> bool:
        try:
            self._documents.create(key, body)
        except Conflict:
            return False
        return True

    # Servers

    def server_of(self, project_id: str, user_id: str) -> Server | None:
        """The participant's server; None if they never had one."""
        stored = self.server(ids.server_label(project_id, user_id))
        return stored.server if stored else None

    def server(self, label: str) -> Versioned | None:
        """The record under a label, to be changed."""
        found = self._documents.get(server.key(label))
        return Versioned(from_json(found.body, Server), found.etag) if found else None

    def owner(self, name: str) -> Versioned | None:
        """Return the record that owns this resource name, following handovers.

        One read, two for an assigned warm server. The record may be of another attempt by now: its `name` tells.
        """
        return server.owner(name, self.server, lambda stored: stored.server)

    def create(self, record: Server) -> Versioned:
        """Write the first record of a participant's servers. Raises `Conflict` if there is one."""
        return Versioned(record, self._documents.create(server.key(record.label), to_json(record)))

    def save(self, record: Server, etag: str) -> Versioned:
        """Write the next version. Raises `Conflict` if somebody was faster."""
        return Versioned(record, self._documents.replace(server.key(record.label), to_json(record), etag))

    def update(self, stored: Versioned | None, change: Callable[[Server], Server | None]) -> Versioned | None:
        """Apply `change` to the record and write it, reading it anew as often as somebody else was faster.

        None if `change` wants nothing written, or there is no record. Raises `RetryLater` if it never settles.
        """
        for _ in range(TRIES):
            after = change(stored.server) if stored else None
            if stored is None or after is None:
                return None
            try:
                return self.save(after, stored.etag)
            except Conflict:
                stored = self.server(after.label)
        raise RetryLater("the record keeps changing")


class Answers(msgspec.Struct):
    """The part of an answer's document that pages show; whoever wrote it."""

    answers: dict[str, Any] = {}
