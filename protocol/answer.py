"""The answer to a step: `{projectId}/users/{userId}/answers/{step}.json`, created once and never written again.

The control plane writes the answer of a page, and the trial that of a game step. Both read them.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

GAME = "game"
"""The `page` of a game step's answer."""


@dataclass(frozen=True)
class Answer:
    """What one participant answered at one step. The fields are the keys of the document."""

    step: str
    page: str
    group: int | None
    answered: datetime
    answers: Mapping[str, Any]
    schema: int = 1


def to_json(answer: Answer) -> bytes:
    """The document. `answered` must be in UTC: `2026-11-21T14:46:40.123456Z`."""
    document = asdict(answer) | {"answered": answer.answered.strftime("%Y-%m-%dT%H:%M:%S.%fZ")}
    return json.dumps(document).encode()


def answers_in(body: bytes) -> dict[str, Any]:
    """What was answered; empty if the document holds no answers."""
    try:
        answers = json.loads(body)["answers"]
    except (ValueError, RecursionError, TypeError, KeyError):
        return {}
    return answers if isinstance(answers, dict) else {}
