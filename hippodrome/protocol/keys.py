"""Keys of the documents that trial servers read and write: answers, recordings, handovers, sessions and questions.

docs/architecture.md lists all documents. Other modules have the keys that servers do not use, such as those below
`SSL/` (`hippodrome/control/certificates/rules.py`).
"""

from __future__ import annotations

import re

NAME = re.compile(r"[A-Za-z0-9_-]{1,64}")
"""The form of the ids of projects, participants and steps."""
QUESTIONS = "_match/"
"""The folder of the questions to the functions `match` of all projects."""
QUESTION_ID = re.compile(r"[0-9a-f]{20}")
"""The form of the id of a question to the function `match`."""
SERVER_NAME = re.compile(r"[A-Za-z0-9_-][A-Za-z0-9._-]{0,127}")
"""The form of the names of servers."""


def participant_folder(project_id: str, user_id: str) -> str:
    """Return the folder of all documents of one participant."""
    return f"{project_id}/users/{user_id}/"


def answer_key(project_id: str, user_id: str, step: str) -> str:
    """Return the key of the answer to one step."""
    return f"{participant_folder(project_id, user_id)}answers/{step}.json"


def recordings_folder(project_id: str, user_id: str) -> str:
    """Return the folder of a participant's recordings: each server has a folder of its own name in it."""
    return f"{participant_folder(project_id, user_id)}trials/"


def membership_key(project_id: str, user_id: str) -> str:
    """Return the key of the document that says in which session a participant plays (`project.players`)."""
    return f"{participant_folder(project_id, user_id)}session.json"


def sessions_folder(project_id: str) -> str:
    """Return the folder of a project's sessions."""
    return f"{project_id}/sessions/"


def session_folder(project_id: str, session_id: str) -> str:
    """Return the folder of the documents of one session."""
    return f"{sessions_folder(project_id)}{session_id}/"


def session_key(project_id: str, session_id: str) -> str:
    """Return the key of a session's document (`hippodrome/protocol/session.py`)."""
    return f"{session_folder(project_id, session_id)}session.json"


def session_recordings_folder(project_id: str, session_id: str) -> str:
    """Return the folder of a session's recordings: each server has a folder of its own name in it."""
    return f"{session_folder(project_id, session_id)}trials/"


def questions_folder(project_id: str) -> str:
    """Return the folder of a project's questions to its function `match`. S3 keeps their older versions for a day."""
    return f"{QUESTIONS}{project_id}/"


def waiting_key(project_id: str) -> str:
    """Return the key of the document with the participants who wait: the question to the function `match`."""
    return f"{questions_folder(project_id)}waiting.json"


def groups_folder(project_id: str) -> str:
    """Return the folder of the answers of the function `match`."""
    return f"{project_id}/lobby/groups/"


def groups_key(project_id: str, question: str) -> str:
    """Return the key of the answer to the question with this id: the groups that the function `match` has chosen."""
    return f"{groups_folder(project_id)}{question}.json"


def handovers_folder(project_id: str) -> str:
    """Return the folder of the handovers of a project's warm servers."""
    return f"{project_id}/handovers/"


def handover_key(project_id: str, server_name: str) -> str:
    """Return the key of the handover of the warm server with this name."""
    return f"{handovers_folder(project_id)}{server_name}.json"


def tape_key(folder: str, step: str, number: int) -> str:
    """Return the key of a piece of the tape of a game step, in the folder of a server's recordings; the first is 1."""
    return f"{folder}/{step}-talk-{number:04d}.json"


def with_number(key: str, number: int) -> str:
    """Return the key with a number before its suffix, for a recording whose own key is taken.

    `…-0001.jsonl.gz` becomes `…-0001-2.jsonl.gz` for 2; for 1 it stays.
    """
    return key if number == 1 else f"{key.removesuffix('.jsonl.gz')}-{number}.jsonl.gz"
