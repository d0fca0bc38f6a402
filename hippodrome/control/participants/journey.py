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
from typing import Any

from hippodrome.control import http
from hippodrome.control.http import Request, Response
from hippodrome.control.limits.slots import Slots
from hippodrome.control.log import logger
from hippodrome.control.model import ids, participant
from hippodrome.control.model.design import Step
from hippodrome.control.model.participant import Progress
from hippodrome.control.model.project import Project
from hippodrome.control.model.texts import ENGLISH, IN_ENGLISH, Texts
from hippodrome.control.participants import forms, previews
from hippodrome.control.participants.answers import Answers
from hippodrome.control.participants.events import publish_events
from hippodrome.control.participants.files import Files
from hippodrome.control.participants.link_fields import IDS, OUR_FIELDS, respelled
from hippodrome.control.participants.page_error import PROJECT_NOT_FOUND, REFUSED, PageError
from hippodrome.control.participants.path import Paths, Stop
from hippodrome.control.participants.previews import PreviewKind
from hippodrome.control.participants.steps import HANDLERS
from hippodrome.control.participants.steps.end import EndPage
from hippodrome.control.participants.steps.game import ATTEMPT, UNASSIGNED
from hippodrome.control.participants.steps.services import StepServices
from hippodrome.control.participants.steps.shared_game import ENDED, SharedGame, StepAnswered
from hippodrome.control.participants.steps.sources import NeedsAssignment
from hippodrome.control.participants.steps.visit import Visit
from hippodrome.control.participants.waiting import ServerStates
from hippodrome.control.ports import Platform
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache

LEAVE = "leave"
"""The value of `hippodrome-action` in the form that the lobby's page sends when it is closed."""
LINK = "…/next?projectId=your-project&userId=…"
"""The form of a study link, for messages."""


class Journey:
    """Handles the requests of `next_step`. Each running function has one `Journey`, which caches projects and pages."""

    def __init__(self, platform: Platform) -> None:
        self._platform = platform
        self._secrets = SecretCache(platform.documents)
        self._project_cache = ProjectCache(platform, self._secrets)
        self._repository = Repository(platform.documents)
        self._slots = Slots(platform)
        self._files = Files(self._project_cache)
        self._answers = Answers(platform)
        waiting = ServerStates(platform.settings, self._secrets)
        self._services = StepServices(platform, self._project_cache, self._repository, self._answers, waiting)
        self._shared_game = SharedGame(self._services)
        self._paths = Paths(platform, self._repository, self._answers)
        self._ends = EndPage(self._services)
        self._steps = {name: handler(self._services) for name, handler in HANDLERS.items()}

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
            request = respelled(request)
            project = self._project(request)
            if project.contact:
                contact = Texts(project.texts).say("contact", contact=project.contact)
            if (kind := previews.preview_kind(request)) is not None:
                return _preview_response(request, project, kind)
            return self._dispatch(request, project)
        except PageError as error:
            return error.response(request, contact)

    def _dispatch(self, request: Request, project: Project) -> Response:
        """Identify the participant, and call the method for this kind of request."""
        texts = Texts(project.texts)
        user_id = _user_id(request, texts)
        if project.signed_links:
            user_id = _verify_invitation(request, project, user_id, texts)
        if user_id is None:
            if request.wants_json:  # a program would follow a redirect, but not learn the new id from the page
                raise PageError(
                    400, "This link is incomplete", "Your userId is missing from the link.", PROJECT_NOT_FOUND
                )
            return http.found(request.url(userId=secrets.token_hex(12)))
        if request.method == "HEAD":
            return Response(200)
        if request.method == "POST":
            return self._post(request, project, user_id)
        if request.has_query("poll"):
            return self._poll(request, project, user_id)
        return self._get(request, project, user_id)

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

    def _get(self, request: Request, project: Project, user_id: str) -> Response:
        progress = self._repository.progress(project.id, user_id)
        if not progress.has_arrived:
            progress = self._arrive(request, project, user_id, progress)
        stop = self._paths.next(project, user_id, progress)
        try:
            return self._show(request, user_id, stop)
        except NeedsAssignment:
            return self._show(request, user_id, self._paths.assigned(project, user_id, stop.standing))
        except StepAnswered:  # by this very request, since the participant was not matched with others
            progress = self._repository.progress(project.id, user_id)
            return self._show(request, user_id, self._paths.next(project, user_id, progress))

    def _show(self, request: Request, user_id: str, stop: Stop) -> Response:
        """Return the page of a step, after the messages of that step; or the page of an end."""
        if stop.ended is not None:
            return self._ends.show(request, user_id, stop)
        publish_events(self._platform, stop.project, user_id, stop.step)
        return self._steps[stop.step.type.name].show(Visit.at(request, user_id, stop))

    def _arrive(self, request: Request, project: Project, user_id: str, progress: Progress) -> Progress:
        """Handle a first visit, and return the progress after it."""
        if not self._slots.admit(project, user_id):
            logger.warning("the study is full", extra={"project": project.id})
            raise PageError.of(Texts(project.texts), 200, "studyFull")
        link = {k: v[:256] for k, v in request.query or () if k not in OUR_FIELDS and len(k) <= 64}
        record = participant.new_participant(project, user_id, link, self._platform.now(), request.headers)
        if self._repository.create_participant(record):
            logger.info("arrived", extra={"project": project.id})
        return replace(progress, has_arrived=True, arrived=record.arrived)

    # Answering

    def _post(self, request: Request, project: Project, user_id: str) -> Response:
        try:
            form = forms.read(request)
        except forms.BadForm as bad:
            if request.wants_json:
                text = f"{bad.text} Please answer the page again."
                raise PageError(bad.status, ENGLISH["notSaved"], text) from None
            texts = Texts(project.texts)
            raise PageError.of(texts, bad.status, "notSaved", why=bad.reason(texts)) from None
        if form.action == LEAVE and project.has_sessions:
            return self._leave(project, user_id, form)
        step = self._step_of(form, project, user_id)
        if step is not None:
            self._steps[step.type.name].post(project, user_id, step, form)
        return self._get(request, project, user_id) if request.wants_json else http.see_other(request.url())

    def _step_of(self, form: forms.PostedForm, project: Project, user_id: str) -> Step | None:
        """The step that this form may answer; None if that step is not due.

        A valid ticket proves that the participant was shown the step, so their folder need not be listed. A form
        without one may only answer the step that is due. If it names no step and repeats answers of the last minute, it
        is the same form sent again (`Answers.repeats`), and answers none.
        """
        shown = project.step_of_ticket(user_id, form.step, form.ticket, form.shown or "")
        if shown is not None:
            return shown
        progress = self._repository.progress(project.id, user_id)
        current = progress.due_step(self._repository.own_project(project, user_id, progress))
        if not progress.has_arrived or progress.has_ended or form.step not in (None, current.key):
            return None
        if current.is_limited:
            return None  # only a form with a ticket says which try it is, and when its page was shown
        may_repeat = form.step is None and not current.type.on_server
        repeated = may_repeat and self._answers.repeats(project, user_id, progress, form.answers)
        return None if repeated else current

    def _leave(self, project: Project, user_id: str, form: forms.PostedForm) -> Response:
        """Handle the form that the lobby's page sends when it is closed. A redirect would count as another visit."""
        if project.step_of_ticket(user_id, form.step, form.ticket):
            self._shared_game.leave(project, user_id)
        return Response(204)

    def _poll(self, request: Request, project: Project, user_id: str) -> Response:
        """Return the state of the server as JSON. One read of its record; with sessions, see `SharedGame`."""
        if request.has_query("ticket"):  # only the page of a game for several participants sends one
            project = self._project_cache.live_project(project.id, fits=lambda listed: listed.has_sessions) or project
        step = project.step(request.query_value("poll"))
        if project.has_sessions:
            return http.as_json(200, self._poll_together(request, project, user_id, step))
        record = self._repository.server_of(project.id, user_id)
        return http.as_json(200, self._services.state(project, user_id, step, record, asked=_asked(request)))

    def _poll_together(self, request: Request, project: Project, user_id: str, step: Step | None) -> dict[str, Any]:
        """The state of the lobby, or of the session's server. Without a membership, the query must have a ticket."""
        shown = project.step_of_ticket(user_id, step.key if step else None, request.query_value("ticket"))
        if shown is not None and shown.type.on_server:
            unassigned, assignment = request.has_query(UNASSIGNED), None
            if project.assigns and not unassigned:  # a page of an earlier registration may not know that it is
                assignment = self._repository.assignment(project.id, user_id)
                unassigned = assignment is None
            standing = self._shared_game.visit(project.own(assignment), user_id, shown)
            if unassigned and standing.is_matched:
                return self._shared_game.state(project, user_id, step, standing) | {"state": ENDED}  # load it again
        else:
            standing_found = self._shared_game.decided(project, user_id)
            if standing_found is None or not request.has_query(
                "ticket"
            ):  # the page of a game for one participant sends none
                alone = self._shared_game.state_alone(project, user_id, step, is_member=standing_found is not None)
                if alone is not None:
                    return alone
            if standing_found is None:
                raise PageError.of(Texts(project.texts), 403, "outdated")
            standing = standing_found
        return self._shared_game.state(project, user_id, step, standing, asked=_asked(request))


def _asked(request: Request) -> int | None:
    """The attempt that was requested when the page that polls was loaded; None if it was the first."""
    text = request.query_value(ATTEMPT) or ""
    return int(text) if text.isdecimal() and len(text) < 4 else None


def _user_id(request: Request, texts: Texts) -> str | None:
    """The participant's id in the link: `userId` or a recruiter's field; None if a GET has none.

    Raises `PageError` if the id is not valid, or if a POST has none.
    """
    field = next((name for name in IDS if request.has_query(name)), None)
    if field is None:
        if request.method == "POST":
            raise PageError.of(texts, 400, "whoAreYou")
        return None
    user_id = request.query_value(field)
    if user_id is None or not ids.is_user_id(user_id):
        text = f"{texts.say('brokenId', field=field)} {texts['brokenLinkText']}"
        raise PageError(400, texts["brokenLink"], text, lang=texts.language)
    return user_id


def _verify_invitation(request: Request, project: Project, user_id: str | None, texts: Texts) -> str:
    """Return the participant's id if the link's signature is valid. Raises `PageError`."""
    signature = request.query_value("signature")
    if user_id is None or signature is None:
        raise PageError.of(texts, 403, "byInvitation", REFUSED)
    if not ids.secrets_equal(signature, ids.link_signature(project.secret, project.id, user_id)):
        raise PageError.of(texts, 403, "brokenLink", REFUSED)
    return user_id


def _preview_response(request: Request, project: Project, kind: PreviewKind) -> Response:
    """The response to a preview: nothing of the study, and no id."""
    if kind is PreviewKind.PREFETCH:  # browsers drop it, as it is not 2xx, and ask again when the link is opened
        return Response(403, "", {"Cache-Control": "no-store"})
    texts = Texts(project.texts)
    text = texts["preview" if kind is PreviewKind.HIT else "openInBrowser"]
    return PageError(200, project.name or texts["aStudy"], text, lang=texts.language).response(request)
