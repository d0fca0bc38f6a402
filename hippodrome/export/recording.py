"""Recordings (gzip of JSON lines, `docs/data.md`): reads their lines, and converts them into Parquet files with one
row per line.

No field of a line is lost. Memory is bounded however long the recording is: it is read in pieces, and written in row
groups.
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
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from hippodrome.export.scrub import Scrub
from hippodrome.export.values import as_number, as_text, as_truth, as_whole, json_text, when
from hippodrome.protocol.players import MAX_PLAYERS

SCHEMA = 1
RECORDED = 1
"""The version of recordings' lines (`v`) that is converted."""
MAX_FORM_COLUMNS = 200  # of one player in one episode
GROUP_ROWS = 8_192  # rows written at once
GROUP_BYTES = 16 * 1024 * 1024
_MAX_OBSERVATION = 256 * 1024 * 1024  # the most bytes of an observation
_DTYPE = re.compile(r"bool|(?:u?int|float)(8|16|32|64)")
_PIECE = 256 * 1024  # bytes
_MAX_LINE = 64 * 1024 * 1024  # bytes

# Lines


def lines(source: Path, problems: list[str]) -> Iterator[dict[str, Any]]:
    """Yield the lines of a recording, up to the place where it cannot be read. Adds a sentence to `problems` for each
    line that is left out, and for a recording that cannot be read to its end."""
    for text in texts(source, problems):
        line = parsed(text)
        if line is not None:
            yield line
        elif text.strip():
            problems.append("a line that is no JSON object was left out")


def texts(source: Path, problems: list[str]) -> Iterator[bytes]:
    """Yield the same lines as bytes, without their line ends. Adds to `problems` as `lines` does."""
    begun: list[bytes] = []  # the parts of a line whose end was not read yet
    length = 0
    for piece in _unpacked(source, problems):
        first, *whole = piece.split(b"\n")
        begun.append(first)
        length += len(first)
        if length > _MAX_LINE:
            problems.append("a line is too long; it and the lines after it were not read")
            return
        if not whole:
            continue
        whole, rest = [b"".join(begun), *whole[:-1]], whole[-1]
        begun, length = [rest], len(rest)
        yield from whole
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
                    problems.append("the file is damaged: only the lines before the damage are kept")
                    return
                yield piece
                packed = unpack.unused_data if unpack.eof else unpack.unconsumed_tail
        while begun and not unpack.eof:  # the end may not have fitted into the last piece
            piece = unpack.decompress(b"", 4 * _PIECE)
            if not piece:
                break
            yield piece
    if not begun:
        problems.append("the file is empty")
    elif not unpack.eof:
        problems.append("the recording was cut off: it ends early")


def parsed(text: bytes) -> dict[str, Any] | None:
    """Return the JSON object in a line; None if there is none."""
    line: Any
    try:
        line = msgspec.json.decode(text)
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError):
        try:  # json accepts NaN and unpaired surrogates, which msgspec refuses
            line = json.loads(text)
        except (ValueError, RecursionError):
            return None
    return line if isinstance(line, dict) else None


# The header


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


def _who_plays(header: Mapping[str, Any]) -> dict[str, str | None]:
    """Who plays each player: `human`, or the policy or program as in config.yml."""
    players = {name: header["players"].get(name) for name in players_of(header)}
    return {
        name: as_text(player.get("policy", player.get("kind"))) if isinstance(player, Mapping) else None
        for name, player in players.items()
    }


# Rows

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
    "terminated": as_truth,
    "truncated": as_truth,
    "info": json_text,
    "messages": json_text,
    "seed": as_whole,
    "steps": as_whole,
    "score": as_number,
    "why": as_text,
    "error": as_text,
}
"""The columns whose values are fields of the lines, in their order. The function returns a value that fits, or None;
the column `other` has the values that do not fit."""
_OF_EACH_PLAYER = ("action", "by", "reward")
"""The columns that each player has, if there are several."""
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
        as_truth: pa.bool_(),
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


def _row(line: Mapping[str, Any], players: tuple[str, ...]) -> dict[str, Any]:
    """The values of a line's columns, but for those with one value in all rows; empty ones may be missing."""
    row: dict[str, Any] = {"kind": as_text(line.get("kind")), "trial": as_text(line.get("trial"))}
    other = {name: value for name, value in line.items() if name not in _TYPED and name not in _NOT_STORED}
    if "kind" in line and row["kind"] is None:
        other["kind"] = line["kind"]
    for name, fit in _TYPED.items():
        value = line.get(name)
        if value is not None:
            row[name] = fit(value)
            if row[name] is None:
                other[name] = value
    if (observation := line.get("observation")) is not None:
        try:
            row["observation"], row["observationDtype"], row["observationShape"] = unpack_array(observation)
        except (KeyError, TypeError, ValueError, zlib.error):
            other["observation"] = observation
    parts = line.get("players")
    for player, part in parts.items() if isinstance(parts, Mapping) else ():
        if player not in players:
            continue
        for name in _OF_EACH_PLAYER if isinstance(part, Mapping) else ():
            row[f"{name}.{player}"] = None if part.get(name) is None else _TYPED[name](part[name])
    row["other"] = json_text(other) if other else None
    return row


def unpack_array(recorded: Any) -> tuple[bytes, str, list[int]]:
    """Return the bytes (C order), dtype and shape of a recorded array. Raises KeyError, TypeError, ValueError or
    zlib.error for any other value."""
    dtype, shape = recorded["dtype"], [int(side) for side in recorded["shape"]]
    bits = _DTYPE.fullmatch(dtype)
    if not bits or dtype == "float8" or any(side < 0 or side >= 2**31 for side in shape):
        raise ValueError("no array")
    size = math.prod(shape) * (int(bits[1] or 8) // 8)
    if size > _MAX_OBSERVATION:
        raise ValueError("too large")
    unpack = zlib.decompressobj()
    data = unpack.decompress(base64.b64decode(recorded["zlib"], validate=True), size + 1)
    if len(data) != size:
        raise ValueError("another size")
    return data, dtype, shape


# Conversion


@dataclass
class Converted:
    """A summary of a converted recording."""

    frames: int = 0
    rows: int = 0
    complete: bool = False  # whether its last line is the end of an episode
    callbacks: int = 0  # lines that callbacks have recorded
    episodes: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)  # sentences


def convert(
    source: Path,
    target: Path,
    constants: Mapping[str, Any],
    scrub: Scrub,
    *,
    shown: bool = True,
    people: Mapping[int, str] | None = None,
) -> Converted:
    """Convert the recording `source` into the Parquet file `target`.

    `constants` has the columns with one value in all rows: participant, studyStep and attempt. In a session, `people`
    has the members' numbers by seat, and `constants` has `session` instead of participant. `scrub` replaces identities.
    Without `shown`, the file's metadata leave out user, server and session. Raises OSError if `source` cannot be read
    or `target` cannot be written.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    done = Converted()
    header: Mapping[str, Any] = {}
    read = lines(source, done.problems)
    first = list(itertools.islice(read, 1))
    head = first[0] if first and first[0].get("kind") == "header" else {}
    players = players_of(head)
    playing = None if people is None else {name: people.get(seat) for name, seat in seats_of(head).items()}
    constants = {**constants, **{f"participant.{name}": number for name, number in (playing or {}).items()}}
    scrub = scrub.sparing(players)
    columns = schema(players, None if playing is None else tuple(playing))
    versions: set[int] = set()
    rows: list[dict[str, Any]] = []
    size = 0  # of `rows`, in bytes
    trial: str | None = None
    with pq.ParquetWriter(target, columns, compression="zstd") as writer:
        for line in itertools.chain(first, read):
            if (version := as_whole(line.get("v"))) not in (None, RECORDED):
                versions.add(version)
            if line.get("kind") == "header" and not header:
                header, trial = line, as_text(scrub.value(line.get("trial")))
                continue
            if not isinstance(line.get("kind"), str):
                done.problems.append("a line without a kind is kept as it is")
            line = scrub.record(line)  # noqa: PLW2901
            _count(done, line)
            row = _row(line, players)
            rows.append({**row, "trial": row["trial"] or trial, **constants})
            size += sum(len(value) for value in row.values() if isinstance(value, bytes | str))
            if len(rows) >= GROUP_ROWS or size >= GROUP_BYTES:
                writer.write_table(pa.Table.from_pylist(rows, columns))
                done.rows += len(rows)
                rows, size = [], 0
        if rows or not done.rows:
            writer.write_table(pa.Table.from_pylist(rows, columns))
            done.rows += len(rows)
        # The header is the study's; only the trial's id may be the server's name.
        about = {name: value for name, value in header.items() if shown or name not in ("userId", "server")}
        about |= {"trial": scrub.value(about["trial"])} if "trial" in about else {}
        metadata = {"schema": SCHEMA, "complete": done.complete, "header": about}
        writer.add_key_value_metadata({"hippodrome": json.dumps(metadata)})
    done.problems += (
        f"lines of the form {version} were read as those of the form {RECORDED}; a newer Hippodrome may read more"
        for version in sorted(versions)
    )
    if not header and done.rows:
        done.problems.append("there is no header")
    done.problems[:] = [
        problem if times == 1 else f"{problem} ({times} times)" for problem, times in Counter(done.problems).items()
    ]
    more = {} if playing is None else {"session": constants.get("session"), "people": playing}
    done.episodes[:] = [_over(episode) | {"players": _who_plays(header)} | more for episode in done.episodes]
    if done.callbacks and done.episodes:
        done.episodes[0]["callbacks"] = done.callbacks  # the number for the whole file
    return done


def _count(done: Converted, line: Mapping[str, Any]) -> None:
    """Count a line in its episode. An episode begins with `reset`, and ends with `end` or is cut off."""
    kind, number = line.get("kind"), as_whole(line.get("episode"))
    if kind == "callback":
        done.callbacks += 1
        return
    if kind != "break":  # a break after an episode's end does not make the recording incomplete
        done.complete = kind == "end"
    now = done.episodes[-1] if done.episodes else None
    if kind == "break" and now is not None:
        _add_forms(now, line.get("messages"))
    elif kind == "reset":
        if now is not None and now["why"] is None and not now["frames"] and now["episode"] == number:
            done.episodes.pop()  # that reset failed, so its episode was not played
        done.episodes.append(_episode(line, number, as_whole(line.get("seed"))))
    elif kind == "step":
        done.frames += 1
        if now is None or now["why"] is not None or now["episode"] != number:
            now = _episode(line, number, None)
            done.episodes.append(now)
        now["frames"] += 1
        now["score"] += as_number(line.get("reward")) or 0.0
        _add_forms(now, line.get("messages"))
        _add_players(now, line.get("players"))
        now["ended"] = as_text(line.get("time"))
    elif kind == "end" and now is not None and now["episode"] == number:
        now["why"] = as_text(line.get("why")) or "?"
        now["ended"] = as_text(line.get("time")) or now["ended"]


def _episode(line: Mapping[str, Any], number: int | None, seed: int | None) -> dict[str, Any]:
    started = as_text(line.get("time"))
    return {
        "trial": as_text(line.get("trial")),
        "episode": number,
        "seed": seed,
        "frames": 0,
        "score": 0.0,
        "scores": {},
        "byPolicy": {},
        "forms": {},
        "why": None,
        "started": started,
        "ended": started,
    }


def _over(episode: Mapping[str, Any]) -> dict[str, Any]:
    """An episode that is over: without scores that no number holds."""
    scores = {name: score for name, score in episode["scores"].items() if math.isfinite(score)}
    return {**episode, "score": episode["score"] if math.isfinite(episode["score"]) else None, "scores": scores}


def _add_forms(episode: dict[str, Any], messages: Any) -> None:
    """Add the fields that participants have filled in on a page of the game: of two forms of a page, the later one."""
    for message in messages if isinstance(messages, list) else ():
        form = message.get("form") if isinstance(message, Mapping) else None
        form = form if isinstance(form, Mapping) else {}
        fields = form.get("fields")
        for name, value in fields.items() if isinstance(fields, Mapping) else ():
            own = episode["forms"].setdefault(str(message.get("player", "")), {})
            if len(own) < MAX_FORM_COLUMNS:
                text = value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
                own[f"{form.get('page')}.{name}"] = text


def _add_players(episode: dict[str, Any], players: Any) -> None:
    """Add the reward of each player of a step, and count the step for each player whose action a policy chose.

    A reward that is no number counts as 0, as in `score`.
    """
    scores, by_policy = episode["scores"], episode["byPolicy"]
    for name, part in itertools.islice(players.items(), MAX_PLAYERS) if isinstance(players, Mapping) else ():
        values = part if isinstance(part, Mapping) else {}
        scores[name] = scores.get(name, 0.0) + (as_number(values.get("reward")) or 0.0)
        if values.get("by") == "policy":
            by_policy[name] = by_policy.get(name, 0) + 1
