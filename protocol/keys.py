"""Keys of the documents that a server reads and writes. docs/architecture.md lists them all."""

from __future__ import annotations

import re

NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
"""What a project, a participant and a step may be called."""
SERVER_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}")
"""What a server may be called."""


def participant_folder(project_id: str, user_id: str) -> str:
    """All documents of one participant lie here."""
    return f"{project_id}/users/{user_id}/"


def answer_key(project_id: str, user_id: str, step: str) -> str:
    """The answer to one step."""
    return f"{participant_folder(project_id, user_id)}answers/{step}.json"


def recordings_folder(project_id: str, user_id: str) -> str:
    """Each server's recordings lie in a folder here, named like the server."""
    return f"{participant_folder(project_id, user_id)}trials/"


def handovers_folder(project_id: str) -> str:
    """The handovers of a project's warm servers lie here."""
    return f"{project_id}/spares/"


def handover_key(project_id: str, server_name: str) -> str:
    """The handover of the warm server with this name."""
    return f"{handovers_folder(project_id)}{server_name}.json"
