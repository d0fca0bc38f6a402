"""The handover: `{projectId}/handovers/{server name}.json` assigns a warm server to a participant.

    {"userId": "…", "group": 0 or null, "server": "…"}

In a project with sessions (`project.players`), `userId` is the id of a session.

The control plane creates the document once, before the participant's page gets the server's address. A document without
`schema` has schema 1. This version refuses any other.
"""

from __future__ import annotations

import json
from dataclasses import dataclass

from hippodrome.protocol.keys import NAME, SERVER_NAME
from hippodrome.protocol.session import is_group, is_session_id

SCHEMA = 1


class BadHandover(ValueError):
    """The document is not a valid handover. The message quotes nothing from the document."""


@dataclass(frozen=True, slots=True)
class Handover:
    """The participant of a warm server, their group (None: the study has no groups), and the server's new name.

    `user_id` may be the id of a session, whose document has the members (`hippodrome/protocol/session.py`). The
    recordings of this attempt lie under the name `server`.
    """

    user_id: str
    group: int | None
    server: str

    def to_json(self) -> bytes:
        """Return the bytes of the document, JSON."""
        document = {"userId": self.user_id, "group": self.group, "server": self.server}
        return json.dumps(document, indent=1).encode()


def parse(body: bytes) -> Handover:
    """Read the bytes of a handover document. Raises BadHandover and no other exception."""
    try:
        parsed = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise BadHandover("its document is not JSON") from error
    if not isinstance(parsed, dict) or parsed.get("schema", SCHEMA) != SCHEMA:
        raise BadHandover("its document has a schema that this server cannot read")
    user_id, group, server = parsed.get("userId"), parsed.get("group"), parsed.get("server")
    if not (isinstance(user_id, str) and (NAME.fullmatch(user_id) or is_session_id(user_id))):
        raise BadHandover("its document names no participant")
    if not (isinstance(server, str) and SERVER_NAME.fullmatch(server)):
        raise BadHandover("its document names no server")
    if not is_group(group):
        raise BadHandover("its document has a group that is no number")
    return Handover(user_id, group, server)
