"""Finds documents that cannot be read, and pages that cannot be rendered.

Each finding names the project, and says what the consequence is and what to do. An unreadable document harms no other
document, since every reader skips it.
"""

from __future__ import annotations

from collections.abc import Iterator
from datetime import timedelta
from typing import Any

from hippodrome.console.formatting import count
from hippodrome.control.limits import rules as limits
from hippodrome.control.model import server
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project, UnreadableEntry
from hippodrome.control.model.records import from_json
from hippodrome.control.participants import pages
from hippodrome.control.participants.pages import StepView
from hippodrome.control.participants.sandbox import FragmentError, records_mentioned
from hippodrome.control.ports import Documents
from hippodrome.control.storage import secret
from hippodrome.deployment.core import participants
from hippodrome.deployment.core.finding import Finding, bad, good, look
from hippodrome.deployment.core.server_records import SLACK, Records
from hippodrome.deployment.operate.doctor.check_context import CheckContext

SHOWN = 3  # records that are named
OLDER = "The bucket keeps older versions: put the last good one in its place"


def documents(context: CheckContext) -> Iterator[Finding]:
    """Find documents that cannot be read and that nothing makes anew: list of projects, servers' records, slots."""
    diagnoses = [*_projects(context), *_secret(context), *_servers(context)]
    for project in context.projects:
        diagnoses += _slots(context.platform.documents, project)
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


def _slots(documents: Documents, project: Project) -> Iterator[Finding]:
    check, key = f"project {project.id}", limits.server_slots_key(project.id)
    if project.limits_servers and not _is_readable(documents, key, limits.ServerSlots):
        yield bad(
            check,
            f"{key} cannot be read, so no server of this project starts.",
            f"{OLDER}; or delete it while none of its servers runs (`hippodrome stop {project.id}`): "
            "the count begins anew, and with it the hours of maxServerHours.",
        )
    folder = limits.participant_slots_folder(project.id)
    for entry in documents.list(folder) if project.max_participants is not None else ():
        if not _is_readable(documents, entry.key, limits.ParticipantSlots):
            yield bad(
                check,
                f"{entry.key} cannot be read: some newcomers are not let in.",
                f"{OLDER}; or delete it and register the project again, which counts those who are there.",
            )


def _is_readable(documents: Documents, key: str, kind: type[Any]) -> bool:
    """Whether a document can be read as a record of this kind, or does not exist."""
    document = documents.get(key)
    try:
        if document:
            from_json(document.body, kind)
    except ValueError:
        return False
    return True


def step_pages(context: CheckContext) -> Iterator[Finding]:
    """Find the projects' pages that are missing, or cannot be rendered for a participant without data."""
    wrong = [finding for project in context.projects for finding in _pages(context.platform.documents, project)]
    yield from wrong or [good("pages", "All are there and can be shown.")]


def _pages(documents: Documents, project: Project) -> Iterator[Finding]:
    again = (
        f"Mend it in the folder of {project.id} (`hippodrome check` shows the line), and register the project again."
    )
    for step in project.steps:
        for file in step.files:
            document = documents.get(project.page_key(file))
            if document is None:
                yield bad(f"project {project.id}", f"Step {step.key}: {file}.html is missing.", again)
                continue
            source = document.body.decode("utf-8", "replace")
            error = _error_of(project, step, source)
            if error is None:
                continue
            what = f"Step {step.key}: {file}.html{f' (line {error.line})' if error.line else ''}"
            if records_mentioned(source):
                text = f"{what} fails for a participant without answers: {error.message}"
                advice = "Make sure that every participant who may come there can see it."
                yield look(f"project {project.id}", text, advice)
            else:
                yield bad(f"project {project.id}", f"{what} cannot be shown: {error.message}", again)


def _error_of(project: Project, step: Step, source: str) -> FragmentError | None:
    """Render the page for a participant without answers, and return why that fails."""
    values = {
        "project": {"id": project.id, "name": project.name, "researcher": project.researcher},
        "participant": {"userId": "nobody"},
        "group": 0,
        "completion_code": "CODE",
        "answers": {},
    }
    try:
        pages.fragment(StepView(project, step, "nobody", source, values, ticket="0", action="/next", final=False))
    except FragmentError as error:
        return error
    return None
