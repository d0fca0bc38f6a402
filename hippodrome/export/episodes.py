"""Reads converted recordings for datasets (`datasets.py`): their properties, and the rows of their episodes."""

# ruff: noqa: PLC0415 - pyarrow is large, and imported when a recording is read

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hippodrome.export import observations
from hippodrome.export.observations import Kind
from hippodrome.export.recording_columns import as_number, as_whole, humans_of, players_of


class Spec(NamedTuple):
    """The properties of a recording. All recordings of one dataset have the same properties."""

    step: str
    actions: tuple[str, ...]
    kind: Kind | None  # the kind of the observations; None if there are none, or if no space of Minari holds them
    recorded: bool  # whether observations were recorded
    players: tuple[str, ...] = ()  # all players, if there are several
    human: str = ""  # the player whose steps these are, if there are several
    together: bool = False  # whether the participant played with others, in a session
    start: int = 0  # the environment's own number of action 0


class ObservedTexts:
    """The texts in a dataset's observations."""

    def __init__(self) -> None:
        self.characters: set[str] = set()
        self.longest = 0

    def add(self, observation: Any) -> None:
        """Add the texts of an observation."""
        for text in observations.texts_in(observation):
            self.characters.update(text)
            self.longest = max(self.longest, len(text))


def specs(path: Path, step: str, people: Mapping[str, str | None] | None) -> Iterator[tuple[Spec, int, ObservedTexts]]:
    """Yield the properties of a converted recording for each human, the highest number of an action, and the texts.

    In a session, `people` has the participants' numbers by player; a player whose participant was erased is left out.
    """
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file:
        header = _header(file)
        names = header.get("actionSpace")
        actions = tuple(map(str, names)) if isinstance(names, list) else ()
        players, humans = players_of(header), humans_of(header)
        starts = header.get("actionStart") or {}
        if people is None:
            human = humans[0] if humans else ""
            kind, recorded, texts = _observed(file, "")
            start = starts.get(human or "player_0", 0)
            yield Spec(step, actions, kind, recorded, players, human, start=start), _highest(file, "action"), texts
            return
        if people and not any(people.values()):
            return  # all participants were erased
        for human in [human for human in humans if people.get(human)] or humans:
            own = header["players"][human].get("actionSpace")
            own_actions = tuple(map(str, own)) if isinstance(own, list) else actions
            kind, recorded, texts = _observed(file, "" if human == humans[0] else human)
            highest = _highest(file, f"action.{human}")
            start = starts.get(human, 0)
            yield Spec(step, own_actions, kind, recorded, players, human, together=True, start=start), highest, texts


def read(path: Path, spec: Spec) -> Iterator[tuple[list[dict[str, Any]], str]]:
    """Yield for each episode of a recording its rows of the kinds `reset` and `step`, and why it ended.

    Episodes that end before the first step are left out. The rows of a session have the values of `spec.human`. `seen`
    in a row is its observation.
    """
    import pyarrow.parquet as pq

    columns = ["participant", "attempt", "trial", "kind", "episode", "step", "time", "action", "by", "human"]
    columns += ["reward", "terminated", "truncated", "info", "seed", "observation", "observationDtype"]
    columns += ["observationShape", "why", "other"]
    participant = f"participant.{spec.human}"
    columns += ["session", participant] if spec.together else []
    rows: list[dict[str, Any]] = []
    why = "cut off"
    with pq.ParquetFile(path) as file:
        header = _header(file)
        humans = humans_of(header)
        for batch in file.iter_batches(batch_size=512, columns=columns):
            for line in batch.to_pylist():
                row = line
                row["seen"] = _seen(row, "")
                if row["kind"] == "end" and rows and row["episode"] == rows[0]["episode"]:
                    why = row["why"] or why
                if row["kind"] not in ("reset", "step"):
                    continue
                if spec.together:
                    row = row | {"participant": row[participant]}
                    row |= _as_of(row, spec.human, header) if spec.human != humans[0] else {}
                if rows and (row["kind"] == "reset" or row["episode"] != rows[0]["episode"]):
                    if rows[-1]["kind"] == "step":
                        yield rows, why
                    rows, why = [], "cut off"
                rows.append(row)
    if rows and rows[-1]["kind"] == "step":
        yield rows, why


def until_end_of(rows: list[dict[str, Any]], human: str) -> list[dict[str, Any]]:
    """Return the rows up to the step at which the game ended for this human. The others may have played on."""
    for place, row in enumerate(rows):
        part = _part(row, human)
        if row["kind"] == "step" and (part.get("terminated") or part.get("truncated")):
            ends = {name: bool(part.get(name)) for name in ("terminated", "truncated")}
            return [*rows[:place], row | ends]
    return rows


def _as_of(row: Mapping[str, Any], human: str, header: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a human in a row, by the names of the columns; the row itself has the first human's values."""
    part = _part(row, human)
    idle = header.get("idleActions")
    action = part.get("action")
    if action is None and isinstance(idle, dict):  # it was not the human's turn: the environment took the idle action
        action = idle.get(human)
    return {
        "action": as_whole(action),
        "by": part.get("by") or ("none" if row["kind"] == "step" else None),
        "human": as_whole(part.get("human")),
        "reward": as_number(part.get("reward")),
        "info": json.dumps(part["info"]) if "info" in part else None,
        "seen": part.get("observation"),
    }


def _seen(row: Mapping[str, Any], player: str) -> Any:
    """The observation in a row: an array, or as it was recorded. "" is the first human, or the only player."""
    if player:
        return _part(row, player).get("observation")
    if row["observation"] is not None:
        return np.frombuffer(row["observation"], row["observationDtype"]).reshape(row["observationShape"])
    return _other(row).get("observation")


def _part(row: Mapping[str, Any], player: str) -> dict[str, Any]:
    """The values of one player in a row, which are JSON in `other`."""
    players = _other(row).get("players")
    part = players.get(player) if isinstance(players, dict) else None
    return part if isinstance(part, dict) else {}


def _other(row: Mapping[str, Any]) -> dict[str, Any]:
    """The values of a row that have no column."""
    try:
        other = json.loads(row.get("other") or "{}")
    except ValueError:  # the replacement of an id has made it invalid
        return {}
    return other if isinstance(other, dict) else {}


def _header(file: Any) -> dict[str, Any]:
    found = json.loads((file.metadata.metadata or {}).get(b"hippodrome", b"{}")).get("header", {})
    return found if isinstance(found, dict) else {}


def _highest(file: Any, column: str) -> int:
    """The highest number in a column, from the file's statistics; -1 if there is none."""
    place = file.schema_arrow.get_field_index(column)
    highest = -1
    for number in range(file.metadata.num_row_groups if place >= 0 else 0):
        statistics = file.metadata.row_group(number).column(_leaf(file, column)).statistics
        if statistics is not None and statistics.has_min_max:
            highest = max(highest, int(statistics.max))
    return highest


def _leaf(file: Any, column: str) -> int:
    """The position of a column among the leaf columns of Parquet: a column of lists is not a leaf itself."""
    return next(n for n in range(file.metadata.num_columns) if file.metadata.schema.column(n).path == column)


def _observed(file: Any, player: str) -> tuple[Kind | None, bool, ObservedTexts]:
    """The kind of the observations in a recording, whether it has any, and their texts.

    The kind is that of the first episode, and holds the observations of the others as far as it can. `player` is "", or
    another player than the first human.
    """
    columns = ["kind", "episode", "observationDtype", "observationShape", "other"]
    texts, kind, first = ObservedTexts(), None, None
    for batch in file.iter_batches(batch_size=512, columns=columns):
        for row in batch.to_pylist():
            if row["kind"] not in ("reset", "step"):
                continue
            is_array = not player and row["observationDtype"] is not None
            seen = None if is_array else _seen(row | {"observation": None}, player)
            if seen is None and not is_array:
                continue
            try:
                found = (
                    observations.array_kind(row["observationDtype"], row["observationShape"])
                    if is_array
                    else observations.kind_of(seen)
                )
                kind = found if kind is None else observations.common(kind, found)
            except observations.Unlike:
                if kind is None or first in (None, row["episode"]):
                    return None, True, texts
            first = row["episode"] if first is None else first
            texts.add(seen)
    return kind, kind is not None, texts
