"""From a recording (gzip of JSON lines, `docs/data.md`) to a Parquet file: one row per line, and nothing left out.

Memory stays bounded however long the recording is: it is read in pieces and written in row groups.
"""

# ruff: noqa: PLC0415 - pyarrow is large, and imported when something is converted

from __future__ import annotations

import base64
import functools
import itertools
import json
import math
import re
import zlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import msgspec

from export.scrub import Scrub

SCHEMA = 1
GROUP_ROWS = 8_192  # rows written at once
GROUP_BYTES = 16 * 1024 * 1024  # of observations, if that is less
_PIECE = 256 * 1024  # bytes
_LONGEST = 64 * 1024 * 1024  # bytes in a line
_BIGGEST = 256 * 1024 * 1024  # bytes in an observation
_DTYPE = re.compile(r"bool|(?:u?int|float)(8|16|32|64)")
MOST_PLAYERS = 64  # as many as `trial.players` may name
_NOT_STORED = {"kind", "v", "session", "trial", "observation"}


@dataclass
class Converted:
    """What a recording held. `problems` are sentences; what came before them is in the file."""

    frames: int = 0
    rows: int = 0
    complete: bool = False
    callbacks: int = 0
    episodes: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


@functools.cache
def schema(players: tuple[str, ...] = ()) -> Any:
    """The columns of every converted recording. Names are those of the recording's lines.

    If several `players` play, each has columns of its own besides: `action.NAME`, `by.NAME`, `reward.NAME`.
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
        ]
    )


def players_of(header: Mapping[str, Any]) -> tuple[str, ...]:
    """The players that the head of a recording names; empty if there is one."""
    players = header.get("players")
    return tuple(map(str, players))[:MOST_PLAYERS] if isinstance(players, Mapping) else ()


def convert(source: Path, target: Path, who: Mapping[str, Any], scrub: Scrub, shown: bool = True) -> Converted:
    """Write `target` from `source`. `who` fills participant, studyStep and attempt.

    Without `shown`, the names of user and server stay out of the file's metadata. Raises OSError of the target's disk.
    """
    import pyarrow.parquet as pq

    done = Converted()
    header: Mapping[str, Any] = {}
    read = lines(source, done.problems)
    first = list(itertools.islice(read, 1))
    rows = _Rows(who, scrub, players_of(first[0]) if first and first[0].get("kind") == "header" else ())
    with pq.ParquetWriter(target, rows.schema, compression="zstd") as writer:
        for line in itertools.chain(first, read):
            kind = line.get("kind")
            if kind == "header" and not header:
                header = line
                rows.trial = _text(line.get("trial"))
                continue
            if not isinstance(kind, str):
                done.problems.append("a line without a kind is kept as it is")
            _count(done, line, kind)
            rows.add(line)
            if rows.full:
                writer.write_table(rows.table())
        done.rows = rows.written + rows.waiting
        if rows.waiting or not done.rows:
            writer.write_table(rows.table())
        if not header:
            done.problems.append("there is no header")
        hidden = set() if shown else {"user", "server", "session"}
        about = {
            "schema": SCHEMA,
            "complete": done.complete,
            "header": {name: scrub.value(value) for name, value in header.items() if name not in hidden},
        }
        writer.add_key_value_metadata({"hippodrome": json.dumps(about)})
    done.problems[:] = _summed(done.problems + rows.problems)
    if done.callbacks and done.episodes:
        done.episodes[0]["callbacks"] = done.callbacks  # in all of the file
    for episode in done.episodes:
        episode["score"] = episode["score"] if math.isfinite(episode["score"]) else None
        episode["scores"] = {name: score for name, score in episode["scores"].items() if math.isfinite(score)}
        episode["players"] = _who_plays(header, scrub)
    return done


# Reading


def lines(source: Path, problems: list[str]) -> Iterator[dict[str, Any]]:
    """The lines of a recording, up to where it can be read; what was in the way is added to `problems`."""
    begun: list[bytes] = []  # of a line whose end has not come yet
    length = 0
    for piece in _unpacked(source, problems):
        first, *whole = piece.split(b"\n")
        begun.append(first)
        length += len(first)
        if length > _LONGEST:
            problems.append("a line is too long to be one; nothing behind it was read")
            return
        if not whole:
            continue
        whole, rest = [b"".join(begun), *whole[:-1]], whole[-1]
        begun, length = [rest], len(rest)
        for text in whole:
            line = _parsed(text)
            if line is not None:
                yield line
            elif text.strip():
                problems.append("a line that is no JSON object was left out")
    if b"".join(begun).strip():
        problems.append("the last line is cut off and was left out")


def _unpacked(source: Path, problems: list[str]) -> Iterator[bytes]:
    unpack = zlib.decompressobj(31)
    begun = False
    with source.open("rb") as file:
        while packed := file.read(_PIECE):
            while packed:
                if unpack.eof:  # another gzip member follows
                    unpack, begun = zlib.decompressobj(31), False
                begun = True
                try:
                    piece = unpack.decompress(packed, 4 * _PIECE)
                except zlib.error:
                    problems.append("the file is damaged: what comes before that place is kept")
                    return
                yield piece
                packed = unpack.unused_data if unpack.eof else unpack.unconsumed_tail
        while begun and not unpack.eof:  # what a full output buffer has held back
            piece = unpack.decompress(b"", 4 * _PIECE)
            if not piece:
                break
            yield piece
    if not begun:
        problems.append("the file is empty")
    elif not unpack.eof:
        problems.append("the recording was cut off: it ends early")


def _parsed(text: bytes) -> dict[str, Any] | None:
    line: Any
    try:
        line = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        try:  # more patient with NaN and half characters
            line = json.loads(text)
        except (ValueError, RecursionError):
            return None
    return line if isinstance(line, dict) else None


def _count(done: Converted, line: Mapping[str, Any], kind: object) -> None:
    """Keep the books of episodes: one begins with `reset`, and ends with `end`, or not at all."""
    if kind == "callback":
        done.callbacks += 1
        return
    if kind != "break":  # it follows an episode's end, and takes nothing from it
        done.complete = kind == "end"
    number = line.get("episode")
    now = done.episodes[-1] if done.episodes else None
    if kind == "reset":
        if now is not None and now["why"] is None and not now["frames"] and now["episode"] == _whole(number):
            done.episodes.pop()  # the reset before it failed: it was not played
        seed = _whole(line.get("seed"))
        done.episodes.append(_episode(line, _whole(number), seed))
        return
    if kind == "step":
        done.frames += 1
        if now is None or now["why"] is not None or now["episode"] != _whole(number):
            now = _episode(line, _whole(number), None)
            done.episodes.append(now)
        now["frames"] += 1
        now["score"] += _number(line.get("reward")) or 0.0
        _add_rewards(now["scores"], line.get("players"))
        now["ended"] = _text(line.get("time"))
    elif kind == "end" and now is not None and now["episode"] == _whole(number):
        now["why"] = _text(line.get("why")) or "?"
        now["ended"] = _text(line.get("time")) or now["ended"]


def _episode(line: Mapping[str, Any], number: int | None, seed: int | None) -> dict[str, Any]:
    started = _text(line.get("time"))
    return {
        "trial": _text(line.get("trial")),
        "episode": number,
        "seed": seed,
        "frames": 0,
        "score": 0.0,
        "scores": {},
        "why": None,
        "started": started,
        "ended": started,
    }


def _add_rewards(scores: dict[str, float], players: Any) -> None:
    """Add what each player of a step got; what is no number counts nothing, as in `score`."""
    if isinstance(players, Mapping):
        for name, did in itertools.islice(players.items(), MOST_PLAYERS):
            reward = _number(did.get("reward")) if isinstance(did, Mapping) else None
            scores[str(name)] = scores.get(str(name), 0.0) + (reward or 0.0)


def _who_plays(header: Mapping[str, Any], scrub: Scrub) -> dict[str, str | None]:
    """By player: `human`, or the policy or program as config.yml has it."""
    players = header.get("players")
    if not isinstance(players, Mapping):
        return {}
    found = {}
    for name in players_of(header):
        about = players.get(name)
        said = about.get("policy", about.get("kind")) if isinstance(about, Mapping) else None
        found[name] = scrub.value(said) if isinstance(said, str) else None
    return found


def _summed(problems: list[str]) -> list[str]:
    """Each problem once, with how often."""
    counted = {problem: problems.count(problem) for problem in dict.fromkeys(problems)}
    return [problem if times == 1 else f"{problem} ({times} times)" for problem, times in counted.items()]


# Values of the columns: None for what does not fit; that is kept in `other`


def _whole(value: Any) -> int | None:
    fits = isinstance(value, int) and not isinstance(value, bool) and -(2**63) <= value < 2**63
    return value if fits else None


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        return float(value)
    except OverflowError:
        return None


def _truth(value: Any) -> bool | None:
    return value if isinstance(value, bool) else None


def _text(value: Any) -> str | None:
    return value if isinstance(value, str) else None


def when(value: Any) -> datetime | None:
    """A time as records have it: `2026-11-21T14:46:40.123456Z`."""
    try:
        found = datetime.fromisoformat(value)
    except (TypeError, ValueError):
        return None
    return found if found.tzinfo is not None else None


def _json(value: Any) -> str:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False)


_TYPED: dict[str, Callable[[Any], Any]] = {
    "episode": _whole,
    "step": _whole,
    "frame": _whole,
    "time": when,
    "ns": _whole,
    "action": _whole,
    "actionName": _text,
    "by": _text,
    "human": _whole,
    "reward": _number,
    "terminated": _truth,
    "truncated": _truth,
    "info": _json,
    "messages": _json,
    "seed": _whole,
    "steps": _whole,
    "score": _number,
    "why": _text,
    "error": _text,
}
_PLAYERS_COLUMNS: dict[str, tuple[Callable[[], Any], Callable[[Any], Any]]] = {
    "action": (lambda: _arrow("int64"), _whole),
    "by": (lambda: _arrow("string"), _text),
    "reward": (lambda: _arrow("float64"), _number),
}
"""What each player's columns hold: Arrow's type, and the value or None if it does not fit."""


def _arrow(name: str) -> Any:
    import pyarrow as pa

    return getattr(pa, name)()


_TEXTS = ("kind", "actionName", "by", "info", "messages", "why", "error", "other", "trial")


class _Rows:
    """Rows that wait to be written: a list per column."""

    def __init__(self, who: Mapping[str, Any], scrub: Scrub, players: tuple[str, ...] = ()) -> None:
        self._who = who
        self._scrub = scrub
        self._players = players
        self.schema = schema(players)
        self._columns: dict[str, list[Any]] = {name: [] for name in self.schema.names}
        self._bytes = 0
        self.problems: list[str] = []
        self.trial: str | None = None
        self.waiting = 0
        self.written = 0

    @property
    def full(self) -> bool:
        return self.waiting >= GROUP_ROWS or self._bytes >= GROUP_BYTES

    def add(self, line: Mapping[str, Any]) -> None:
        columns = self._columns
        other = {name: value for name, value in line.items() if name not in _TYPED and name not in _NOT_STORED}
        kind = line.get("kind")
        columns["kind"].append(_text(kind))
        if not isinstance(kind, str):
            other["kind"] = kind
        columns["trial"].append(_text(line.get("trial")) or self.trial)
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
        columns["other"].append(_json(other) if other else None)
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
        for name, value in self._who.items():
            columns[name] = [value] * self.waiting
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
