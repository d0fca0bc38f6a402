"""Handles steps that are played on a server: the page for waiting and playing, and requests for another server."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from datetime import timedelta
from typing import Any

from hippodrome.control import http
from hippodrome.control.http import Response
from hippodrome.control.model import ids, participant, server
from hippodrome.control.model.design import Step
from hippodrome.control.model.messages import StartServer, StopServer, to_message
from hippodrome.control.model.project import Project
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
from hippodrome.control.participants.steps.services import StepServices
from hippodrome.control.participants.steps.shared_game import SharedGame, StepAnswered
from hippodrome.control.participants.steps.sources import NeedsAssignment, rendering, source_of
from hippodrome.control.participants.steps.visit import Visit
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


class GameStep:
    """Implements `StepHandler`. The trial stores the answer.

    A form requests another server, or goes on without the game if no server could run it.
    """

    def __init__(self, services: StepServices) -> None:
        self._services = services
        self._shared = SharedGame(services)

    def show(self, visit: Visit) -> Response:
        """Return the page on which the participant waits and plays. Sends a lost start message again.

        Raises `StepAnswered` if the participant was not matched with others, and `NeedsAssignment` if they were
        matched, and the levels and orders of their session are to be drawn.
        """
        registered, visit = visit.project, self._as_it_plays(visit)
        request, project, step = visit.request, visit.project, visit.step
        ticket = ids.ticket(project.secret, visit.user_id, step.key)
        if project.has_sessions:
            is_unassigned = project.assigns and visit.standing.assignment is None
            state, proof = self._state_together(visit), {"ticket": ticket}
            if is_unassigned:
                proof |= {UNASSIGNED: "1"}
                state |= {UNASSIGNED: True}
        else:
            state, proof = self._state_alone(visit), {}
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
            sources=self._services.platform.settings.game_sources or state.get("url", "").rstrip("/"),
        )
        if request.wants_json:
            return http.as_json(200, {"page": _page_for_program(view, request.method), "css": frame.style(), **state})
        shown = project.pages_in_game if played is registered else self._still_there(visit, played.pages_in_game)
        sources = {page.key: source_of(self._services, visit, page) for page in shown}
        view = replace(
            view,
            texts={key: (source.text, source.values) for key, source in sources.items()},
            files=f"/steps/{project.id}/",
        )
        with rendering(visit, *sources.values()):
            page = pages.game_page(view)
        return http.html(200, page.html, page.headers)

    def _as_it_plays(self, visit: Visit) -> Visit:
        """The visit, with the registration that the participant's own server runs, if they still have such a server."""
        before = self._services.repository.project_of_own_server(visit.project, visit.user_id)
        return replace(visit, project=before) if before else visit

    def _still_there(self, visit: Visit, steps: Iterable[Step]) -> list[Step]:
        """The pages of an earlier registration that still exist."""
        project, cache = visit.project, self._services.project_cache
        return [page for page in steps if cache.page(project, project.file(visit.user_id, page)) is not None]

    def post(self, project: Project, user_id: str, step: Step, form: PostedForm) -> None:
        """Request another server, or store the answer of a game that no server could run, as the form asks.

        Nothing happens if the server's record does not allow it, perhaps because another page has asked before.
        """
        if form.action not in (RESTART, WITHOUT):
            return
        repository = self._services.repository
        owner = repository.session_id(project, user_id) if project.has_sessions else user_id
        record = repository.server_of(project.id, owner) if owner else None
        if owner is None or record is None:
            return
        if form.action == WITHOUT:
            if may_go_without(record):
                self._services.answers.store(project, user_id, step, participant.failed_game(project, user_id))
        elif (attempt := requestable_attempt(record)) is not None:
            progress = repository.progress(project.id, user_id)
            own = repository.own_project(project, user_id, progress)
            if not progress.has_ended and participant.may_have_server(own, progress.due_step(own)):
                self._request_server(project, owner, attempt)  # the ticket of a game that is over stays valid

    def _state_alone(self, visit: Visit) -> dict[str, Any]:
        """The state of the participant's own server.

        Sends a lost start message again. Stops a server that was started for a study without this game step.
        """
        record = self._services.repository.server_of(visit.project.id, visit.user_id)
        self._request_if_overdue(visit, visit.user_id, record)
        if record is not None and not record.is_closed and record.lacks(visit.step.key):
            stop = StopServer(visit.project.id, visit.user_id, record.attempt)  # after that, another may be requested
            self._services.platform.bus.publish(Topic.STOP, to_message(stop))
        since = visit.progress.reached_at(visit.project, visit.step)
        attempt = attempt_after_pause(record, since) if record else None
        return self._services.state(visit.project, visit.user_id, visit.step, record, since, asked=attempt)

    def _state_together(self, visit: Visit) -> dict[str, Any]:
        """The state of the lobby, or of the session's server. Raises `StepAnswered` if the participant is unmatched."""
        project, user_id, step = visit.project, visit.user_id, visit.step
        standing = self._shared.visit(project, user_id, step)
        if standing.is_unmatched:
            raise StepAnswered
        if standing.is_matched and visit.standing.assignment is None and project.assigns:
            raise NeedsAssignment
        if standing.session is not None:
            self._request_if_overdue(visit, standing.session, standing.record, standing.players)
        since = visit.progress.reached_at(project, step)
        attempt = attempt_after_pause(standing.record, since) if standing.record else None
        return self._shared.state(project, user_id, step, standing, since, asked=attempt)

    def _request_if_overdue(self, visit: Visit, owner: str, record: Server | None, players: int = 0) -> None:
        """Send a lost start message again. `owner`: the id of the participant, or of a session of `players` members."""
        attempt = self._overdue_attempt(visit, record)
        if attempt is not None:
            self._request_server(visit.project, owner, attempt, players)

    def _overdue_attempt(self, visit: Visit, record: Server | None) -> int | None:
        """The attempt to request, because it is overdue; None if none is.

        Its message was lost, or came while the study was closed, or the project was full and may have a slot now. Or
        the server had ended before the participant came to this game.
        """
        project, step, now = visit.project, visit.step, self._services.platform.now()
        if not participant.may_have_server(project, step):
            return None
        if record is None:
            since = visit.progress.reached_at(project, step)  # None: at the first step, each load sends the message
            return 1 if since is not None and now - since > ASK_AGAIN else None
        after_pause = attempt_after_pause(record, visit.progress.reached_at(project, step))
        if after_pause is not None:
            return after_pause
        full = server.found_no_slot(record, record.attempt)
        if record.closed is not None and now - record.closed > ASK_AGAIN:
            return record.attempt if full else next_attempt(record)
        stuck = record.state is ServerState.STARTING and now - record.requested > STUCK
        return record.attempt if stuck else None

    def _request_server(self, project: Project, owner: str, attempt: int, players: int = 0) -> None:
        start = StartServer(project.id, owner, attempt, players)
        self._services.platform.bus.publish(Topic.START, to_message(start))


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
