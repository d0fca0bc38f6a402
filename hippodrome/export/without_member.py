"""Removes the data of one member from a session's recordings and tapes, for the erasure of that participant.

From a recording it removes the member's messages (with feedback and key presses), the times of key presses, the
actions of their keys, their round trips, the lines on their presence, the lines of callbacks on them, their outcome,
and their id where it is a word of a text (`scrub.py`). The actions, rewards and scores of their player stay: without
them the game of the others cannot be read or repeated. Lines without data of the member stay byte for byte.

The member's lines of a tape stay, without text, so that the others' talk can be followed. A request to a language model
holds the words of all: it goes, and its hash, its tokens and the model's name stay.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

from hippodrome.export import recording
from hippodrome.export.scrub import SHORTEST, Scrub

ABOUT_ONE = frozenset({"on_feedback", "on_form", "on_join", "on_leave", "on_return"})
"""Callbacks on one participant. A line of theirs without `player` may be about any member."""
OF_EACH = ("roundTrip", "outcomes")
"""Fields of lines that map each player to a value."""
OF_KEYS = ("human", "pressedAt")
"""Fields with the action of the participant's keys, and the time at which they were pressed."""


def rewrite(source: Path, target: Path, seat: int, user: str) -> bool:
    """Write `source` into `target` without the data of the member at this seat, whose id is `user`.

    `source` is a recording, or if its name ends in `.json` a piece of a tape. Returns whether the two differ. A
    recording that was cut off stays cut off; lines that cannot be read are left out. Raises OSError.
    """
    if source.suffix == ".json":
        piece = source.read_bytes()
        target.write_bytes(_of_tape(piece, seat, user))
        return target.read_bytes() != piece
    problems: list[str] = []
    pack = zlib.compressobj(6, zlib.DEFLATED, 31)
    erased: _Erased | None = None
    differs = False
    with target.open("wb") as file:
        for text in recording.texts(source, problems):
            line = recording.parsed(text)
            erased = erased or _Erased(line or {}, seat, user)
            left = erased.without(line, text) if line is not None else None
            same = left == line and line is not None
            differs = differs or (not same and bool(text.strip()))
            if left is not None:
                written = text if same else json.dumps(left, separators=(",", ":")).encode()
                file.write(pack.compress(written + b"\n"))
        file.write(pack.flush(zlib.Z_SYNC_FLUSH if problems else zlib.Z_FINISH))
    return differs


class _Erased:
    """Removes a member's data from the lines of a recording, of which `header` is the first."""

    def __init__(self, header: Mapping[str, Any], seat: int, user: str) -> None:
        humans = recording.humans_of(header)
        self._first = humans[0] if humans else ""
        players = {name for name, of in recording.seats_of(header).items() if of == seat}
        self._players: Collection[str] | None = players if header.get("kind") == "header" else None  # None: unknown
        self._id = user.lower().encode() if len(user) >= SHORTEST else None
        self._hide = Scrub({user: ""}).sparing(recording.players_of(header))

    def without(self, line: Mapping[str, Any], text: bytes) -> dict[str, Any] | None:
        """Return the line without the member's data; None if it is only about them. `text` is the line as written."""
        if line.get("kind") == "header":
            return dict(line)  # it is the study's: no participant has sent a word of it
        if self._is_theirs(line):
            return None
        left = dict(line)
        if isinstance(messages := line.get("messages"), list):
            left["messages"] = [message for message in messages if not self._sent(message)]
        for name in OF_EACH:
            if isinstance(values := line.get(name), Mapping):
                left[name] = {player: value for player, value in values.items() if not self._is(player)}
        if isinstance(players := line.get("players"), Mapping):
            left["players"] = {
                player: _without_keys(part) if self._is(player) else part for player, part in players.items()
            }
        if self._is(self._first) and line.get("human") is not None:
            left["human"] = None
        if self._id is not None and self._id in text.lower():
            left = self._hide.record(left)
        return left

    def _is(self, player: Any) -> bool:
        return self._players is None or player in self._players

    def _sent(self, message: Any) -> bool:
        """Whether the member has sent a message, or may have sent it because it names no player."""
        return not isinstance(message, Mapping) or "player" not in message or self._is(message["player"])

    def _is_theirs(self, line: Mapping[str, Any]) -> bool:
        kind = line.get("kind")
        if kind == "presence":
            # A line with a `seed` stays: a repetition of the game needs it for the policy that replaced the member.
            return self._is(line.get("player")) and "seed" not in line
        if kind == "ping":
            trips = line.get("roundTrip")
            return not isinstance(trips, Mapping) or all(map(self._is, trips))
        if kind == "callback":
            return self._is(line["player"]) if "player" in line else line.get("callback") in ABOUT_ONE
        return False


def _without_keys(part: Any) -> Any:
    return {name: value for name, value in part.items() if name not in OF_KEYS} if isinstance(part, Mapping) else part


def _of_tape(piece: bytes, seat: int, user: str) -> bytes:
    """Return a piece of a tape without the member's words; without records, if it cannot be read."""
    try:
        tape = json.loads(piece)
        records, seats = list(tape["records"]), [str(player) for player in tape["seats"]]
        player = seats[seat]
    except (ValueError, KeyError, TypeError, IndexError):
        return b'{"schema":1,"records":[]}'
    hide = Scrub({user: ""}).sparing(seats)
    left = {**tape, "records": [hide.record(_unsaid(record, player)) for record in records]}
    return piece if left == tape else json.dumps(left, separators=(",", ":")).encode()


def _unsaid(record: Any, player: str) -> Mapping[str, Any]:
    if not isinstance(record, Mapping):
        return {}
    if record.get("kind") == "line" and record.get("by") == player:
        kept = {name: value for name, value in record.items() if name not in ("original", "typed")}
        return {**kept, "text": "", "erased": True}
    if record.get("kind") == "call" and "request" in record:
        return {name: value for name, value in record.items() if name != "request"} | {"erased": True}
    return record
