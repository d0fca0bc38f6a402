"""Sessions (`project.players`): who plays in which, and how long a session's server may live and wait. Pure.

The record of a session's server belongs to the session, and not to a participant. The server may be started before the
members are matched.
"""

from __future__ import annotations

from datetime import timedelta

from hippodrome.control.model.project import Project
from hippodrome.control.model.records import Record, from_json
from hippodrome.control.ports import Settings

MAX_OPEN = timedelta(minutes=30)
MIN_OPEN = timedelta(minutes=10)


def open_for(project: Project, settings: Settings) -> timedelta:
    """Return for how long after its request a server that was started ahead may be given to a session.

    The installation's maxRuntime bounds the sum of waiting and play. If the project's maxRuntime leaves less than
    `MIN_OPEN` for waiting, the waiting takes time from the play.
    """
    time_left = timedelta(minutes=settings.max_runtime - project.max_runtime)
    return max(MIN_OPEN, min(MAX_OPEN, time_left))


def lifetime(project: Project, settings: Settings) -> timedelta:
    """Return how long the server of a participant or a session may live.

    It is `lifetime_asked_for`, but never longer than the installation's maxRuntime.
    """
    return min(lifetime_asked_for(project, settings), timedelta(minutes=settings.max_runtime))


def lifetime_asked_for(project: Project, settings: Settings) -> timedelta:
    """Return how long the study needs its servers to live: the project's maxRuntime.

    In a study with sessions, the time for which a server may wait for its members is added.
    """
    waits = open_for(project, settings) if project.has_sessions else timedelta()
    return timedelta(minutes=project.max_runtime) + waits


class Membership(Record, frozen=True, omit_defaults=False):
    """A participant's membership in a session: `{projectId}/users/{userId}/session.json`.

    It is created once, after the lobby has decided, and never changed. So a participant stays a member of that session,
    or unmatched, for good. `session` is the session's id; None for an unmatched participant.

    `seat` counts the human players of the environment from 0. `members` is how many participants the session has;
    `players`, how many it is for, empty places included; both are 0 if the participant is unmatched, who
    sees `completion_code` instead of the code in `participant.json`. `waited`: the seconds that the participant spent
    in the lobby.
    """

    session: str | None = None
    seat: int = 0
    members: int = 0
    unmatched: bool = False
    completion_code: str = ""
    waited: float | None = None
    players: int = 0


def read_membership(body: bytes) -> Membership:
    """Read the membership in a document. Raises ValueError if the document holds none."""
    membership = from_json(body, Membership)
    if (membership.session is None) is not membership.unmatched:
        raise ValueError("the document must either name a session or say that the participant is unmatched")
    return membership
