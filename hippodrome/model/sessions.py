"""The server of a session (`project.players`): how long it may wait for its members. Pure.

A session owns its server's record in the participant's place. Its server may be started ahead, before its members are
matched.
"""

from __future__ import annotations

from datetime import timedelta

from hippodrome.model.project import Project
from hippodrome.ports import Settings

LONGEST_OPEN = timedelta(minutes=30)
SHORTEST_OPEN = timedelta(minutes=10)


def open_for(project: Project, settings: Settings) -> timedelta:
    """How long a server that was started ahead may be given to a session.

    The installation's maxRuntime bounds waiting and play together. Where it leaves less than `SHORTEST_OPEN`, that much
    is taken from the play.
    """
    left = timedelta(minutes=settings.max_runtime - project.max_runtime)
    return max(SHORTEST_OPEN, min(LONGEST_OPEN, left))


def lifetime(project: Project, settings: Settings) -> timedelta:
    """How long a server may live that is started for a participant or a session.

    It is as long as `lifetime_asked_for`, but never longer than the installation's maxRuntime.
    """
    return min(lifetime_asked_for(project, settings), timedelta(minutes=settings.max_runtime))


def lifetime_asked_for(project: Project, settings: Settings) -> timedelta:
    """The project's maxRuntime to play, and before that the time in which a session's server waits for members."""
    waits = open_for(project, settings) if project.has_sessions else timedelta()
    return timedelta(minutes=project.max_runtime) + waits
