"""Shows the end that a participant has reached before the last step: the researcher's page, or our own words."""

from __future__ import annotations

from hippodrome.control import http
from hippodrome.control.http import Request, Response
from hippodrome.control.model.design import Step
from hippodrome.control.model.texts import Texts
from hippodrome.control.participants import frame, pages
from hippodrome.control.participants.page_error import program_message
from hippodrome.control.participants.path import Stop
from hippodrome.control.participants.steps.services import StepServices
from hippodrome.control.participants.steps.sources import rendering, source_of
from hippodrome.control.participants.steps.visit import Visit


class EndPage:
    """Shows ends."""

    def __init__(self, services: StepServices) -> None:
        self._services = services

    def show(self, request: Request, user_id: str, stop: Stop) -> Response:
        """Return the page of the end at which the participant is. Raises `PageError` if its file cannot be shown."""
        assert stop.ended is not None
        texts = Texts(stop.project.texts)
        code, link = stop.ended.code, stop.ended.link
        if stop.end is not None and stop.end.page:
            return self._own_page(request, user_id, stop, Step(stop.end.name, stop.end.page))
        if request.wants_json:
            text = f"{texts['endText']} {texts.say('endCode', code=code) if code else ''}".strip()
            return program_message(200, texts["endTitle"], text)
        page = pages.end_page(stop.project, user_id, stop.ended.end, code, link)
        return http.html(200, page.html, page.headers)

    def _own_page(self, request: Request, user_id: str, stop: Stop, step: Step) -> Response:
        """The researcher's page, which has no form: nothing is asked any more."""
        assert stop.ended is not None
        visit = Visit(request, stop.project, user_id, stop.standing, step)
        source = source_of(self._services, visit, step)
        values = {**source.values, "completion_code": stop.ended.code, "end": stop.ended.end}
        view = pages.StepView(
            project=stop.project,
            step=step,
            user_id=user_id,
            source=source.text,
            values=values,
            ticket="",
            action=request.url(),
            final=True,
            end=stop.ended.end,
            files=f"/steps/{stop.project.id}/",
        )
        with rendering(visit, source):
            if request.wants_json:
                return http.as_json(200, {"page": pages.fragment(view), "css": frame.style(), "step": "", "ticket": ""})
            page = pages.step_page(view)
        return http.html(200, page.html, page.headers)
