"""Handles steps that are a researcher's page: it is shown in the frame and answered by a form."""

from __future__ import annotations

import math

from hippodrome.control import http
from hippodrome.control.http import Response
from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.participants import frame, pages
from hippodrome.control.participants.forms import PostedForm, Showing
from hippodrome.control.participants.steps.services import StepServices
from hippodrome.control.participants.steps.sources import rendering, source_of
from hippodrome.control.participants.steps.visit import Visit


class PageStep:
    """Implements `StepHandler`."""

    def __init__(self, services: StepServices) -> None:
        self._services = services

    def show(self, visit: Visit) -> Response:
        """Return the page, filled in for this participant; for a program, the researcher's part of it as JSON."""
        project, step = visit.project, visit.step
        source = source_of(self._services, visit, step)
        now = self._services.platform.now()
        waited = visit.progress.waited(project, step, now)
        shown = str(Showing(visit.number, int((now - waited).timestamp()))) if step.is_limited else ""
        view = pages.StepView(
            project=project,
            step=step,
            user_id=visit.user_id,
            source=source.text,
            values=source.values,
            ticket=ids.ticket(project.secret, visit.user_id, step.key, shown),
            shown=shown,
            wrong=visit.wrong,
            tries_left=max(0, step.tries - visit.number + 1),
            least=max(0, math.ceil(step.min_seconds - waited.total_seconds())),
            action=visit.request.url(),
            files=f"/steps/{project.id}/",
            final=step.key == project.final.key,
            answered=step.key in visit.progress.answered,
        )
        with rendering(visit, source):
            if visit.request.wants_json:
                return http.as_json(
                    200,
                    {"page": pages.fragment(view), "css": frame.style(), "step": step.key, "ticket": view.ticket},
                )
            page = pages.step_page(view)
        return http.html(200, page.html, page.headers)

    def post(self, project: Project, user_id: str, step: Step, form: PostedForm) -> None:
        """Store the answers, which moves the participant on; of a check as a try, which the next GET judges.

        Answers that come before `minSeconds` are over are not stored, and the page is shown again.
        """
        showing = Showing.read(form.shown)
        if step.min_seconds and (showing is None or self._seconds_at(showing) < step.min_seconds):
            return
        if step.right and showing is not None:
            self._services.answers.store_try(project, user_id, step, showing.number, form.answers)
        elif not step.right:
            self._services.answers.store(project, user_id, step, form.answers)

    def _seconds_at(self, showing: Showing) -> float:
        return self._services.platform.now().timestamp() - showing.since
