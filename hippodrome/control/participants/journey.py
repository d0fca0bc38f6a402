"""`next_step`: shows the step that is due, and stores the answers that participants send.

A POST stores the answers to one step, and decides nothing. A GET finds out what follows (`path.py`) and shows it; at
the steps that the project's `events` name it publishes their messages, each time, since a repeated message changes
nothing. If project and pages are in the cache, a GET makes one listing (and at a game step a read of the server's
record; in a study with factors another read), and a POST one conditional write. With sessions there are more calls
(`lobby/lobby.py`).
"""

from __future__ import annotations

import secrets
from dataclasses import replace

from hippodrome.control import http
from hippodrome.control.http import Request, Response
from hippodrome.control.limits.slots import Slots
from hippodrome.control.log import logger
from hippodrome.control.model import ids, participant
from hippodrome.control.model.design import Step
from hippodrome.control.model.participant import Progress
from hippodrome.control.model.project import Project
from hippodrome.control.model.texts import ENGLISH, IN_ENGLISH
from hippodrome.control.participants import forms, links
from hippodrome.control.participants.files import Files
from hippodrome.control.participants.links import PreviewKind
from hippodrome.control.participants.page_error import PROJECT_NOT_FOUND, REFUSED, PageError
from hippodrome.control.participants.path import Paths, Stop, publish_events
from hippodrome.control.participants.services import Services
from hippodrome.control.participants.steps import HANDLERS
from hippodrome.control.participants.steps.game import GameStep, StepAnswered
from hippodrome.control.participants.steps.page import NeedsAssignment, show_end
from hippodrome.control.participants.visit import Visit
from hippodrome.control.ports import Platform

LEAVE = "leave"
"""The value of `hippodrome-action` in the form that the lobby's page sends when it is closed."""
LINK = "…/next?projectId=your-project&userId=…"
"""The form of a study link, for messages."""


class Journey:
    """Handles the requests of `next_step`. Each running function has one `Journey`, which caches projects and pages."""

    def __init__(self, platform: Platform) -> None:
        self._platform = platform
        self._services = Services(platform)
        self._project_cache = self._services.project_cache
        self._repository = self._services.repository
        self._slots = Slots(platform)
        self._files = Files(self._project_cache)
        self._paths = Paths(self._services)
        self._steps = {name: handler(self._services) for name, handler in HANDLERS.items()}
        self._game = GameStep(self._services)

    def respond(self, request: Request) -> Response:
        """Respond to one HTTP request."""
        if request.method == "OPTIONS":
            return Response(204, "", http.CORS)
        contact = ""
        try:
            if request.method not in ("GET", "HEAD", "POST"):
                raise PageError(405, "This address is only for reading and answering", "Please open your study link.")
            if request.path.startswith("/steps/"):
                return self._files.respond(request)
            request = links.respelled(request)
            visit = Visit(request, self._project(request), "", self._platform.now())
            if visit.project.contact:
                contact = visit.texts.say("contact", contact=visit.project.contact)
            if (kind := links.preview_kind(request)) is not None:
                return _preview_response(visit, kind)
            user_id = _user_id(visit)
            if user_id is None:
                return http.found(request.url(userId=secrets.token_hex(12)))
            return self._respond(replace(visit, user_id=user_id))
        except PageError as error:
            return error.response(request, contact)

    def _respond(self, visit: Visit) -> Response:
        """Call the method for this kind of request."""
        if visit.request.method == "HEAD":
            return Response(200)
        if visit.request.method == "POST":
            return self._post(visit)
        return self._game.poll(visit) if visit.request.has_query("poll") else self._get(visit)

    def _project(self, request: Request) -> Project:
        """The live project that the link names. Raises `PageError` if there is none."""
        if request.query is None:
            raise PageError.of(IN_ENGLISH, 400, "brokenLink")
        if not request.has_query("projectId"):
            text = f"A study link looks like {LINK} - please use the whole link that you were given."
            status = 404 if request.query else 200
            raise PageError(status, "This is where studies run", text, PROJECT_NOT_FOUND)
        text = "The link may be misspelled, or the study may be over."
        not_found = PageError(404, "Study not found", text, PROJECT_NOT_FOUND)
        project_id = request.query_value("projectId")
        if project_id is None or not ids.is_project_id(project_id):
            raise not_found
        project = self._project_cache.live_project(project_id)
        if project is None and self._project_cache.is_unreadable(project_id):
            raise PageError(
                500,
                "This study is temporarily unavailable",
                "Please try again later, or contact the researchers who invited you.",
            )
        if project is None:
            raise not_found
        return project

    # Reading

    def _get(self, visit: Visit) -> Response:
        progress = self._repository.progress(visit.project.id, visit.user_id)
        if not progress.has_arrived:
            progress = self._arrive(visit, progress)
        stop = self._paths.next(visit, progress)
        try:
            return self._show(stop)
        except NeedsAssignment:
            return self._show(self._paths.assigned(visit, stop.standing))
        except StepAnswered:  # by this very request, since the participant was not matched with others
            progress = self._repository.progress(visit.project.id, visit.user_id)
            return self._show(self._paths.next(visit, progress))

    def _show(self, stop: Stop) -> Response:
        """Return the page of a step, after the messages of that step; or the page of an end."""
        if stop.ended is not None:
            return show_end(self._services, stop)
        publish_events(self._platform, stop.visit, stop.step)
        return self._steps[stop.step.type.name].show(stop)

    def _arrive(self, visit: Visit, progress: Progress) -> Progress:
        """Handle a first visit, and return the progress after it."""
        project, request = visit.project, visit.request
        if not self._slots.admit(project, visit.user_id):
            logger.warning("the study is full", extra={"project": project.id})
            raise PageError.of(visit.texts, 200, "studyFull")
        link = {k: v[:256] for k, v in request.query or () if k not in links.OUR_FIELDS and len(k) <= 64}
        record = participant.new_participant(project, visit.user_id, link, visit.now, request.headers)
        if self._repository.create_participant(record):
            logger.info("arrived", extra={"project": project.id})
        return replace(progress, has_arrived=True, arrived=record.arrived)

    # Answering

    def _post(self, visit: Visit) -> Response:
        request = visit.request
        try:
            form = forms.read(request)
        except forms.BadForm as bad:
            if request.wants_json:
                text = f"{bad.text} Please answer the page again."
                raise PageError(bad.status, ENGLISH["notSaved"], text) from None
            raise PageError.of(visit.texts, bad.status, "notSaved", why=bad.reason(visit.texts)) from None
        if form.action == LEAVE and visit.project.has_sessions:
            self._game.leave(visit, form)
            return Response(204)  # a redirect would count as another visit
        step = self._step_of(form, visit)
        if step is not None:
            self._steps[step.type.name].post(visit, step, form)
        return self._get(visit) if request.wants_json else http.see_other(request.url())

    def _step_of(self, form: forms.PostedForm, visit: Visit) -> Step | None:
        """The step that this form answers; None if it answers none: it changes nothing, and the due page follows.

        A valid ticket proves that the participant was shown the step, so their folder need not be listed. If the step
        has an answer already, that stays (`Answers.store`). Without a valid ticket a form answers the step that is due,
        unless

        * the participant has not arrived yet, or has reached an end,
        * it names another step, such as an earlier one,
        * the step is a check or has `minSeconds`,
        * it names no step, and repeats answers of the last minute: it is the same form sent again (`Answers.repeats`).

        A form that cannot be read does not come here: its page says `notSaved` (`_post`).
        """
        shown = visit.project.step_of_ticket(visit.user_id, form.step, form.ticket, form.shown or "")
        if shown is not None:
            return shown
        progress, own = self._repository.path_of(visit.project, visit.user_id)
        current = progress.due_step(own)
        if not progress.has_arrived or progress.has_ended or form.step not in (None, current.key):
            return None
        if current.is_limited:
            return None  # only a form with a ticket says which try it is, and when its page was shown
        may_repeat = form.step is None and not current.type.on_server
        repeated = may_repeat and self._services.answers.repeats(visit, progress, form.answers)
        return None if repeated else current


def _user_id(visit: Visit) -> str | None:
    """The participant's id in the link: `userId` or a recruiter's field; None if a browser's GET has none.

    Raises `PageError` if the id is not valid, if a POST or a program has none, or if the study's links are signed and
    this one is not.
    """
    request, project, texts = visit.request, visit.project, visit.texts
    field = next((name for name in links.IDS if request.has_query(name)), None)
    if field is None and request.method == "POST":
        raise PageError.of(texts, 400, "whoAreYou")
    user_id = request.query_value(field) if field else None
    if field and not ids.is_user_id(user_id):
        text = f"{texts.say('brokenId', field=field)} {texts['brokenLinkText']}"
        raise PageError(400, texts["brokenLink"], text, lang=texts.language)
    if project.signed_links:
        signature = request.query_value("signature")
        if user_id is None or signature is None:
            raise PageError.of(texts, 403, "byInvitation", REFUSED)
        if not ids.secrets_equal(signature, ids.link_signature(project.secret, project.id, user_id)):
            raise PageError.of(texts, 403, "brokenLink", REFUSED)
    if user_id is None and request.wants_json:
        # A program would follow a redirect, but not learn the new id from the page.
        raise PageError(400, "This link is incomplete", "Your userId is missing from the link.", PROJECT_NOT_FOUND)
    return user_id


def _preview_response(visit: Visit, kind: PreviewKind) -> Response:
    """The response to a preview: nothing of the study, and no id."""
    if kind is PreviewKind.PREFETCH:  # browsers drop it, as it is not 2xx, and ask again when the link is opened
        return Response(403, "", {"Cache-Control": "no-store"})
    texts = visit.texts
    text = texts["preview" if kind is PreviewKind.HIT else "openInBrowser"]
    return PageError(200, visit.project.name or texts["aStudy"], text, lang=texts.language).response(visit.request)
