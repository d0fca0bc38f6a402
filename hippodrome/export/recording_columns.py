"""The columns of a converted recording: their names and types, the columns of each player, and the rows."""

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

from hippodrome.export.scrub import Scrub, clean
from hippodrome.export.table_files import json_text
from hippodrome.protocol.players import MAX_PLAYERS

GROUP_ROWS = 8_192  # rows written at once
GROUP_BYTES = 16 * 1024 * 1024  # of observations; with so many, fewer rows are written at once
_MAX_OBSERVATION = 256 * 1024 * 1024  # the most bytes of an observation
_DTYPE = re.compile(r"bool|(?:u?int|float)(8|16|32|64)")
_NOT_STORED = {"kind", "v", "server", "trial", "observation"}


@functools.cache
def schema(players: tuple[str, ...] = (), humans: tuple[str, ...] | None = None) -> Any:
    """Return the Arrow schema of a converted recording. The columns have the names of the fields in its lines.

    If there are several `players`, each has further columns: `action.NAME`, `by.NAME` and `reward.NAME`. The recording
    of a session has `session`, and `participant.NAME` for each of the `humans`.
    """
    import pyarrow as pa

    types: dict[Callable[[Any], Any], Any] = {
        as_whole: pa.int64(),
        as_number: pa.float64(),
        _as_truth: pa.bool_(),
        as_text: pa.string(),
        json_text: pa.string(),
        when: pa.timestamp("us", tz="UTC"),
    }
    return pa.schema(
        [
            ("participant", pa.string()),
            ("studyStep", pa.string()),
            ("attempt", pa.int64()),
            ("trial", pa.string()),
            ("kind", pa.string()),
            *((name, types[fit]) for name, fit in _TYPED.items()),
            ("observation", pa.binary()),
            ("observationDtype", pa.string()),
            ("observationShape", pa.list_(pa.int32())),
            ("other", pa.string()),
            *((f"{name}.{player}", types[_TYPED[name]]) for player in players for name in _OF_EACH_PLAYER),
            *([] if humans is None else [("session", pa.string())]),
            *((f"participant.{player}", pa.string()) for player in humans or ()),
        ]
    )


def players_of(header: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the players in the header of a recording; () if the environment has one player."""
    players = header.get("players")
    return tuple(map(str, players))[:MAX_PLAYERS] if isinstance(players, Mapping) else ()


def humans_of(header: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the human players in the header of a recording; () if the environment has one player."""
    players = {name: header["players"].get(name) for name in players_of(header)}
    return tuple(
        name for name, player in players.items() if isinstance(player, Mapping) and player.get("kind") == "human"
    )


def seats_of(header: Mapping[str, Any]) -> dict[str, int]:
    """Return the seats of a session's human players, from the header of its recording.

    A player in an older header has no `seat`: then the seat is the player's position among the humans.
    """
    seats = {}
    for place, name in enumerate(humans_of(header)):
        seat = as_whole(header["players"][name].get("seat"))
        seats[name] = place if seat is None else seat
    return seats


# Values of the columns. None stands for a value that does not fit; the column `other` has such values


def as_whole(value: Any) -> int | None:
    """Return a whole number that fits into 64 bits; None for any other value."""
    fits = isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63
    return value if fits else None


def as_number(value: Any) -> float | None:
    """Return a number as a float; None for any other value."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def _as_truth(value: Any) -> bool | None:
    return value if isinstance(value, bool) else None


def as_text(value: Any) -> str | None:
    """Return a text; None for any other value."""
    return value if isinstance(value, str) else None


def when(value: Any) -> datetime | None:
    """Return the time in a text such as `2026-11-21T14:46:40.123456Z`; None for any other value."""
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
"""The columns whose values are fields of the lines, in their order. The function returns a value that fits, or None."""
_OF_EACH_PLAYER = ("action", "by", "reward")
"""The columns that each player has, if there are several."""
_TEXTS = ("kind", "actionName", "by", "info", "messages", "why", "error", "other", "trial")


class Rows:
    """Rows that wait to be written: a list per column. `constants` has the columns with one value in all rows."""

    def __init__(
        self,
        constants: Mapping[str, Any],
        scrub: Scrub,
        players: tuple[str, ...],
        humans: tuple[str, ...] | None,
    ) -> None:
        self._constants = constants
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
        """Whether enough rows wait to be written at once."""
        return self.waiting >= GROUP_ROWS or self._bytes >= GROUP_BYTES

    def add(self, line: Mapping[str, Any]) -> None:
        """Add a row for a line of the recording, without identities."""
        line = self._scrub.record(line)
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
        observation, dtype, shape = self._observation(line, other)
        columns["observation"].append(observation)
        columns["observationDtype"].append(dtype)
        columns["observationShape"].append(shape)
        columns["other"].append(json_text(other) if other else None)
        self._add_players(line.get("players"))
        self._bytes += len(observation or b"")
        self.waiting += 1

    def _add_players(self, parts: Any) -> None:
        """Add the values of each player, if there are several. `other` has the players' further fields."""
        for player in self._players:
            part = parts.get(player) if isinstance(parts, Mapping) else None
            for name in _OF_EACH_PLAYER:
                value = part.get(name) if isinstance(part, Mapping) else None
                self._columns[f"{name}.{player}"].append(None if value is None else _TYPED[name](value))

    def _observation(
        self, line: Mapping[str, Any], other: dict[str, Any]
    ) -> tuple[bytes | None, str | None, list[int] | None]:
        """The bytes, dtype and shape of an observation that is an array. Any other observation goes into `other`."""
        value = line.get("observation")
        if value is None:
            return None, None, None
        try:
            return unpack_array(value)
        except (KeyError, TypeError, ValueError, zlib.error):
            other["observation"] = value
            return None, None, None

    def table(self) -> Any:
        """Return the waiting rows as an Arrow table. No rows wait afterwards."""
        import pyarrow as pa

        columns = self._columns
        for name in (*_TEXTS, *(f"by.{player}" for player in self._players)):
            columns[name] = [None if text is None else clean(text) for text in columns[name]]
        for name in ("participant", *self._constants):
            columns[name] = [self._constants.get(name)] * self.waiting
        made = pa.table([pa.array(columns[f.name], f.type) for f in self.schema], schema=self.schema)
        self._columns = {name: [] for name in columns}
        self.written += self.waiting
        self.waiting = self._bytes = 0
        return made


def unpack_array(recorded: Any) -> tuple[bytes, str, list[int]]:
    """Return the bytes (C order), dtype and shape of a recorded array. Raises KeyError, TypeError, ValueError or
    zlib.error for any other value."""
    dtype, shape = recorded["dtype"], [int(side) for side in recorded["shape"]]
    found = _DTYPE.fullmatch(dtype)
    if not found or dtype == "float8" or any(side < 0 or side >= 2**31 for side in shape):
        raise ValueError("no array")
    size = math.prod(shape) * (int(found[1] or 8) // 8)
    if size > _MAX_OBSERVATION:
        raise ValueError("too large")
    unpack = zlib.decompressobj()
    data = unpack.decompress(base64.b64decode(recorded["zlib"], validate=True), size + 1)
    if len(data) != size:
        raise ValueError("another size")
    return data, dtype, shape
