"""Reads a researcher's page for one participant: its text, and the values that it may use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from hippodrome.control.log import logger
from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.memberships import Membership
from hippodrome.control.model.place import values_of
from hippodrome.control.model.texts import Texts
from hippodrome.control.participants.page_error import CONTENT_NOT_FOUND, PageError
from hippodrome.control.participants.sandbox import FragmentError, records_mentioned, shuffler
from hippodrome.control.participants.steps.services import StepServices
from hippodrome.control.participants.steps.visit import Visit


class NeedsAssignment(Exception):
    """The page shows the participant's levels or orders, which are not drawn yet."""


@dataclass(frozen=True, slots=True)
class PageSource:
    """The text of a step file, and the values for it. `file` is its name without `.html`."""

    file: str
    text: str
    values: Mapping[str, Any]


def source_of(services: StepServices, visit: Visit, page: Step) -> PageSource:
    """Return the text of the page as this participant sees it, and the values for it.

    Raises `PageError` if the page was not uploaded.
    """
    project = visit.project
    file = project.file(visit.user_id, page)
    text = services.project_cache.page(project, file)
    if text is None:
        logger.error("step page missing", extra={"project": project.id, "file": file})
        raise PageError.of(Texts(project.texts), 500, "pageMissing", CONTENT_NOT_FOUND)
    return PageSource(file, text, _values(services, visit, page, text))


@contextmanager
def rendering(visit: Visit, *sources: PageSource) -> Iterator[None]:
    """Turn a `FragmentError`, raised in the body, into the `PageError` of a broken page, and log it."""
    try:
        yield
    except FragmentError as error:
        files = ", ".join(source.file for source in sources)
        logger.error("step page broken", extra={"project": visit.project.id, "file": files, "line": error.line})
        raise PageError.of(Texts(visit.project.texts), 500, "pageBroken") from None


def _values(services: StepServices, visit: Visit, page: Step, text: str) -> Mapping[str, Any]:
    """The values that a page may use. Records are read only if the page mentions them."""
    project, user_id, repository, standing = visit.project, visit.user_id, services.repository, visit.standing
    mentioned = records_mentioned(text)
    may_draw = project.assigns and not project.has_sessions  # with sessions the matching draws
    if standing.assignment is None and may_draw and mentioned & {"condition", "order"}:
        raise NeedsAssignment
    values: dict[str, Any] = {
        "project": {"id": project.id, "name": project.name, "researcher": project.researcher},
        "participant": {"userId": user_id},
        "group": project.group(user_id, page),
        "completion_code": ids.completion_code(project.secret, user_id),
        "wrong": list(visit.wrong),
        "shuffle": shuffler(f"{project.salt}/{user_id}/{page.key}"),
        **values_of(project, standing.assignment, visit.step),
    }
    if "participant" in mentioned:
        participant = repository.participant(project.id, user_id)
        values["participant"] = {**(participant.link if participant else {}), "userId": user_id}
    if project.has_sessions and ("participant" in mentioned or "completion_code" in text):
        membership = repository.membership(project.id, user_id) or Membership()
        values["participant"] |= {"unmatched": membership.unmatched, "members": membership.members}
        values["completion_code"] = membership.completion_code or values["completion_code"]
    if "completion_code" in text:
        games = [services.answers.read(project.id, user_id, key) for key in visit.progress.answered_games(project)]
        codes = (str(game["completionCode"]) for game in games if "completionCode" in game)
        values["completion_code"] = next(codes, values["completion_code"])
    names = dict.fromkeys(step.step_name for step in project.steps if step.key in visit.progress.answered)
    steps_named = [name for name in names if "answers" in mentioned or f"answers.{name}" in mentioned]
    values["answers"] = {name: standing.answers_to(name, visit.step) for name in steps_named}
    return values
