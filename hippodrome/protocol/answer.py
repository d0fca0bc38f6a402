"""The answer to a step: `{projectId}/users/{userId}/answers/{step}.json`, created once and never written again.

The control plane writes the answers to pages, and the trial server writes the answers to game steps. If the lobby finds
no other participants, or no server could run the game, the control plane writes the answers to game steps, too. Both
sides read answers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

from hippodrome.protocol.times import time_text

GAME = "game"
"""`page` in the answer to a game step."""
FAILED = "failed"
"""`outcome` in the answer to a game step whose agent kept failing, or for which no server could be started."""
UNMATCHED = "unmatched"
"""`outcome` in the answer to a game step for which the lobby found no other participants."""


@dataclass(frozen=True)
class Answer:
    """One participant's answer to one step. The fields are the keys of the document."""

    step: str
    page: str
    group: int | None
    answered: datetime
    answers: Mapping[str, Any]
    schema: int = 1


def to_json(answer: Answer) -> bytes:
    """Return the bytes of the document, JSON. `answered` must be in UTC."""
    document = asdict(answer) | {"answered": time_text(answer.answered)}
    return json.dumps(document).encode()


def answers_in(body: bytes) -> dict[str, Any] | None:
    """Return `answers` of the document; None if the document is not valid or has no `answers`.

    A study's agent decides what the answer to a game step holds. So the document must be JSON in UTF-8 (RFC 8259):
    without NaN, numbers that are too large for a float, and unpaired surrogates, which no page could show.
    """
    try:
        answers = json.loads(body.decode(), parse_float=_finite, parse_constant=_finite)["answers"]
        json.dumps(answers, ensure_ascii=False).encode()
    except (ValueError, RecursionError, TypeError, KeyError):
        return None
    return answers if isinstance(answers, dict) else None


def _finite(text: str) -> float:
    if not math.isfinite(number := float(text)):
        raise ValueError("not a finite number")
    return number
