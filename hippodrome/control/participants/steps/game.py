"""Handles steps that are played on a server: the page for waiting and playing, and requests for another server."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from typing import Any

from hippodrome.control import http
from hippodrome.control.http import Request, Response
from hippodrome.control.model import ids, participant, server
from hippodrome.control.model.design import Step
from hippodrome.control.model.messages import StartServer, StopServer, to_message
from hippodrome.control.model.server import (
    Server,
    ServerState,
    attempt_after_pause,
    may_go_without,
    next_attempt,
    requestable_attempt,
)
from hippodrome.control.participants import frame, pages
from hippodrome.control.participants.forms import PostedForm
from hippodrome.control.participants.page_error import PageError
from hippodrome.control.participants.path import Stop
from hippodrome.control.participants.services import Services
from hippodrome.control.participants.steps.page import NeedsAssignment, rendering, source_of
from hippodrome.control.participants.steps.shared_game import ENDED, SharedGame
from hippodrome.control.participants.visit import Visit
from hippodrome.control.ports import Topic

ASK_AGAIN = timedelta(seconds=30)  # if there is no server after this time, the next GET sends the start message again
STUCK = timedelta(minutes=3)  # if a server is still starting after this time, the next GET requests it again
UNASSIGNED = "unassigned"
"""In the query of a lobby's polls: the page does not know the participant's path yet, and is loaded again then."""
ATTEMPT = "attempt"
"""In the query of polls: the attempt that was requested when the page was loaded, if it is not the first."""
RESTART, WITHOUT = "restart", "without"
"""The values of `hippodrome-action` in the forms by which a participant asks for another server, and goes on without
the game."""


class StepAnswered(Exception):
    """This request has answered the step, so the next step is due."""


class GameStep:
    """Implements `StepHandler`. The trial stores the answer.

    A form requests another server, or goes on without the game if no server could run it.
    """

    def __init__(self, services: Services) -> None:
        self._services = services
        self._platform = services.platform
        self._repository = services.repository
        self._shared = SharedGame(services)

    # The page

    def show(self, stop: Stop) -> Response:
        """Return the page on which the participant waits and plays. Sends a lost start message again.

        Raises `StepAnswered` if the participant was not matched with others, and `NeedsAssignment` if they were
        matched, and the levels and orders of their session are to be drawn.
        """
        registered, step = stop.visit.project, stop.step
        before = self._repository.project_of_own_server(registered, stop.visit.user_id)
        stop = replace(stop, visit=stop.visit.on(before or registered))  # as the participant's own server runs it
        visit, request, project = stop.visit, stop.visit.request, stop.visit.project
        ticket = ids.ticket(project.secret, visit.user_id, step.key)
        if project.has_sessions:
            is_unassigned = project.assigns and stop.standing.assignment is None
            state, proof = self._state_together(stop), {"ticket": ticket}
            if is_unassigned:
                proof |= {UNASSIGNED: "1"}
                state |= {UNASSIGNED: True}
        else:
            state, proof = self._state_alone(stop), {}
        played = project.for_session(state.get("players", 0)) or project
        view = pages.GameView(
            project=played,
            step=step,
            user_id=visit.user_id,
            state=state,
            poll=request.url(
                poll=step.key, **proof, **({ATTEMPT: str(state["attempt"])} if state["attempt"] > 1 else {})
            ),
            page=request.url(),
            ticket=ticket,
            sources=self._platform.settings.game_sources or state.get("url", "").rstrip("/"),
        )
        if request.wants_json:
            return http.as_json(200, {"page": _page_for_program(view, request.method), "css": frame.style(), **state})
        shown = played.pages_in_game
        if played is not registered:  # pages of an earlier registration may be gone
            shown = [page for page in shown if self._exists(visit, page)]
        sources = {page.key: source_of(self._services, stop, page) for page in shown}
        view = replace(view, reading={key: (source.text, source.values) for key, source in sources.items()})
        with rendering(visit, *sources.values()):
            page = pages.game_page(view)
        return http.html(200, page.html, page.headers)

    def _exists(self, visit: Visit, page: Step) -> bool:
        file = visit.project.file(visit.user_id, page)
        return self._services.project_cache.page(visit.project, file) is not None

    def _state_alone(self, stop: Stop) -> dict[str, Any]:
        """The state of the participant's own server.

        Sends a lost start message again. Stops a server that was started for a study without this game step.
        """
        visit, step = stop.visit, stop.step
        record = self._repository.server_of(visit.project.id, visit.user_id)
        self._request_if_overdue(stop, visit.user_id, record)
        if record is not None and not record.is_closed and record.lacks(step.key):
            message = StopServer(visit.project.id, visit.user_id, record.attempt)  # then another may be requested
            self._platform.bus.publish(Topic.STOP, to_message(message))
        since = stop.progress.reached_at(visit.project, step)
        attempt = attempt_after_pause(record, since) if record else None
        return self._services.states.state(visit, step, record, since, asked=attempt)

    def _state_together(self, stop: Stop) -> dict[str, Any]:
        """The state of the lobby, or of the session's server. Raises `StepAnswered` if the participant is unmatched."""
        visit, step = stop.visit, stop.step
        standing = self._shared.visit(visit, step)
        if standing.is_unmatched:
            raise StepAnswered
        if standing.is_matched and stop.standing.assignment is None and visit.project.assigns:
            raise NeedsAssignment
        if standing.session is not None:
            self._request_if_overdue(stop, standing.session, standing.record, standing.players)
        since = stop.progress.reached_at(visit.project, step)
        attempt = attempt_after_pause(standing.record, since) if standing.record else None
        return self._shared.state(visit, step, standing, since, asked=attempt)

    def _request_if_overdue(self, stop: Stop, owner: str, record: Server | None, players: int = 0) -> None:
        """Send a lost start message again. `owner`: the id of the participant, or of a session of `players` members."""
        attempt = _overdue_attempt(stop, record)
        if attempt is not None:
            self._request_server(stop.visit, owner, attempt, players)

    def _request_server(self, visit: Visit, owner: str, attempt: int, players: int = 0) -> None:
        start = StartServer(visit.project.id, owner, attempt, players)
        self._platform.bus.publish(Topic.START, to_message(start))

    # Its forms

    def post(self, visit: Visit, step: Step, form: PostedForm) -> None:
        """Request another server, or store the answer of a game that no server could run, as the form asks.

        Nothing happens if the server's record does not allow it, perhaps because another page has asked before.
        """
        if form.action not in (RESTART, WITHOUT):
            return
        project, user_id = visit.project, visit.user_id
        owner = self._repository.session_id(project, user_id) if project.has_sessions else user_id
        record = self._repository.server_of(project.id, owner) if owner else None
        if owner is None or record is None:
            return
        if form.action == WITHOUT:
            if may_go_without(record):
                self._services.answers.store(visit, step, participant.failed_game(project, user_id))
        elif (attempt := requestable_attempt(record)) is not None:
            progress, own = self._repository.path_of(project, user_id)
            if not progress.has_ended and participant.may_have_server(own, progress.due_step(own)):
                self._request_server(visit, owner, attempt)  # the ticket of a game that is over stays valid

    def leave(self, visit: Visit, form: PostedForm) -> None:
        """Handle the form that the lobby's page sends when it is closed."""
        if visit.project.step_of_ticket(visit.user_id, form.step, form.ticket):
            self._shared.leave(visit)

    # Its polls

    def poll(self, visit: Visit) -> Response:
        """Return the state of the server as JSON. One read of its record; with sessions, see `SharedGame`."""
        request, project = visit.request, visit.project
        if request.has_query("ticket"):  # only the page of a game for several participants sends one
            fresh = self._services.project_cache.live_project(project.id, fits=lambda listed: listed.has_sessions)
            visit = visit.on(fresh or project)
        step = visit.project.step(request.query_value("poll"))
        if visit.project.has_sessions:
            return http.as_json(200, self._poll_together(visit, step))
        record = self._repository.server_of(project.id, visit.user_id)
        return http.as_json(200, self._services.states.state(visit, step, record, asked=_asked(request)))

    def _poll_together(self, visit: Visit, step: Step | None) -> dict[str, Any]:
        """The state of the lobby, or of the session's server. Without a membership, the query must have a ticket."""
        request, project = visit.request, visit.project
        shown = visit.project.step_of_ticket(visit.user_id, step.key if step else None, request.query_value("ticket"))
        if shown is not None and shown.type.on_server:
            unassigned, assignment = request.has_query(UNASSIGNED), None
            if project.assigns and not unassigned:  # a page of an earlier registration may not know that it is
                assignment = self._repository.assignment(project.id, visit.user_id)
                unassigned = assignment is None
            standing = self._shared.visit(visit.on(project.own(assignment)), shown)
            if unassigned and standing.is_matched:
                return self._shared.state(visit, step, standing) | {"state": ENDED}  # the page is loaded again
        else:
            decided = self._shared.decided(visit)
            if decided is None or not request.has_query("ticket"):  # the page of a game for one participant sends none
                alone = self._shared.state_alone(visit, step, is_member=decided is not None)
                if alone is not None:
                    return alone
            if decided is None:
                raise PageError.of(visit.texts, 403, "outdated")
            standing = decided
        return self._shared.state(visit, step, standing, asked=_asked(request))


def _asked(request: Request) -> int | None:
    """The attempt that was requested when the page that polls was loaded; None if it was the first."""
    text = request.query_value(ATTEMPT) or ""
    return int(text) if text.isdecimal() and len(text) < 4 else None


def _overdue_attempt(stop: Stop, record: Server | None) -> int | None:
    """The attempt to request, because it is overdue; None if none is.

    Its message was lost, or came while the study was closed, or the project was full and may have a slot now. Or the
    server had ended before the participant came to this game.
    """
    project, step, now = stop.visit.project, stop.step, stop.visit.now
    if not participant.may_have_server(project, step):
        return None
    since = stop.progress.reached_at(project, step)
    if record is None:  # at the first step, where `since` is None, each load sends the message
        return 1 if since is not None and now - since > ASK_AGAIN else None
    after_pause = attempt_after_pause(record, since)
    if after_pause is not None:
        return after_pause
    if record.closed is not None and now - record.closed > ASK_AGAIN:
        return record.attempt if server.found_no_slot(record, record.attempt) else next_attempt(record)
    stuck = record.state is ServerState.STARTING and now - record.requested > STUCK
    return record.attempt if stuck else None


def _page_for_program(view: pages.GameView, method: str) -> str:
    """HIPPO's word for the state; a page instead of `wait` if HIPPO's front end would wait without end.

    That front end polls only after a form whose response says `wait`. After a game it sends a single GET.
    """
    if view.state["state"] == ServerState.READY:
        return "show_game_page"
    moved = view.state["replaces"] and not pages.is_over(view.state)
    if (method == "GET" and moved) or (pages.is_over(view.state) and not (method == "POST" and view.state["again"])):
        return pages.game_message(view)
    return "wait"
