"""From a recording (gzip of JSON lines, `docs/data.md`) to a Parquet file: one row per line, and nothing left out.

Memory stays bounded however long the recording is: it is read in pieces and written in row groups.
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

from export.recording_columns import MOST_PLAYERS, Rows, as_number, as_text, as_whole, players_of, seats_of
from export.recording_lines import lines
from export.scrub import Scrub

SCHEMA = 1


@dataclass
class Converted:
    """What a recording held. `problems` are sentences; what came before them is in the file."""

    frames: int = 0
    rows: int = 0
    complete: bool = False
    callbacks: int = 0
    episodes: list[dict[str, Any]] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)


def convert(
    source: Path,
    target: Path,
    who: Mapping[str, Any],
    scrub: Scrub,
    *,
    shown: bool = True,
    people: Mapping[int, str] | None = None,
) -> Converted:
    """Write `target` from `source`. `who` fills participant, studyStep and attempt.

    Without `shown`, the names of user and server stay out of the file's metadata. In a session, `people` are the
    members' numbers by seat, and `who` says `session` instead of participant. Raises OSError of the target's disk.
    """
    import pyarrow.parquet as pq

    done = Converted()
    header: Mapping[str, Any] = {}
    read = lines(source, done.problems)
    first = list(itertools.islice(read, 1))
    head = first[0] if first and first[0].get("kind") == "header" else {}
    seats = None if people is None else seats_of(head)
    playing = {name: people.get(seat) for name, seat in (seats or {}).items()} if people is not None else {}
    if seats is not None:
        who = {**who, **{f"participant.{name}": number for name, number in playing.items()}}
    rows = Rows(who, scrub, players_of(head), None if seats is None else tuple(seats))
    with pq.ParquetWriter(target, rows.schema, compression="zstd") as writer:
        for line in itertools.chain(first, read):
            kind = line.get("kind")
            if kind == "header" and not header:
                header = line
                rows.trial = as_text(line.get("trial"))
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
        if seats is not None:
            episode |= {"session": who.get("session"), "people": playing}
    return done


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
        if now is not None and now["why"] is None and not now["frames"] and now["episode"] == as_whole(number):
            done.episodes.pop()  # the reset before it failed: it was not played
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
        _add_rewards(now["scores"], line.get("players"))
        _count_policies(now["byPolicy"], line.get("players"))
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
        "why": None,
        "started": started,
        "ended": started,
    }


def _add_rewards(scores: dict[str, float], players: Any) -> None:
    """Add what each player of a step got; what is no number counts nothing, as in `score`."""
    if isinstance(players, Mapping):
        for name, did in itertools.islice(players.items(), MOST_PLAYERS):
            reward = as_number(did.get("reward")) if isinstance(did, Mapping) else None
            scores[str(name)] = scores.get(str(name), 0.0) + (reward or 0.0)


def _count_policies(steps: dict[str, int], players: Any) -> None:
    """Count the steps at which a policy chose a player's action."""
    if isinstance(players, Mapping):
        for name, did in itertools.islice(players.items(), MOST_PLAYERS):
            if isinstance(did, Mapping) and did.get("by") == "policy":
                steps[str(name)] = steps.get(str(name), 0) + 1


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
