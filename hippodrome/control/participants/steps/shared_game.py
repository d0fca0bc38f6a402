"""Handles game steps that several participants play together: first the lobby, then the server of their session."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from typing import Any

import msgspec

from hippodrome.control.lobby.lobby import Lobby, LobbyState, NoServerYet
from hippodrome.control.model import participant
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server, ServerState
from hippodrome.control.model.sessions import Membership
from hippodrome.control.participants.pages import LOBBY
from hippodrome.control.participants.services import Services
from hippodrome.control.participants.visit import Visit
from hippodrome.protocol.session import member_token

ENDED = "ended"
UNMATCHED = "unmatched"
"""A state that no server has, like `LOBBY` (docs/pages.md)."""


@dataclass(frozen=True, slots=True)
class Standing:
    """Where a participant stands at a game step: in the lobby, in a session with its server's `record`, or neither."""

    found: LobbyState | NoServerYet | Membership | None
    record: Server | None = None

    @property
    def session(self) -> str | None:
        """The id of the participant's session, which may still change while it waits for a server; None without one."""
        return self.found.session if isinstance(self.found, Membership | NoServerYet) else None

    @property
    def players(self) -> int:
        """How many participants the session is for; 0 without a session."""
        return self.found.players if isinstance(self.found, Membership | NoServerYet) else 0

    @property
    def is_matched(self) -> bool:
        """Whether the participant is a member of a session that has its server for good."""
        return isinstance(self.found, Membership) and self.found.session is not None

    @property
    def is_unmatched(self) -> bool:
        """Whether the participant is unmatched."""
        return isinstance(self.found, Membership) and self.found.unmatched


class SharedGame:
    """Leads participants at a game step of several players to the lobby, and then to their session."""

    def __init__(self, services: Services) -> None:
        self._repository = services.repository
        self._answers = services.answers
        self._states = services.states
        self._lobby = Lobby(services.platform, services.repository)

    def visit(self, visit: Visit, step: Step) -> Standing:
        """Handle a request at this step, and return where the participant stands.

        A participant without a membership waits in the lobby. Before the step at which servers start, and from the step
        at which they stop, there is no lobby: then only a membership is looked up.
        """
        project, user_id = visit.project, visit.user_id
        if not participant.may_have_server(project, step):
            return self.decided(visit) or Standing(None)
        answers = partial(self._earlier_answers, visit, step)
        return self._standing(project, self._lobby.visit(project, user_id, project.group(user_id), answers))

    def decided(self, visit: Visit) -> Standing | None:
        """Return where the participant stands if they are in a session or unmatched; else None. Writes nothing."""
        membership = self._repository.membership(visit.project.id, visit.user_id)
        return self._standing(visit.project, membership) if membership else None

    def state_alone(self, visit: Visit, step: Step | None, *, is_member: bool = False) -> dict[str, Any] | None:
        """Return the state for a page that was made when one player was registered; None if that was never so.

        If the participant has no server of their own, the state is `ended`: the page is loaded again, and is then the
        page of the lobby or of the participant's session. AWS calls: one read.
        """
        before = visit.project.for_session(1)
        if before is None:
            return None
        record = None if is_member else self._repository.server_of(before.id, visit.user_id)
        state = self._states.state(visit.on(before), step, record)
        return state if record else state | {"state": ENDED}

    def leave(self, visit: Visit) -> None:
        """Note that the participant has closed the lobby's page, unless they are matched already."""
        if self._repository.membership(visit.project.id, visit.user_id) is None:
            self._lobby.leave(visit.project, visit.user_id)

    def state(
        self,
        visit: Visit,
        step: Step | None,
        standing: Standing,
        since: datetime | None = None,
        *,
        asked: int | None = None,
    ) -> dict[str, Any]:
        """Return the state of the lobby, or of the session's server, as JSON data for the game page (docs/pages.md).

        A member's page gets the member's own token, never the server's.
        """
        project = visit.project
        state = self._states.state(visit, step, standing.record, since, asked=asked)
        found = standing.found
        if isinstance(found, LobbyState):
            return state | {
                "state": LOBBY,
                "players": project.players,
                "here": found.here,
                "seconds": int(found.seconds),
                "patience": project.patience,
                "then": project.after_patience,
                "proposed": found.proposed,
            }
        if "token" in state:
            state["token"] = member_token(state["token"], visit.user_id)
        if found is None:
            return state
        if standing.is_unmatched:
            state["state"] = UNMATCHED
        return state | {"session": True, "players": standing.players, "members": found.members}

    def _standing(self, project: Project, lobby_state: LobbyState | NoServerYet | Membership) -> Standing:
        if isinstance(lobby_state, NoServerYet):
            return Standing(lobby_state, _not_yet_ready(lobby_state.record))
        session = lobby_state.session if isinstance(lobby_state, Membership) else None
        return Standing(lobby_state, self._repository.server_of(project.id, session) if session else None)

    def _earlier_answers(self, visit: Visit, step: Step) -> Mapping[str, Any]:
        """The participant's answers on the pages before this step. Of a field on two pages, the later answer counts."""
        before = visit.project.steps[: visit.project.index(step.key) or 0]
        answers: dict[str, Any] = {}
        for page in before:
            if not page.type.on_server:
                answers |= self._answers.read(visit, page.key)
        return answers


def _not_yet_ready(record: Server | None) -> Server | None:
    """The record of a server that may still go to another session: not ready, so that no page gets its address."""
    if record is None or record.state is not ServerState.READY:
        return record
    return msgspec.structs.replace(record, state=ServerState.NAMING)
