"""Removes the words of one member from a session's tape, for the erasure of that participant.

Their lines stay, without text, so that the others' talk can be followed. A request to a language model holds the words
of all: it goes, and its hash, its tokens and the model's name stay. What the agent and the others have said stays.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from hippodrome.export.scrub import Scrub

ERASED = {"text": "", "erased": True}


def without_member(piece: bytes, seat: int, user: str) -> bytes:
    """Return a piece of a tape without the words of the member at this seat, whose id is `user`.

    If the piece cannot be read, return one without records.
    """
    try:
        found = json.loads(piece)
        records, seats = list(found["records"]), [str(player) for player in found["seats"]]
        player = seats[seat]
    except (ValueError, KeyError, TypeError, IndexError):
        return b'{"schema":1,"records":[]}'
    hide = Scrub({user: ""}).sparing(seats)
    found["records"] = [hide.record(_without(record, player)) for record in records]
    return piece if found == json.loads(piece) else json.dumps(found, separators=(",", ":")).encode()


def _without(record: Any, player: str) -> Mapping[str, Any]:
    if not isinstance(record, Mapping):
        return {}
    if record.get("kind") == "line" and record.get("by") == player:
        return {name: value for name, value in record.items() if name not in ("original", "typed")} | ERASED
    if record.get("kind") == "call" and "request" in record:
        return {name: value for name, value in record.items() if name != "request"} | {"erased": True}
    return record
