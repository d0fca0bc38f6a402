"""Reads the list of projects, and counts the participants of a project by their step.

A listing of the project's folder is enough: the keys of a participant's answers tell at which step they are.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from datetime import datetime

from hippodrome.console import screen
from hippodrome.console.problem import Problem
from hippodrome.control.model import ids
from hippodrome.control.model.participant import Progress, participant_key
from hippodrome.control.model.project import MASTER_LIST, Project, UnreadableEntry, read_list
from hippodrome.control.ports import Documents, Entry
from hippodrome.protocol.keys import participant_folder

MEND = "Register it again, or put an older version of that document in its place, which the bucket keeps."


@dataclass
class ParticipantCounts:
    """The numbers of a project's participants, in all and by step. It holds no ids."""

    participants: int = 0
    by_step: dict[str, int] = field(default_factory=dict)  # step → participants at it, in the order of the steps
    finished: int = 0  # participants at the last step
    ended: int = 0  # participants at another end
    arrived_today: int = 0
    last_arrival: datetime | None = None


def registered_projects(documents: Documents, unread: list[UnreadableEntry] | None = None) -> list[Project]:
    """Read the registered projects, live or not, sorted by id. Raises `Problem` if their list cannot be read.

    Entries that cannot be read are added to `unread`; without `unread`, a warning is printed for each of them.
    """
    document = documents.get(MASTER_LIST)
    if document is None:
        return []
    try:
        listed = read_list(document.body)
        if unread is None:
            for entry in listed.unreadable:
                screen.warning(f"{unreadable(entry)} {MEND}")
        else:
            unread += listed.unreadable
        return sorted(listed.projects, key=lambda project: project.id)
    except ValueError as error:
        raise Problem(
            f"The list of projects cannot be read: {error}.",
            f"The bucket keeps older versions of {MASTER_LIST}: put the last good one in its place.",
        ) from None


def unreadable(entry: UnreadableEntry) -> str:
    """Write the sentence about an entry in the list of projects that cannot be read."""
    whose = f"the project {entry.id}" if entry.id else "a project without a well-formed id"
    return f"The entry of {whose} in {MASTER_LIST} cannot be read ({entry.why}): it counts as closed."


def choose(projects: Iterable[Project], project_id: str | None) -> list[Project]:
    """Return the project with this id; None: all. Raises `Problem` if no project has this id."""
    projects = list(projects)
    if project_id is None:
        return projects
    chosen = [project for project in projects if project.id == project_id]
    if not chosen:
        known_ids = ", ".join(project.id for project in projects) or "none"
        advice = f"Registered here: {known_ids}. `hippodrome register STUDY` adds one."
        raise Problem(f"No project named {project_id} is registered.", advice)
    return chosen


def count_participants(
    documents: Documents, project: Project, today: datetime, advance: Callable[[int], None] | None = None
) -> ParticipantCounts:
    """Count a project's participants, by a listing of its folder, 1,000 keys a request.

    `today` is the beginning of the day. `advance` gets the number of participants counted up to now. Folders without a
    participant's record, and ids that are not well formed, are not counted.
    """
    own = project.own(None)  # nobody's assignment is read: in a block, people are counted as if in the file's order
    participant_counts = ParticipantCounts(by_step={step.key: 0 for step in project.steps})
    for user_id, entries in folders(documents, project.id):
        arrived: datetime | None = None
        listed: list[Entry] = []
        for entry in entries:  # in key order: answers, the participant's record, then recordings, which are skipped
            listed.append(entry)
            if entry.key == participant_key(project.id, user_id):
                arrived = entry.modified
                break
        if arrived is None:
            continue
        progress = Progress.from_listing(participant_folder(project.id, user_id), listed)
        at = progress.due_step(own)
        participant_counts.participants += 1
        participant_counts.ended += progress.has_ended
        if not progress.has_ended:
            participant_counts.by_step[at.step_name] += 1
            participant_counts.finished += at.key == project.final.key
        participant_counts.arrived_today += arrived >= today
        participant_counts.last_arrival = max(arrived, participant_counts.last_arrival or arrived)
        if advance:
            advance(participant_counts.participants)
    return participant_counts


def folders(documents: Documents, project_id: str) -> Iterator[tuple[str, Iterator[Entry]]]:
    """Yield the well-formed ids of a project's participants, in key order, each with the entries of its folder."""
    prefix = f"{project_id}/users/"
    for user_id, entries in itertools.groupby(
        documents.list(prefix), key=lambda entry: entry.key.removeprefix(prefix).partition("/")[0]
    ):
        if ids.is_user_id(user_id):
            yield user_id, entries
