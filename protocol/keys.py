"""Keys of the documents that a server reads and writes: answers, recordings and its handover.

docs/architecture.md lists all documents. Keys that servers do not use are elsewhere, such as those below `SSL/`
(`hippodrome/certificates/rules.py`) and `_builds/` (`deploy/study/image/codebuild.py`).
"""

from __future__ import annotations

import re

NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
"""The names that a project, a participant and a step may have."""
SERVER_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}")
"""The names that a server may have."""


def participant_folder(project_id: str, user_id: str) -> str:
    """The folder of all documents of one participant."""
    return f"{project_id}/users/{user_id}/"


def answer_key(project_id: str, user_id: str, step: str) -> str:
    """The key of the answer to one step."""
    return f"{participant_folder(project_id, user_id)}answers/{step}.json"


def recordings_folder(project_id: str, user_id: str) -> str:
    """The folder of a participant's recordings: each server has a folder of its own name in it."""
    return f"{participant_folder(project_id, user_id)}trials/"


def handovers_folder(project_id: str) -> str:
    """The folder of the handovers of a project's warm servers."""
    return f"{project_id}/spares/"


def handover_key(project_id: str, server_name: str) -> str:
    """The key of the handover of the warm server with this name."""
    return f"{handovers_folder(project_id)}{server_name}.json"


def with_number(key: str, number: int) -> str:
    """The key of a recording if `number` - 1 others have it: `…-0001.jsonl.gz`, then `…-0001-2.jsonl.gz` and so on."""
    return key if number == 1 else f"{key.removesuffix('.jsonl.gz')}-{number}.jsonl.gz"
