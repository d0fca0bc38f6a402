"""The answer to a step: `{projectId}/users/{userId}/answers/{step}.json`, created once and never written again.

The control plane writes the answer of a page, and the trial that of a game step. Both read them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from datetime import datetime
from typing import Any

from protocol.times import time_text

GAME = "game"
"""The `page` of a game step's answer."""
UNMATCHED = "unmatched"
"""The `outcome` of a game step whose participant found no others to play with."""


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
    """The document. `answered` must be in UTC."""
    document = asdict(answer) | {"answered": time_text(answer.answered)}
    return json.dumps(document).encode()


def answers_in(body: bytes) -> dict[str, Any] | None:
    """What was answered; None if the document holds no answers.

    The code of an agent decides what a trial's document holds. So what is no JSON in UTF-8 (RFC 8259) is refused: NaN,
    numbers that are too large for a float, and half of a surrogate pair, which no page could show.
    """
    try:
        answers = json.loads(body.decode(), parse_float=_finite, parse_constant=_finite)["answers"]
        json.dumps(answers, ensure_ascii=False).encode()
    except (ValueError, RecursionError, TypeError, KeyError):
        return None
    return answers if isinstance(answers, dict) else None


def _finite(written: str) -> float:
    if not math.isfinite(number := float(written)):
        raise ValueError("no number that JSON knows")
    return number
