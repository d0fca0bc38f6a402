"""A step that is a researcher's page: shown in the frame, answered by a form."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hippodrome import http
from hippodrome.http import Response
from hippodrome.log import logger
from hippodrome.model import ids
from hippodrome.model.project import Project, Step
from hippodrome.participants import fragments, frame, pages
from hippodrome.participants.forms import Form
from hippodrome.participants.page_error import CONTENT_NOT_FOUND, PageError
from hippodrome.participants.steps.services import StepServices
from hippodrome.participants.steps.visit import Visit


class PageStep:
    """Implements `StepHandler`."""

    def __init__(self, services: StepServices) -> None:
        self._services = services

    def show(self, visit: Visit) -> Response:
        """Return the page, filled in for this participant; for a program, the researcher's part of it as JSON."""
        project, step = visit.project, visit.step
        file = project.file(visit.user_id, step)
        source = self._services.project_cache.page(project, file)
        if source is None:
            logger.error("step page missing", extra={"project": project.id, "file": file})
            text = "It was not uploaded. Please tell whoever invited you."
            raise PageError(500, "This page is missing", text, CONTENT_NOT_FOUND)
        view = pages.StepView(
            project=project,
            step=step,
            user_id=visit.user_id,
            source=source,
            values=self._values(visit, fragments.records_mentioned(source)),
            ticket=ids.ticket(project.secret, visit.user_id, step.key),
            action=visit.request.url(),
            files=visit.request.steps_folder(project.id),
            final=step.key == project.final.key,
            answered=step.key in visit.progress.answered,
        )
        try:
            if visit.request.wants_json:
                return http.as_json(
                    200,
                    {"page": pages.fragment(view), "css": frame.style(), "step": step.key, "ticket": view.ticket},
                )
            page = pages.step_page(view)
        except fragments.FragmentError as error:
            logger.error("step page broken", extra={"project": project.id, "file": file, "line": error.line})
            raise PageError(
                500, "This page is broken", "It could not be shown. Please tell whoever invited you."
            ) from None
        return http.html(200, page.html, page.headers)

    def post(self, project: Project, user_id: str, step: Step, form: Form) -> None:
        """Store the answers, which moves the participant on (`participants/answers.py`)."""
        self._services.answers.store(project, user_id, step, form.answers)

    def _values(self, visit: Visit, mentioned: frozenset[str]) -> Mapping[str, Any]:
        """The values that a step page may use. Records are read only if the page mentions them."""
        project, user_id, repository = visit.project, visit.user_id, self._services.repository
        values: dict[str, Any] = {
            "project": {"id": project.id, "name": project.name, "researcher": project.researcher},
            "participant": {"userId": user_id},
            "group": project.group(user_id, visit.step),
            "completion_code": ids.completion_code(project.secret, user_id),
        }
        if "participant" in mentioned:
            known = repository.participant(project.id, user_id)
            values["participant"] = {**(known.link if known else {}), "userId": user_id}
        named = [key for key in visit.progress.answered if "answers" in mentioned or f"answers.{key}" in mentioned]
        values["answers"] = {key: self._services.answers.read(project.id, user_id, key) for key in named}
        return values
