"""How long servers live, and how long the server of a session (`project.players`) may wait for its members. Pure.

The record of a session's server belongs to the session, and not to a participant. The server may be started before the
members are matched.
"""

from __future__ import annotations

from datetime import timedelta

from hippodrome.control.model.project import Project
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
