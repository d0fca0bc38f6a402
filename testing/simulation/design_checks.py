"""Checks the assignments, cells, answers and ends of a simulated installation, by its documents and its participants."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from hippodrome.control.model import participant
from hippodrome.control.model.balance import Cells, cells_key
from hippodrome.control.model.design import Assignment, Step, cell_name, latin_rows
from hippodrome.control.model.participant import Progress
from hippodrome.control.model.place import wrong_fields
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import from_json
from hippodrome.control.ports import Entry
from hippodrome.protocol import environment
from hippodrome.protocol.keys import answer_key, participant_folder
from hippodrome.protocol.session import ASSIGNMENT, assignment_key
from testing.clock import EPOCH
from testing.simulation.designs import Designed
from testing.simulation.lobby import StoredDocuments
from testing.simulation.world import SimulatedWorld

STOPPED_AFTER = 300.0  # seconds from an end until the server is stopped: a lost message comes again after 90
SETTLES = 3600.0  # seconds for which nobody counts as having left


def faults(world: SimulatedWorld, people: Sequence[Designed]) -> list[str]:
    """Return a sentence for each fault."""
    documents, project = world.platform.documents.kept, world.project
    found = [sentence for person in people for sentence in (*person.wrong, *_of_person(world, person))]
    return [*found, *_cells(documents, project, world.clock.seconds), *_servers(world)]


def _of_person(world: SimulatedWorld, person: Designed) -> Iterator[str]:
    """Compare what somebody was told with what is stored."""
    documents, project, user = world.platform.documents.kept, world.project, person.visit.user
    for key, body in person.stored.items():
        if documents[key][0] != body:
            yield f"{key} has changed"
    assignment = _assignment(documents, project, user)
    condition = assignment.condition if assignment else {}
    looks = ",".join(run[0] for run in assignment.orders.get("look", ())) if assignment else ""
    told = "".join(condition.get(name, "") for name in ("partner", "pay")) + f"/{looks}"
    if person.seen - {told}:
        yield f"{user} was told {sorted(person.seen)}, and is assigned to {told}"
    progress = _progress(documents, project, user)
    path = project.own(assignment).steps
    answered = [step.key in progress.answered for step in path[:-1]]
    if answered != sorted(answered, reverse=True):
        yield f"{user} has answered {sorted(progress.answered)}: a step was left out"
    strange = progress.answered.keys() - {step.key for step in path}
    if any(_answers(documents, project, user, key).get("outcome") != "unmatched" for key in strange):
        yield f"{user} has answered {strange}, not on their path"
    for step in path:
        if step.right and step.key in progress.answered:
            yield from _check(documents, project, user, step, progress)


def _check(documents: StoredDocuments, project: Project, user: str, step: Step, progress: Progress) -> Iterator[str]:
    """Judge a check again."""
    answers = _answers(documents, project, user, step.key)
    tries = progress.tries.get(step.key, 0)
    last = _answers(documents, project, user, f"{step.key}.{tries}") if tries else {}
    if step.tries and tries > step.tries:
        yield f"{user} had {tries} tries"
    if "outcome" not in answers and answers.get("passed") is not (not wrong_fields(step, last)):
        yield f"{user} answered {last} and has {answers}"


def _cells(documents: StoredDocuments, project: Project, seconds: float) -> Iterator[str]:
    """Count the people of each cell again."""
    if not (found := documents.get(cells_key(project.id))):
        return
    cells = from_json(found[0], Cells)
    owners = {
        key.split("/")[2]: from_json(body, Assignment)
        for key, (body, _, _) in documents.items()
        if key.startswith(f"{project.id}/{'sessions' if project.has_sessions else 'users'}/")
        and key.endswith(f"/{ASSIGNMENT}")
    }
    alone = {owner for owner, assignment in owners.items() if assignment.orders == {} and not assignment.condition}
    drawn = Counter(draw.cell for draw in cells.drawn.values())
    settled = Counter[str]()
    for owner, assignment in owners.items():
        cell = cell_name(assignment.condition)
        if owner in cells.drawn:
            yield from _drawn(project, owner, assignment, cells)
        elif owner not in alone and (project.has_sessions or _is_complete(documents, project, owner)):
            settled[cell] += 1
    for cell in sorted({*cells.people, *drawn, *settled}):
        least, most, counted = drawn[cell], drawn[cell] + settled[cell], cells.people.get(cell, 0)
        if not (least if seconds > SETTLES else most) <= counted <= most:
            yield f"the cell {cell!r} counts {counted}; {drawn[cell]} are drawn and {settled[cell]} settled"
    for name, uses in cells.rows.items():
        if sum(uses) > sum(cells.people.values()):
            yield f"the rows of {name} are used {uses}"


def _drawn(project: Project, owner: str, assignment: Assignment, cells: Cells) -> Iterator[str]:
    """Compare what was drawn for somebody with what they were assigned to."""
    draw = cells.drawn[owner]
    if draw.cell != cell_name(assignment.condition):
        yield f"{owner} is counted in {draw.cell!r} and assigned to {dict(assignment.condition)}"
    for block in project.blocks:
        order = [list(block.runs[place]) for place in latin_rows(len(block.runs))[draw.rows[block.name]]]
        if [list(run) for run in assignment.orders[block.name]] != order:
            yield f"{owner} drew the order {order} and has {assignment.orders[block.name]}"


def _servers(world: SimulatedWorld) -> Iterator[str]:
    """Find servers that ran on for participants who had reached an end."""
    documents = world.platform.documents.kept
    for task in world.platform.tasks.tasks.values():
        user = task.request.environment.get(environment.USER_ID, "")
        end = documents.get(participant.end_key(world.project.id, user)) if user else None
        if end is None:
            continue
        ended = (end[2] - EPOCH).total_seconds()
        if task.born > ended + 1:
            yield f"{task.name} was started {task.born - ended:.0f} s after the end"
        if task.closed is None or task.closed > ended + STOPPED_AFTER:
            yield f"{task.name} ran on after the end at {ended:.0f} s, until {task.closed}"


def _is_complete(documents: StoredDocuments, project: Project, user: str) -> bool:
    progress = _progress(documents, project, user)
    path = [step.key for step in project.own(_assignment(documents, project, user)).steps[:-1]]
    return all(step in progress.answered for step in path)


def _progress(documents: StoredDocuments, project: Project, user: str) -> Progress:
    folder = participant_folder(project.id, user)
    keys = sorted(key for key in documents if key.startswith(folder))
    return Progress.from_listing(folder, [Entry(key, documents[key][2], 0) for key in keys])


def _assignment(documents: StoredDocuments, project: Project, user: str) -> Assignment | None:
    found = documents.get(assignment_key(project.id, user))
    return from_json(found[0], Assignment) if found else None


def _answers(documents: StoredDocuments, project: Project, user: str, key: str) -> Mapping[str, Any]:
    found = documents.get(answer_key(project.id, user, key))
    return dict(json.loads(found[0])["answers"]) if found else {}
