"""Converts a recording (gzip of JSON lines, `docs/data.md`) into a Parquet file with one row per line.

No field of a line is lost. Memory is bounded however long the recording is: it is read in pieces, and written in row
groups.
"""

# ruff: noqa: PLC0415 - pyarrow is large, and imported when something is converted

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hippodrome.export.recording_columns import Rows, as_number, as_text, as_whole, players_of, seats_of
from hippodrome.export.recording_lines import lines
from hippodrome.export.scrub import Scrub, clean
from hippodrome.protocol.players import MAX_PLAYERS

SCHEMA = 1
RECORDED = 1
"""The version of recordings' lines (`v`) that is converted."""
MAX_FORM_COLUMNS = 200  # of one player in one episode
_MAX_VERSIONS = 10  # that are named


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
    import pyarrow.parquet as pq

    done = Converted()
    header: Mapping[str, Any] = {}
    read = lines(source, done.problems)
    first = list(itertools.islice(read, 1))
    head = first[0] if first and first[0].get("kind") == "header" else {}
    playing = None if people is None else {name: people.get(seat) for name, seat in seats_of(head).items()}
    if playing is not None:
        constants = {**constants, **{f"participant.{name}": number for name, number in playing.items()}}
    scrub = scrub.sparing(players_of(head))
    rows = Rows(constants, scrub, players_of(head), None if playing is None else tuple(playing))
    with pq.ParquetWriter(target, rows.schema, compression="zstd") as writer:
        versions: set[int] = set()
        for line in itertools.chain(first, read):
            kind = line.get("kind")
            version = as_whole(line.get("v"))
            if version not in (None, RECORDED) and len(versions) < _MAX_VERSIONS:
                versions.add(version)
            if kind == "header" and not header:
                header = line
                rows.trial = as_text(scrub.value(line.get("trial")))
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
        done.problems += (
            f"lines of the form {version} were read as those of the form {RECORDED}; a newer Hippodrome may read more"
            for version in sorted(versions)
        )
        if not header and done.rows:
            done.problems.append("there is no header")
        hidden = set() if shown else {"userId", "server"}
        metadata = {
            "schema": SCHEMA,
            "complete": done.complete,
            "header": {
                # The header is the study's; the trial's id may be the server's name.
                name: scrub.value(value) if name == "trial" else value
                for name, value in header.items()
                if name not in hidden
            },
        }
        writer.add_key_value_metadata({"hippodrome": json.dumps(metadata)})
    done.problems[:] = _summed(done.problems + rows.problems)
    if done.callbacks and done.episodes:
        done.episodes[0]["callbacks"] = done.callbacks  # the number for the whole file
    for episode in done.episodes:
        episode["score"] = episode["score"] if math.isfinite(episode["score"]) else None
        episode["scores"] = {name: score for name, score in episode["scores"].items() if math.isfinite(score)}
        episode["players"] = _who_plays(header)
        episode["forms"] = {player: scrub.value(fields) for player, fields in episode["forms"].items()}
        if playing is not None:
            episode |= {"session": constants.get("session"), "people": playing}
    return done


def _count(done: Converted, line: Mapping[str, Any], kind: object) -> None:
    """Count a line in its episode. An episode begins with `reset`, and ends with `end` or is cut off."""
    if kind == "callback":
        done.callbacks += 1
        return
    if kind != "break":  # a break after an episode's end does not make the recording incomplete
        done.complete = kind == "end"
    number = line.get("episode")
    now = done.episodes[-1] if done.episodes else None
    if kind == "break" and now is not None:
        _add_forms(now, line.get("messages"))
    if kind == "reset":
        if now is not None and now["why"] is None and not now["frames"] and now["episode"] == as_whole(number):
            done.episodes.pop()  # that reset failed, so its episode was not played
        seed = as_whole(line.get("seed"))
        done.episodes.append(_episode(line, as_whole(number), seed))
        return
    if kind == "step":
        done.frames += 1
        if now is None or now["why"] is not None or now["episode"] != as_whole(number):
            now = _episode(line, as_whole(number), None)
            done.episodes.append(now)
        now["frames"] += 1
        now["score"] += as_number(line.get("reward")) or 0.0
        _add_forms(now, line.get("messages"))
        _add_players(now, line.get("players"))
        now["ended"] = as_text(line.get("time"))
    elif kind == "end" and now is not None and now["episode"] == as_whole(number):
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


def _add_forms(episode: dict[str, Any], messages: Any) -> None:
    """Add the fields that participants have filled in on a page of the game: of two forms of a page, the later one."""
    for message in messages if isinstance(messages, list) else ():
        form = message.get("form") if isinstance(message, Mapping) else None
        if not isinstance(form, Mapping):
            continue
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
    if not isinstance(players, Mapping):
        return
    scores, by_policy = episode["scores"], episode["byPolicy"]
    for name, part in itertools.islice(players.items(), MAX_PLAYERS):
        values = part if isinstance(part, Mapping) else {}
        scores[name] = scores.get(name, 0.0) + (as_number(values.get("reward")) or 0.0)
        if values.get("by") == "policy":
            by_policy[name] = by_policy.get(name, 0) + 1


def _who_plays(header: Mapping[str, Any]) -> dict[str, str | None]:
    """Who plays each player: `human`, or the policy or program as in config.yml."""
    kinds = {}
    for name in players_of(header):
        player = header["players"].get(name)
        kind = player.get("policy", player.get("kind")) if isinstance(player, Mapping) else None
        kinds[name] = clean(kind) if isinstance(kind, str) else None
    return kinds


def _summed(problems: list[str]) -> list[str]:
    """Each problem once, with the number of times if there are several."""
    counted = {problem: problems.count(problem) for problem in dict.fromkeys(problems)}
    return [problem if times == 1 else f"{problem} ({times} times)" for problem, times in counted.items()]
