"""Finds documents that cannot be read, and pages that cannot be rendered.

Each finding names the project, and says what the consequence is and what to do. An unreadable document harms no other
document, since every reader skips it. Participants are counted, never named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from functools import partial
from typing import Any

from hippodrome.console.formatting import count
from hippodrome.control.limits import rules as limits
from hippodrome.control.limits.rules import ParticipantSlots, ServerSlots
from hippodrome.control.lobby import decisions
from hippodrome.control.lobby.decisions import Decisions
from hippodrome.control.model import server, warm_pool
from hippodrome.control.model.design import Step
from hippodrome.control.model.participant import Participant, participant_key
from hippodrome.control.model.project import Project, UnreadableEntry
from hippodrome.control.model.records import from_json
from hippodrome.control.model.warm_pool import Pool
from hippodrome.control.participants import pages
from hippodrome.control.participants.pages import StepView
from hippodrome.control.participants.sandbox import FragmentError, records_mentioned
from hippodrome.control.ports import Documents, Entry
from hippodrome.control.storage import secret
from hippodrome.deployment.core import participants
from hippodrome.deployment.core.finding import Finding, bad, good, look
from hippodrome.deployment.core.server_records import READERS, SLACK, Records
from hippodrome.deployment.operate.doctor.check_context import CheckContext
from hippodrome.protocol.keys import sessions_folder
from hippodrome.protocol.session import parse

LATEST = 500  # participants of a project, and sessions, whose documents are read, the latest first
SHOWN = 3  # records that are named
OLDER = "The bucket keeps older versions: put the last good one in its place"


def documents(context: CheckContext) -> Iterator[Finding]:
    """Find documents that cannot be read: list of projects, records of servers and participants, slots, sessions."""
    diagnoses = [*_projects(context), *_secret(context), *_servers(context)]
    for project in context.projects:
        diagnoses += [
            *_shared(context.platform.documents, project),
            *_participants(context.platform.documents, project),
        ]
        diagnoses += _sessions(context.platform.documents, project) if project.has_sessions else ()
    yield from diagnoses or [good("documents", "All can be read.")]


def _projects(context: CheckContext) -> Iterator[Finding]:
    unread: list[UnreadableEntry] = []
    participants.registered_projects(context.platform.documents, unread)
    for entry in unread:
        check = f"project {entry.id}" if entry.id else "projects"
        yield bad(check, participants.unreadable(entry), participants.MEND)


def _secret(context: CheckContext) -> Iterator[Finding]:
    """Check that the installation's secret exists. Only functions may read it."""
    if context.projects and not any(entry.key == secret.KEY for entry in context.platform.documents.list(secret.KEY)):
        yield bad(
            "secret",
            f"{secret.KEY} is gone: pages answer with an error.",
            f"{OLDER}. Else `hippodrome register` makes another: signed links and completion codes change.",
        )


def _servers(context: CheckContext) -> Iterator[Finding]:
    records = Records(context.platform.documents)
    records.since(context.now - timedelta(minutes=context.platform.settings.max_runtime) - SLACK)
    if not records.unreadable:
        return
    shown = [server.key(label) for label in records.unreadable_labels[:SHOWN]]
    more = ["…"] if records.unreadable > SHOWN else []
    yield bad(
        "servers",
        f"{count(records.unreadable, 'record')} cannot be read ({', '.join([*shown, *more])}): these participants get "
        "no server, and the resources of their servers are not removed.",
        f"{OLDER}; or delete it, then run `hippodrome stop --all`, which ends servers without a record.",
    )


def _shared(documents: Documents, project: Project) -> Iterator[Finding]:
    """Check the documents with a project's slots and its pool of warm servers."""
    check = f"project {project.id}"
    if project.limits_servers and not _is_readable(documents, limits.server_slots_key(project.id), ServerSlots):
        yield bad(
            check,
            f"{limits.server_slots_key(project.id)} cannot be read, so no server of this project starts.",
            f"{OLDER}; or delete it while none of its servers runs (`hippodrome stop {project.id}`): "
            "the count begins anew, and with it the hours of maxServerHours.",
        )
    limited = project.max_participants is not None
    slots = documents.list(limits.participant_slots_folder(project.id)) if limited else ()
    for key in sorted(entry.key for entry in slots):
        if not _is_readable(documents, key, ParticipantSlots):
            yield bad(
                check,
                f"{key} cannot be read: some newcomers are not let in.",
                f"{OLDER}; or delete it and register the project again, which counts those who are there.",
            )
    if project.warm_servers and not _is_readable(documents, warm_pool.pool_key(project.id), Pool):
        yield look(
            check,
            f"{warm_pool.pool_key(project.id)} cannot be read: it is made anew, and its warm servers are replaced.",
            "Nothing needs to be done; if it comes back, see `hippodrome logs --all --function sweep`.",
        )


def _sessions(documents: Documents, project: Project) -> Iterator[Finding]:
    """Check the lobby's decisions, and the documents of the latest sessions."""
    check, key = f"project {project.id}", decisions.key(project.id)
    if not _is_readable(documents, key, Decisions):
        yield look(
            check,
            f"{key} cannot be read: it is made anew, and servers that were started ahead are replaced.",
            "Nothing needs to be done; if it comes back, see `hippodrome logs --all --function sweep`.",
        )
    entries = (entry for entry in documents.list(sessions_folder(project.id)) if entry.key.endswith("/session.json"))
    read = _read_latest(documents, entries, parse)
    if wrong := read.count(False):
        yield bad(
            check,
            f"The documents of {wrong:,} of the latest {count(len(read), 'session')} cannot be read: their members are "
            "not let in to the game, and their data lack who played whom.",
            f"{OLDER}.",
        )


def _participants(documents: Documents, project: Project) -> Iterator[Finding]:
    entries = (
        entry
        for user, those in participants.folders(documents, project.id)
        for entry in those
        if entry.key == participant_key(project.id, user)
    )
    read = _read_latest(documents, entries, partial(from_json, kind=Participant))
    if wrong := read.count(False):
        yield look(
            f"project {project.id}",
            f"{count(wrong, 'record')} of the latest {count(len(read), 'participant')} cannot be read: their pages and "
            "their data lack when they came, their group, and what their link carried.",
            f"{OLDER}, or leave it: the answers are documents of their own.",
        )


def _read_latest(documents: Documents, entries: Iterable[Entry], read: Callable[[bytes], object]) -> list[bool]:
    """Return, for each of the `LATEST` newest of these documents, whether it can be read."""
    latest = sorted(entries, key=lambda entry: entry.modified, reverse=True)[:LATEST]
    with ThreadPoolExecutor(READERS) as pool:
        return list(pool.map(lambda entry: _can_be_read(documents, entry.key, read), latest))


def _is_readable(documents: Documents, key: str, kind: type[Any]) -> bool:
    """Whether a document can be read as a record of this kind, or does not exist."""
    return _can_be_read(documents, key, partial(from_json, kind=kind))


def _can_be_read(documents: Documents, key: str, read: Callable[[bytes], object]) -> bool:
    """Whether `read`, which raises ValueError, accepts a document, or there is none."""
    document = documents.get(key)
    try:
        if document:
            read(document.body)
    except ValueError:
        return False
    return True


def step_pages(context: CheckContext) -> Iterator[Finding]:
    """Find the projects' pages that are missing, or cannot be rendered for a participant without data."""
    wrong = [finding for project in context.projects for finding in _pages(context.platform.documents, project)]
    yield from wrong or [good("pages", "All are there and can be shown.")]


def _pages(documents: Documents, project: Project) -> Iterator[Finding]:
    for step in project.steps:
        for file in step.files:
            document = documents.get(project.page_key(file))
            if document is None:
                yield bad(f"project {project.id}", f"Step {step.key}: {file}.html is missing.", _again(project))
            else:
                yield from _page(project, step, file, document.body.decode("utf-8", "replace"))


def _page(project: Project, step: Step, file: str, source: str) -> Iterator[Finding]:
    values = {
        "project": {"id": project.id, "name": project.name, "researcher": project.researcher},
        "participant": {"userId": "nobody"},
        "group": 0,
        "completion_code": "CODE",
        "answers": {},
    }
    view = StepView(project, step, "nobody", source, values, ticket="0", action="/next", final=False)
    try:
        pages.fragment(view)
    except FragmentError as error:
        line = f" (line {error.line})" if error.line else ""
        if records_mentioned(source):
            text = f"Step {step.key}: {file}.html{line} fails for a participant without answers: {error.message}"
            yield look(f"project {project.id}", text, "Make sure that every participant who may come there can see it.")
        else:
            text = f"Step {step.key}: {file}.html{line} cannot be shown: {error.message}"
            yield bad(f"project {project.id}", text, _again(project))


def _again(project: Project) -> str:
    return f"Mend it in the folder of {project.id} (`hippodrome check` shows the line), and register the project again."
