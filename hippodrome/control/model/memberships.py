"""A participant's membership in a project with several `players`: they play in a session, or are unmatched. Pure.

`{projectId}/users/{userId}/session.json` is created once, after the lobby has decided, and never changed. So a
participant stays a member of that session, or unmatched, for good.
"""

from __future__ import annotations

from hippodrome.control.model.records import Record, from_json


class Membership(Record, frozen=True, omit_defaults=False):
    """The document of a membership. `session` is the session's id; None for an unmatched participant.

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


def read(body: bytes) -> Membership:
    """Read the membership in a document. Raises ValueError if the document holds none."""
    membership = from_json(body, Membership)
    if (membership.session is None) is not membership.unmatched:
        raise ValueError("the document must either name a session or say that the participant is unmatched")
    return membership
