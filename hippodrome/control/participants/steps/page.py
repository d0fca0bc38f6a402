"""Shows a researcher's page, in the frame and answered by a form: a step, or an end before the last step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from hippodrome.control import http
from hippodrome.control.http import Response
from hippodrome.control.log import logger
from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.place import values_of
from hippodrome.control.model.sessions import Membership
from hippodrome.control.participants import frame, pages
from hippodrome.control.participants.forms import PostedForm, Showing
from hippodrome.control.participants.page_error import CONTENT_NOT_FOUND, PageError, program_message
from hippodrome.control.participants.path import Stop
from hippodrome.control.participants.sandbox import FragmentError, records_mentioned, shuffler
from hippodrome.control.participants.services import Services
from hippodrome.control.participants.visit import Visit


class PageStep:
    """Implements `StepHandler`."""

    def __init__(self, services: Services) -> None:
        self._services = services

    def show(self, stop: Stop) -> Response:
        """Return the page, filled in for this participant; for a program, the researcher's part of it as JSON."""
        visit, step = stop.visit, stop.step
        source = source_of(self._services, stop, step)
        waited = stop.progress.waited(visit.project, step, visit.now)
        shown = str(Showing(stop.number, int((visit.now - waited).timestamp()))) if step.is_limited else ""
        view = pages.StepView(
            project=visit.project,
            step=step,
            user_id=visit.user_id,
            source=source.text,
            values=source.values,
            ticket=ids.ticket(visit.project.secret, visit.user_id, step.key, shown),
            shown=shown,
            wrong=stop.wrong,
            tries_left=max(0, step.tries - stop.number + 1),
            least=max(0, math.ceil(step.min_seconds - waited.total_seconds())),
            action=visit.request.url(),
            final=step.key == visit.project.final.key,
            answered=step.key in stop.progress.answered,
        )
        return _response(visit, source, view)

    def post(self, visit: Visit, step: Step, form: PostedForm) -> None:
        """Store the answers, which moves the participant on; of a check as a try, which the next GET judges.

        Answers that come before `minSeconds` are over are not stored, and the page is shown again.
        """
        showing = Showing.read(form.shown)
        if step.min_seconds and (showing is None or visit.now.timestamp() - showing.since < step.min_seconds):
            return
        if step.right and showing is not None:
            self._services.answers.store_try(visit, step, showing.number, form.answers)
        elif not step.right:
            self._services.answers.store(visit, step, form.answers)


def show_end(services: Services, stop: Stop) -> Response:
    """Return the page of the end at which the participant is: the researcher's, or one in our own words.

    It has no form, since nothing is asked any more. Raises `PageError` if the researcher's file cannot be shown.
    """
    visit, ended = stop.visit, stop.ended
    assert ended is not None
    if stop.end is not None and stop.end.page:
        step = Step(stop.end.name, stop.end.page)
        source = source_of(services, replace(stop, step=step), step)
        values = {**source.values, "completion_code": ended.code, "end": ended.end}
        view = pages.StepView(
            project=visit.project,
            step=step,
            user_id=visit.user_id,
            source=source.text,
            values=values,
            ticket="",
            action=visit.request.url(),
            final=True,
            end=ended.end,
        )
        return _response(visit, source, view)
    if visit.request.wants_json:
        text = visit.texts["endText"]
        text += f" {visit.texts.say('endCode', code=ended.code)}" if ended.code else ""
        return program_message(200, visit.texts["endTitle"], text)
    page = pages.end_page(visit.project, visit.user_id, ended.end, ended.code, ended.link)
    return http.html(200, page.html, page.headers)


def _response(visit: Visit, source: PageSource, view: pages.StepView) -> Response:
    with rendering(visit, source):
        if visit.request.wants_json:
            step = "" if view.end else view.step.key
            data = {"page": pages.fragment(view), "css": frame.style(), "step": step, "ticket": view.ticket}
            return http.as_json(200, data)
        page = pages.step_page(view)
    return http.html(200, page.html, page.headers)


# The researcher's file, for steps of all types


class NeedsAssignment(Exception):
    """The page shows the participant's levels or orders, which are not drawn yet."""


@dataclass(frozen=True, slots=True)
class PageSource:
    """The text of a step file, and the values for it. `file` is its name without `.html`."""

    file: str
    text: str
    values: Mapping[str, Any]


def source_of(services: Services, stop: Stop, page: Step) -> PageSource:
    """Return the text of the page as this participant sees it, and the values for it.

    Raises `PageError` if the page was not uploaded.
    """
    project = stop.visit.project
    file = project.file(stop.visit.user_id, page)
    text = services.project_cache.page(project, file)
    if text is None:
        logger.error("step page missing", extra={"project": project.id, "file": file})
        raise PageError.of(stop.visit.texts, 500, "pageMissing", CONTENT_NOT_FOUND)
    return PageSource(file, text, _values(services, stop, page, text))


@contextmanager
def rendering(visit: Visit, *sources: PageSource) -> Iterator[None]:
    """Turn a `FragmentError`, raised in the body, into the `PageError` of a broken page, and log it."""
    try:
        yield
    except FragmentError as error:
        files = ", ".join(source.file for source in sources)
        logger.error("step page broken", extra={"project": visit.project.id, "file": files, "line": error.line})
        raise PageError.of(visit.texts, 500, "pageBroken") from None


def _values(services: Services, stop: Stop, page: Step, text: str) -> Mapping[str, Any]:
    """The values that a page may use. Records are read only if the page mentions them."""
    visit, standing = stop.visit, stop.standing
    project, user_id, repository = visit.project, visit.user_id, services.repository
    mentioned = records_mentioned(text)
    may_draw = project.assigns and not project.has_sessions  # with sessions the matching draws
    if standing.assignment is None and may_draw and mentioned & {"condition", "order"}:
        raise NeedsAssignment
    values: dict[str, Any] = {
        "project": {"id": project.id, "name": project.name, "researcher": project.researcher},
        "participant": {"userId": user_id},
        "group": project.group(user_id, page),
        "completion_code": ids.completion_code(project.secret, user_id),
        "wrong": list(stop.wrong),
        "shuffle": shuffler(f"{project.salt}/{user_id}/{page.key}"),
        **values_of(project, standing.assignment, stop.step),
    }
    if "participant" in mentioned:
        participant = repository.participant(project.id, user_id)
        values["participant"] = {**(participant.link if participant else {}), "userId": user_id}
    if project.has_sessions and ("participant" in mentioned or "completion_code" in text):
        membership = repository.membership(project.id, user_id) or Membership()
        values["participant"] |= {"unmatched": membership.unmatched, "members": membership.members}
        values["completion_code"] = membership.completion_code or values["completion_code"]
    if "completion_code" in text:
        games = [services.answers.read(visit, key) for key in stop.progress.answered_games(project)]
        codes = (str(game["completionCode"]) for game in games if "completionCode" in game)
        values["completion_code"] = next(codes, values["completion_code"])
    names = dict.fromkeys(step.step_name for step in project.steps if step.key in stop.progress.answered)
    steps_named = [name for name in names if "answers" in mentioned or f"answers.{name}" in mentioned]
    values["answers"] = {name: standing.answers_to(name, stop.step) for name in steps_named}
    return values
