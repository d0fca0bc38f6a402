"""The handover: `{projectId}/spares/{server name}.json` assigns a warm server to a participant.

    {"userId": "…", "group": 0 or null, "server": "…"}

In a project with sessions (`project.players`) the session's id stands in the place of the participant's.

The control plane creates it once, before the participant's page is told the server's address. A later version may write
another `schema` than 1, which this one refuses.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

from protocol.keys import NAME, SERVER_NAME
from protocol.session import is_session_id

SCHEMA = 1


class BadHandover(ValueError):
    """The document is no handover. The message holds nothing of what stands there."""


@dataclass(frozen=True, slots=True)
class Handover:
    """The participant, their group (None: the study has none), and the server's name from now on.

    `user_id` may be the id of a session, whose members stand in its document (`protocol/session.py`). `server` is the
    name under which the recordings of this attempt lie.
    """

    user_id: str
    group: int | None
    server: str

    def to_json(self) -> bytes:
        """The document."""
        found = {"userId": self.user_id, "group": self.group, "server": self.server}
        return json.dumps(found, indent=1).encode()


def parse(body: bytes) -> Handover:
    """Read the document. Raises BadHandover, never anything else."""
    try:
        found = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise BadHandover("its document is not JSON") from error
    if not isinstance(found, dict) or found.get("schema", SCHEMA) != SCHEMA:
        raise BadHandover("its document is none that this server can read")
    user_id, group, server = found.get("userId"), found.get("group"), found.get("server")
    if not (isinstance(user_id, str) and (NAME.fullmatch(user_id) or is_session_id(user_id))):
        raise BadHandover("its document names no participant")
    if not (isinstance(server, str) and SERVER_NAME.fullmatch(server)):
        raise BadHandover("its document names no server")
    if group is not None and (isinstance(group, bool) or not isinstance(group, int) or group < 0):
        raise BadHandover("its document's group is none")
    return Handover(user_id, group, server)
