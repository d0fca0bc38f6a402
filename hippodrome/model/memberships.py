"""What a participant of a project with several `players` is: a member of a session, or unmatched. Pure.

`{projectId}/users/{userId}/session.json` is created once, after the lobby has decided, and never changed. So it makes a
participant a member, or unmatched, for good.
"""

from __future__ import annotations

from hippodrome.model.records import Record, from_json


class Membership(Record, frozen=True, omit_defaults=False):
    """The document. `session` is None for a participant who was not matched.

    `seat` counts the human players of the environment from 0; `members` is how many participants the session has, and
    `players` is how many it is for, with the places that nobody has; 0 in documents of earlier versions. An
    unmatched participant is shown `completion_code`, which is another one than that of `participant.json`. `waited`:
    the seconds that the participant spent in the lobby.
    """

    session: str | None = None
    seat: int = 0
    members: int = 0
    unmatched: bool = False
    completion_code: str = ""
    waited: float | None = None
    players: int = 0


def read(body: bytes) -> Membership:
    """The membership in a document. Raises ValueError or RecursionError if it holds none."""
    found = from_json(body, Membership)
    if (found.session is None) is not found.unmatched:
        raise ValueError("the document says neither which session nor that there is none")
    return found
