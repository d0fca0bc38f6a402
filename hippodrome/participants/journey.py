"""`next_step`: the page of the step where a participant stands, and the answers they send.

A GET moves nobody; a POST answers one step. What it costs in AWS calls, with project and pages in the cache: a GET one
listing (and on the game step the server's record), a POST one conditional write (and a message at an event step).
"""

from __future__ import annotations

import secrets
from collections.abc import Mapping
from datetime import datetime, timedelta
from typing import Any

from hippodrome import http
from hippodrome.http import Request, Response
from hippodrome.limits.slots import Slots
from hippodrome.log import logger
from hippodrome.model import ids, participant, server
from hippodrome.model.messages import StartServer, StopServer, to_message
from hippodrome.model.participant import Progress
from hippodrome.model.project import Project, Step
from hippodrome.model.server import Server, State
from hippodrome.participants import forms, pages, previews
from hippodrome.participants.waiting import Waiting
from hippodrome.ports import Platform, Topic
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.repository import Repository
from hippodrome.storage.secret import Secrets

RECRUITER_IDS = ("PROLIFIC_PID", "workerId", "survey_code")
OURS = {"projectId", "userId", "poll", "signature"}
LONGEST_NAME = 200  # characters of a file's name, at most 800 bytes: S3 refuses keys beyond 1,024 with an error
ASK_AGAIN = timedelta(seconds=30)  # a start message unheard for this long is sent once more by a reload
STUCK = timedelta(minutes=3)  # and one whose server should have begun to run by now
FULL = (
    "All places are taken, and nothing has been kept of your visit. Thank you for your interest! "
    "Now and then a place becomes free: you are welcome to come back later with the same link."
)
LINK = "…/next?projectId=your-project&userId=…"


class PageError(Exception):
    """Instead of a step, the participant gets a page with these words."""

    def __init__(self, status: int, title: str, text: str) -> None:
        super().__init__(title)
        self.status, self.title, self.text = status, title, text

    def response(self, request: Request) -> Response:
        """The page, or JSON for a program."""
        if request.wants_json:
            return http.as_json(self.status, {"message": f"{self.title}. {self.text}"})
        page = pages.message_page(self.title, self.text)
        return http.html(self.status, page.html, page.headers)


class Journey:
    """The primary controller. One per running function; it keeps a cache of projects and pages, nothing else."""

    def __init__(self, platform: Platform) -> None:
        self._platform = platform
        self._secrets = Secrets(platform.documents)
        self._project_cache = ProjectCache(platform, self._secrets)
        self._repository = Repository(platform.documents)
        self._slots = Slots(platform)
        self._waiting = Waiting(platform.settings, self._secrets)

    def respond(self, request: Request) -> Response:
        """Answer one HTTP request."""
        if request.method == "OPTIONS":
            return Response(204, "", http.CORS)
        try:
            if request.method not in ("GET", "HEAD", "POST"):
                raise PageError(405, "This address is only for reading and answering", "Please open your study link.")
            if request.path.startswith("/steps/"):
                return self._file(request)
            project = self._project(request)
            if (why := previews.why(request)) is not None:
                return _preview(request, project, why)
            return self._answer(request, project)
        except PageError as sorry:
            return sorry.response(request)

    def _answer(self, request: Request, project: Project) -> Response:
        """Answer somebody who comes to a study."""
        user_id = _user(request)
        if project.signed_links:
            user_id = _invited(request, project, user_id)
        if user_id is None:
            return http.found(request.url(userId=secrets.token_hex(12)))
        if request.method == "HEAD":
            return Response(200)
        if request.method == "POST":
            return self._post(request, project, user_id)
        if request.has("poll"):
            return self._poll(project, user_id, request.one("poll"))
        return self._get(request, project, user_id)

    def _project(self, request: Request) -> Project:
        """The live project that the link names."""
        if request.query is None:
            raise PageError(400, "This link is broken", "Please copy the whole link again from your invitation.")
        if not request.has("projectId"):
            text = f"A study link looks like {LINK} - please use the whole link that you were given."
            raise PageError(404 if request.query else 200, "This is where studies are held", text)
        project_id = request.one("projectId")
        project = self._project_cache.live_project(project_id) if project_id and ids.is_project_id(project_id) else None
        if project is None and project_id and self._project_cache.cannot_read(project_id):
            raise PageError(500, "This study is out of order", "Please tell whoever invited you, and come back later.")
        if project is None:
            raise PageError(404, "There is no such study", "The link may be misspelled, or the study may be over.")
        return project

    # Reading

    def _get(self, request: Request, project: Project, user_id: str) -> Response:
        progress = self._repository.progress(project.id, user_id)
        step = progress.position(project)
        if not progress.known:
            self._arrive(request, project, user_id, step)
        elif participant.reached_without_post(project, step):
            self._announce(project, user_id, step)
        return self._show(request, project, user_id, progress, step)

    def _arrive(self, request: Request, project: Project, user_id: str, step: Step) -> None:
        """First visit. The message goes out before the record: a crash in between repeats it, and never loses it."""
        if not self._slots.admit(project, user_id):
            logger.warning("the study is full", extra={"project": project.id})
            raise PageError(200, "This study is full", FULL)
        self._announce(project, user_id, step)
        link = {k: v[:256] for k, v in request.query or () if k not in OURS and len(k) <= 64}
        record = participant.arrive(project, user_id, link, self._platform.now())
        if self._repository.arrive(record):
            logger.info("arrived", extra={"project": project.id})

    def _announce(self, project: Project, user_id: str, step: Step) -> None:
        """Publish what reaching `step` means for the participant's server."""
        if participant.starts_server(project, step):
            self._platform.bus.publish(Topic.START, to_message(StartServer(project.id, user_id)))
        if participant.stops_server(project, step):
            self._platform.bus.publish(Topic.STOP, to_message(StopServer(project.id, user_id)))

    def _show(self, request: Request, project: Project, user_id: str, progress: Progress, step: Step) -> Response:
        if step.is_game:
            return self._game(request, project, user_id, progress, step)
        file = project.file(user_id, step)
        source = self._project_cache.page(project, file)
        if source is None:
            logger.error("step page missing", extra={"project": project.id, "file": file})
            raise PageError(500, "This page is missing", "It was not uploaded. Please tell whoever invited you.")
        view = pages.StepView(
            project=project,
            step=step,
            user_id=user_id,
            source=source,
            values=self._values(project, user_id, progress, step, pages.needs(source)),
            ticket=ids.ticket(project.secret, user_id, step.key),
            action=request.url(),
            final=step.key == project.final.key,
            answered=step.key in progress.answered,
        )
        try:
            if request.wants_json:
                return http.as_json(
                    200,
                    {"page": pages.fragment(view), "css": pages.style(), "step": step.key, "ticket": view.ticket},
                )
            page = pages.step_page(view)
        except pages.FragmentError as error:
            logger.error("step page broken", extra={"project": project.id, "file": file, "line": error.line})
            raise PageError(
                500, "This page is broken", "It could not be shown. Please tell whoever invited you."
            ) from None
        return http.html(200, page.html, page.headers)

    def _values(
        self, project: Project, user_id: str, progress: Progress, step: Step, needs: frozenset[str]
    ) -> Mapping[str, Any]:
        """What a step page may mention; records are read only for the pages that do."""
        values: dict[str, Any] = {
            "project": {"id": project.id, "name": project.name, "researcher": project.researcher},
            "participant": {"userId": user_id},
            "group": project.group(user_id, step),
            "completion_code": ids.completion_code(project.secret, user_id),
        }
        if "participant" in needs:
            known = self._repository.participant(project.id, user_id)
            values["participant"] = {**(known.link if known else {}), "userId": user_id}
        named = [key for key in progress.answered if "answers" in needs or f"answers.{key}" in needs]
        values["answers"] = {key: self._repository.answers(project.id, user_id, key) for key in named}
        return values

    def _file(self, request: Request) -> Response:
        """`/steps/{projectId}/{file}`: a picture or the like that lies beside the step pages."""
        parts = request.path.split("/")
        project = (
            self._project_cache.live_project(parts[2]) if len(parts) == 4 and ids.is_project_id(parts[2]) else None
        )
        name = parts[-1]
        kind = _KINDS.get(name.rsplit(".", 1)[-1].lower())
        plain = name.isprintable() and not name.startswith(".") and len(name) <= LONGEST_NAME
        if project is None or kind is None or not plain:
            raise PageError(404, "There is nothing here", "Please open your study link again.")
        found = self._project_cache.document(f"{project.id}/steps/{name}")
        if found is None:
            raise PageError(404, "There is nothing here", "Please open your study link again.")
        return Response(200, found.body, {"Content-Type": kind, **_FILE_HEADERS})

    # Answering

    def _post(self, request: Request, project: Project, user_id: str) -> Response:
        try:
            form = forms.read(request)
        except forms.BadForm as bad:
            raise PageError(
                bad.status, "Your answers were not saved", f"{bad.text} Nothing is lost: go back."
            ) from None
        step = self._step_of(form, project, user_id)
        if step is not None:
            if form.action == "restart" and step.is_game:
                self._restart(project, user_id)
            elif not step.is_game:
                self._store(project, user_id, step, form)
        return self._get(request, project, user_id) if request.wants_json else http.see_other(request.url())

    def _step_of(self, form: forms.Form, project: Project, user_id: str) -> Step | None:
        """The step that this form may answer; None if it is not (or no longer, or not yet) its turn.

        A ticket proves that we showed the participant this very step, so that no look at their folder is needed. A
        program without tickets answers the step where the participant stands. If it does not name that step either,
        answers that it sent a moment ago are the same form sent again, see `_repeats`.
        """
        shown = project.shown(user_id, form.step, form.ticket)
        if shown is not None:
            return shown
        progress = self._repository.progress(project.id, user_id)
        current = progress.position(project)
        if not progress.known or form.step not in (None, current.key):
            return None
        repeated = form.step is None and not current.is_game and self._repeats(project, user_id, progress, form)
        return None if repeated else current

    def _repeats(self, project: Project, user_id: str, progress: Progress, form: forms.Form) -> bool:
        """Whether a form that names no step holds what was answered at an earlier step within the last minute.

        Exact for requests that come at once: `progress` holds every answer before the step that is due, and none of
        them ever changes. A read for each answer of that minute.
        """
        recent = progress.recent(project, self._platform.now())
        earlier = (self._repository.answers(project.id, user_id, key) for key in recent)
        return any(participant.same_answers(form.answers, answers) for answers in earlier)

    def _store(self, project: Project, user_id: str, step: Step, form: forms.Form) -> None:
        """Keep the answers, which moves the participant on. Messages go first: a crash may repeat, never lose them."""
        following = participant.after(project, step)
        if following:
            self._announce(project, user_id, following)
        record = participant.answer(project, user_id, step, form.answers, self._platform.now())
        if self._repository.answer(project.id, user_id, record):
            logger.info("answered", extra={"project": project.id, "step": step.key})

    # The game

    def _game(self, request: Request, project: Project, user_id: str, progress: Progress, step: Step) -> Response:
        record = self._repository.server_of(project.id, user_id)
        if record is None:
            attempt = 1 if self._overdue(project, progress, step) else None
        else:
            attempt = self._unheard(project, step, record)
        if attempt is not None:
            self._platform.bus.publish(Topic.START, to_message(StartServer(project.id, user_id, attempt)))
        state = self._state(project, user_id, record, step, progress.since(project, step))
        if request.wants_json:
            word = "show_game_page" if state["state"] == State.READY else "wait"
            return http.as_json(200, {"page": word, "css": pages.style(), **state})
        page = pages.game_page(
            pages.GameView(
                project=project,
                step=step,
                user_id=user_id,
                state=state,
                poll=request.url(poll=step.key),
                page=request.url(),
                action=request.url(),
                ticket=ids.ticket(project.secret, user_id, step.key),
                sources=self._platform.settings.game_sources,
            )
        )
        return http.html(200, page.html, page.headers)

    def _poll(self, project: Project, user_id: str, step: str | None) -> Response:
        """How far the server is: one read of its record."""
        record = self._repository.server_of(project.id, user_id)
        return http.as_json(200, self._state(project, user_id, record, project.step(step)))

    def _overdue(self, project: Project, progress: Progress, step: Step) -> bool:
        """Whether the start message must have been lost."""
        since = progress.since(project, step)
        return participant.wants_server(project, step) and (
            progress.known if since is None else self._platform.now() - since > ASK_AGAIN
        )

    def _unheard(self, project: Project, step: Step, record: Server) -> int | None:
        """The attempt to ask for once more, for it has been waited for too long; None if there is none.

        Its message was lost, or came while the study was closed; or the project was full and there may be room by now.
        """
        if not participant.wants_server(project, step):
            return None
        now, full = self._platform.now(), server.was_full(record, record.attempt)
        if record.closed is not None and now - record.closed > ASK_AGAIN:
            return record.attempt if full else server.next_attempt(record)
        stuck = record.state is State.STARTING and now - record.requested > STUCK
        return record.attempt if stuck else None

    def _restart(self, project: Project, user_id: str) -> None:
        record = self._repository.server_of(project.id, user_id)
        attempt = server.wished_attempt(record) if record else None
        if attempt is not None:
            self._platform.bus.publish(Topic.START, to_message(StartServer(project.id, user_id, attempt)))

    def _state(
        self, project: Project, user_id: str, record: Server | None, step: Step | None, since: datetime | None = None
    ) -> dict[str, Any]:
        names, now = self._platform.dns, self._platform.now()
        return self._waiting.state(project, user_id, step, record, names=names, now=now, since=since)


def _user(request: Request) -> str | None:
    """Who the link says is there: `userId`, or a recruiter's id; None if the link names nobody."""
    given = next((name for name in ("userId", *RECRUITER_IDS) if request.has(name)), None)
    if given is None:
        if request.method == "POST":
            raise PageError(400, "Who are you?", "The link lacks its userId. Please open your study link again.")
        return None
    user_id = request.one(given)
    if user_id is None or not ids.is_user_id(user_id):
        text = f"Its {given} should be 1 to 64 letters, digits, dashes or underscores."
        raise PageError(400, "This link is broken", f"{text} Please copy the whole link again from your invitation.")
    return user_id


def _invited(request: Request, project: Project, user_id: str | None) -> str:
    """Who the link was made for, in a study whose links are signed."""
    signature = request.one("signature")
    if user_id is None or signature is None:
        text = "It needs the link of your own invitation. Please copy the whole link again from there."
        raise PageError(403, "This study is by invitation", text)
    if not ids.same(signature, ids.link_signature(project.secret, project.id, user_id)):
        raise PageError(403, "This link is broken", "Please copy the whole link again from your invitation.")
    return user_id


def _preview(request: Request, project: Project, why: previews.Why) -> Response:
    """What those get who are no participants yet: nothing that could be taken for the study, and no id."""
    if why is previews.Why.AHEAD:  # any status but 2xx makes browsers ask again when somebody really comes
        return Response(403, "", {"Cache-Control": "no-store"})
    if why is previews.Why.HIT:
        text = "This is a preview. Once you have accepted the task, the study opens here."
    else:
        text = "Open the link in a browser to take part."
    return PageError(200, project.name or "A study", text).response(request)


_FILE_HEADERS = {
    "Cache-Control": "public, max-age=300",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; sandbox",  # an SVG is no page of ours
}
_KINDS = {
    "png": "image/png", "jpg": "image/jpeg", "jpeg": "image/jpeg", "gif": "image/gif", "webp": "image/webp",
    "svg": "image/svg+xml", "mp4": "video/mp4", "webm": "video/webm", "mp3": "audio/mpeg", "ogg": "audio/ogg",
    "wav": "audio/wav", "css": "text/css", "js": "text/javascript", "vtt": "text/vtt", "woff2": "font/woff2",
}  # fmt: skip
