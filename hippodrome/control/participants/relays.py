"""The relays: HTTP requests that publish a start or stop message for the participant's server, a stop also later.

The participant must have arrived, a server must be due (or there to be stopped), and the request must prove who sends
it: by a ticket of one of the participant's pages, or by the token of their running server. A POST has the fields in its
body. A GET, as HIPPO's scripts send it, has them in its query.

A member of a session has a token of their own for its server, and cannot stop it for the others: their stop message
says that they have left (`hippodrome/control/servers/sessions.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from datetime import timedelta
from typing import Any

from hippodrome.control import http
from hippodrome.control.http import Refusal, Request, Response
from hippodrome.control.model import ids, participant
from hippodrome.control.model.messages import StartServer, StopServer, to_message
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server, requestable_attempt
from hippodrome.control.participants import forms, links
from hippodrome.control.participants.forms import PostedForm
from hippodrome.control.participants.visit import Visit
from hippodrome.control.ports import Platform, Topic
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache
from hippodrome.protocol.session import member_token

MAX_DELAY = 24 * 60 * 60  # seconds
NO_PROOF = (
    "Nothing was started or stopped: only the participant may do this, and the request proves nothing. Send the fields "
    f"{forms.STEP} and {forms.TICKET} of one of the participant's pages along (`step` and `ticket` beside `page` in "
    "the answer of /next), or the server's token. A step of the study starts and stops servers without any request: "
    "see startServerStep and stopServerStep in its config.yml."
)


class Relays:
    """Implements `send_start_server_message` and `send_stop_server_message`. Each running function has one `Relays`."""

    def __init__(self, platform: Platform) -> None:
        self._platform = platform
        self._secrets = SecretCache(platform.documents)
        self._project_cache = ProjectCache(platform, self._secrets)
        self._repository = Repository(platform.documents)

    def start(self, request: Request) -> Response:
        """Publish the start message of the participant's server; a refused request gets a status and a sentence."""
        return self._respond(request, self._start)

    def stop(self, request: Request) -> Response:
        """Publish the stop message of the participant's server, or set a timer that does so after `delay`.

        The request's field `delay` is in seconds, 0 to `MAX_DELAY`. A refused request gets a status and a sentence.
        """
        return self._respond(request, self._stop)

    def _respond(self, request: Request, act: Callable[[Visit, PostedForm], None]) -> Response:
        if request.method == "OPTIONS":
            return Response(204, "", http.CORS)
        try:
            form = _form(request)
            project, user_id = self._participant_of(request, form)
            act(Visit(request, project, user_id, self._platform.now()), form)
        except Refusal as refusal:
            return _answer(refusal.status, refusal.text)
        return _answer(200 if request.method == "GET" else 202, "Accepted.")

    def _participant_of(self, request: Request, form: PostedForm) -> tuple[Project, str]:
        project_id = request.query_value("projectId") or form.answers.get("projectId")
        user_id = request.query_value("userId") or form.answers.get("userId")
        if project_id is None and not request.has_query("projectId") and ids.is_user_id(user_id):
            return self._project_of_ticket(str(user_id), form), str(user_id)
        project = self._project_cache.live_project(str(project_id)) if ids.is_project_id(project_id) else None
        if project is None:
            raise Refusal(404, "Study not found.")
        if not ids.is_user_id(user_id):
            raise Refusal(400, "userId should be 1 to 64 letters, digits, dashes or underscores.")
        return project, str(user_id)

    def _project_of_ticket(self, user_id: str, form: PostedForm) -> Project:
        """The project whose ticket this is, for HIPPO's stop request, which names no project. Raises `Refusal`."""
        for candidate in self._project_cache.projects():
            project = (
                self._secrets.with_secret(candidate)
                if candidate.live and candidate.step(form.step) and form.ticket
                else None
            )
            if project and project.step_of_ticket(user_id, form.step, form.ticket):
                return project
        raise Refusal(403, f"{NO_PROOF} A token needs the projectId as well.")

    def _start(self, visit: Visit, form: PostedForm) -> None:
        project, user_id = visit.project, visit.user_id
        owner, record = self._server_of(visit, form)
        progress, own = self._repository.path_of(project, user_id)
        is_due = progress.has_arrived and not progress.has_ended
        if not is_due or not participant.may_have_server(own, progress.due_step(own)):
            raise Refusal(409, "No server is due at this step.")
        if record is None:
            attempt = 1
        elif not record.is_closed:
            attempt = record.attempt  # the server is open, so the start message changes nothing
        elif (requestable := requestable_attempt(record)) is not None:
            attempt = requestable
        else:
            raise Refusal(409, "No further server can be started.")
        self._platform.bus.publish(Topic.START, to_message(StartServer(project.id, owner, attempt)))

    def _stop(self, visit: Visit, form: PostedForm) -> None:
        delay = _delay(form.answers)
        project, user_id = visit.project, visit.user_id
        _, record = self._server_of(visit, form)
        if not project.has_sessions and (record is None or record.is_closed):
            raise Refusal(409, "There is no server to stop.")
        if record is None or record.is_closed or record.is_of_session:
            # The participant leaves the lobby or the session.
            message, name = StopServer(project.id, user_id), ids.server_name(ids.server_label(project.id, user_id), 1)
        else:
            message, name = StopServer(project.id, user_id, record.attempt), record.name
        if delay:
            at = visit.now + timedelta(seconds=delay)
            self._platform.timers.set(ids.delayed_timer(name), at, to_message(message))
        else:
            self._platform.bus.publish(Topic.STOP, to_message(message))

    def _server_of(self, visit: Visit, form: PostedForm) -> tuple[str, Server | None]:
        """The id of who has the server, the participant or their session; and its record.

        Raises `Refusal` unless the form has the token of this server or a ticket of this participant.
        """
        owner = self._repository.session_id(visit.project, visit.user_id) or visit.user_id
        record = self._repository.server_of(visit.project.id, owner)
        token = form.answers.get("token")
        expected = self._secrets.token(record) if record and isinstance(token, str) else ""
        if expected and record and record.is_of_session:
            expected = member_token(expected, visit.user_id)
        has_token = bool(expected) and ids.secrets_equal(str(token), expected)
        if not has_token and not visit.project.step_of_ticket(visit.user_id, form.step, form.ticket):
            raise Refusal(403, NO_PROOF)
        return owner, record


def _form(request: Request) -> PostedForm:
    """The fields in the body of a POST, or in the query of a GET. Raises `Refusal`."""
    if request.method == "POST":
        return forms.read(request) if request.body else PostedForm({})
    if request.method != "GET":
        raise Refusal(405, "Use POST, or GET with a query.")
    if links.preview_kind(request) is not None:
        raise Refusal(403, "Nothing was started or stopped: this is the preview of a link, not a participant.")
    if request.query is None:
        raise Refusal(400, "The query cannot be read.")
    return forms.read_query(request.query)


def _answer(status: int, text: str) -> Response:
    """JSON with the text as `message`, and as `page`, which programs of HIPPO's users expect in every response."""
    return http.as_json(status, {"message": text, "page": text, "css": None})


def _delay(answers: Mapping[str, Any]) -> int:
    """The field `delay`, in seconds; 0 without it. Raises `Refusal`."""
    delay_given = answers.get("delay", 0)
    try:
        delay = int(delay_given) if not isinstance(delay_given, bool) else -1
    except (TypeError, ValueError, OverflowError):
        delay = -1
    if not 0 <= delay <= MAX_DELAY:
        raise Refusal(400, f"delay is a whole number of seconds, 0 to {MAX_DELAY}.")
    return delay
