"""The columns of a converted recording: their names and types, which players have some, and the rows that fill them."""

# ruff: noqa: PLC0415 - pyarrow is large, and imported when something is converted

from __future__ import annotations

import base64
import functools
import math
import re
import zlib
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any

from export.scrub import Scrub
from export.table_files import json_text

GROUP_ROWS = 8_192  # rows written at once
GROUP_BYTES = 16 * 1024 * 1024  # of observations, if that is less
MOST_PLAYERS = 64  # as many as `trial.players` may name
_BIGGEST = 256 * 1024 * 1024  # bytes in an observation
_DTYPE = re.compile(r"bool|(?:u?int|float)(8|16|32|64)")
_NOT_STORED = {"kind", "v", "session", "trial", "observation"}


@functools.cache
def schema(players: tuple[str, ...] = (), humans: tuple[str, ...] | None = None) -> Any:
    """The columns of every converted recording. Names are those of the recording's lines.

    If several `players` play, each has columns of its own besides: `action.NAME`, `by.NAME`, `reward.NAME`. That of a
    session has `session`, and `participant.NAME` for each of the `humans`.
    """
    import pyarrow as pa

    when = pa.timestamp("us", tz="UTC")
    return pa.schema(
        [
            ("participant", pa.string()),
            ("studyStep", pa.string()),
            ("attempt", pa.int64()),
            ("trial", pa.string()),
            ("kind", pa.string()),
            ("episode", pa.int64()),
            ("step", pa.int64()),
            ("frame", pa.int64()),
            ("time", when),
            ("ns", pa.int64()),
            ("action", pa.int64()),
            ("actionName", pa.string()),
            ("by", pa.string()),
            ("human", pa.int64()),
            ("reward", pa.float64()),
            ("terminated", pa.bool_()),
            ("truncated", pa.bool_()),
            ("info", pa.string()),
            ("messages", pa.string()),
            ("seed", pa.int64()),
            ("steps", pa.int64()),
            ("score", pa.float64()),
            ("why", pa.string()),
            ("error", pa.string()),
            ("observation", pa.binary()),
            ("observationDtype", pa.string()),
            ("observationShape", pa.list_(pa.int32())),
            ("other", pa.string()),
            *((f"{name}.{player}", _PLAYERS_COLUMNS[name][0]()) for player in players for name in _PLAYERS_COLUMNS),
            *([] if humans is None else [("session", pa.string())]),
            *((f"participant.{player}", pa.string()) for player in humans or ()),
        ]
    )


def players_of(header: Mapping[str, Any]) -> tuple[str, ...]:
    """The players that the head of a recording names; empty if there is one."""
    players = header.get("players")
    return tuple(map(str, players))[:MOST_PLAYERS] if isinstance(players, Mapping) else ()


def humans_of(header: Mapping[str, Any]) -> tuple[str, ...]:
    """The players of people, from the head of a recording; empty if one player plays."""
    players = header.get("players")
    said = ((name, players.get(name)) for name in players_of(header)) if isinstance(players, Mapping) else ()
    return tuple(name for name, each in said if isinstance(each, Mapping) and each.get("kind") == "human")


def seats_of(header: Mapping[str, Any]) -> dict[str, int]:
    """The seats of a session's humans by player, from the head of its recording.

    A player's `seat` stands there; in recordings without it, it is the player's place among the humans.
    """
    seats = (as_whole(header["players"][name].get("seat")) for name in humans_of(header))
    return {
        name: place if seat is None else seat
        for place, (name, seat) in enumerate(zip(humans_of(header), seats, strict=True))
    }


# Values of the columns: None for what does not fit; that is kept in `other`


def as_whole(value: Any) -> int | None:
    """A whole number that fits its column."""
    fits = isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63
    return value if fits else None


def as_number(value: Any) -> float | None:
    """A number as a float."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def _as_truth(value: Any) -> bool | None:
    return value if isinstance(value, bool) else None


def as_text(value: Any) -> str | None:
    """A text."""
    return value if isinstance(value, str) else None


def when(value: Any) -> datetime | None:
    """A time as records have it: `2026-11-21T14:46:40.123456Z`."""
    try:
        found = datetime.fromisoformat(value)
    except (TypeError, ValueError):
        return None
    return found if found.tzinfo is not None else None


_TYPED: dict[str, Callable[[Any], Any]] = {
    "episode": as_whole,
    "step": as_whole,
    "frame": as_whole,
    "time": when,
    "ns": as_whole,
    "action": as_whole,
    "actionName": as_text,
    "by": as_text,
    "human": as_whole,
    "reward": as_number,
    "terminated": _as_truth,
    "truncated": _as_truth,
    "info": json_text,
    "messages": json_text,
    "seed": as_whole,
    "steps": as_whole,
    "score": as_number,
    "why": as_text,
    "error": as_text,
}
_PLAYERS_COLUMNS: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {
    "action": (lambda: _arrow("int64"), as_whole),
    "by": (lambda: _arrow("string"), as_text),
    "reward": (lambda: _arrow("float64"), as_number),
}
"""What each player's columns hold: Arrow's type, and the value or None if it does not fit."""


def _arrow(name: str) -> Any:
    import pyarrow as pa

    return getattr(pa, name)()


_TEXTS = ("kind", "actionName", "by", "info", "messages", "why", "error", "other", "trial")


class Rows:
    """Rows that wait to be written: a list per column."""

    def __init__(
        self,
        who: Mapping[str, Any],
        scrub: Scrub,
        players: tuple[str, ...] = (),
        humans: tuple[str, ...] | None = None,
    ) -> None:
        self._who = who
        self._scrub = scrub
        self._players = players
        self.schema = schema(players, humans)
        self._columns: dict[str, list[Any]] = {name: [] for name in self.schema.names}
        self._bytes = 0
        self.problems: list[str] = []
        self.trial: str | None = None
        self.waiting = 0
        self.written = 0

    @property
    def full(self) -> bool:
        """Whether as many wait as are written at once."""
        return self.waiting >= GROUP_ROWS or self._bytes >= GROUP_BYTES

    def add(self, line: Mapping[str, Any]) -> None:
        """A row from a line of the recording."""
        columns = self._columns
        other = {name: value for name, value in line.items() if name not in _TYPED and name not in _NOT_STORED}
        kind = line.get("kind")
        columns["kind"].append(as_text(kind))
        if not isinstance(kind, str):
            other["kind"] = kind
        columns["trial"].append(as_text(line.get("trial")) or self.trial)
        for name, fit in _TYPED.items():
            value = line.get(name)
            fitting = None if value is None else fit(value)
            if value is not None and fitting is None:
                other[name] = value
            columns[name].append(fitting)
        kept, dtype, shape = self._observation(line, other)
        columns["observation"].append(kept)
        columns["observationDtype"].append(dtype)
        columns["observationShape"].append(shape)
        columns["other"].append(json_text(other) if other else None)
        self._add_players(line.get("players"))
        self._bytes += len(kept or b"")
        self.waiting += 1

    def _add_players(self, parts: Any) -> None:
        """What each player did and got, if several play. All else of them is in `other`."""
        for player in self._players:
            part = parts.get(player) if isinstance(parts, Mapping) else None
            for name, (_, fit) in _PLAYERS_COLUMNS.items():
                value = part.get(name) if isinstance(part, Mapping) else None
                self._columns[f"{name}.{player}"].append(None if value is None else fit(value))

    def _observation(
        self, line: Mapping[str, Any], other: dict[str, Any]
    ) -> tuple[bytes | None, str | None, list[int] | None]:
        """An array by itself is kept as its bytes; anything else stays as it was recorded, in `other`."""
        value = line.get("observation")
        if value is None:
            return None, None, None
        try:
            return unpack_array(value)
        except (KeyError, TypeError, ValueError, zlib.error):
            other["observation"] = value
            return None, None, None

    def table(self) -> Any:
        """The waiting rows; none wait afterwards."""
        import pyarrow as pa

        columns = self._columns
        for name in (*_TEXTS, *(f"by.{player}" for player in self._players)):
            columns[name] = [None if text is None else self._scrub.text(text) for text in columns[name]]
        for name in ("participant", *self._who):
            columns[name] = [self._who.get(name)] * self.waiting
        made = pa.table([pa.array(columns[f.name], f.type) for f in self.schema], schema=self.schema)
        self._columns = {name: [] for name in columns}
        self.written += self.waiting
        self.waiting = self._bytes = 0
        return made


def unpack_array(kept: Any) -> tuple[bytes, str, list[int]]:
    """The bytes (C order), dtype and shape of a recorded array. Raises KeyError, TypeError, ValueError, zlib.error."""
    dtype, shape = kept["dtype"], [int(side) for side in kept["shape"]]
    found = _DTYPE.fullmatch(dtype)
    if not found or dtype == "float8" or any(side < 0 or side >= 2**31 for side in shape):
        raise ValueError("no array")
    size = math.prod(shape) * (int(found[1] or 8) // 8)
    if size > _BIGGEST:
        raise ValueError("too large")
    unpack = zlib.decompressobj()
    data = unpack.decompress(base64.b64decode(kept["zlib"], validate=True), size + 1)
    if len(data) != size:
        raise ValueError("another size")
    return data, dtype, shape
