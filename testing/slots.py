"""Gives back the slots of participants, as an erasure does."""

from __future__ import annotations

from functools import partial

from hippodrome.control.limits.rules import ParticipantSlots, participant_slots_folder
from hippodrome.control.model import ids
from hippodrome.control.ports import Documents
from hippodrome.control.storage.compare_and_swap import SharedDocuments


def release_participant(documents: Documents, project_id: str, user_id: str) -> None:
    """Take a participant out of the documents of slots (`maxParticipants`)."""
    leave = partial(ParticipantSlots.without, label=ids.server_label(project_id, user_id))
    for entry in [*documents.list(participant_slots_folder(project_id))]:
        SharedDocuments(documents).change(entry.key, ParticipantSlots, leave)
