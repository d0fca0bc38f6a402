"""Makes Minari datasets from converted recordings: one per game step, or several if the game changed during the study.

In sessions, each human player has a dataset.

Minari needs an observation for every step. Recordings hold observations if the study has `recordObservations`.
Otherwise, or if Minari has no space for them, the number of the step takes their place, and the dataset's description
says so. Episodes are written one at a
time. Images are stored without loss, not as JPEG, which is Minari's default.

Facts (minari 0.5.4, read in its source): `load_dataset(id)` reads `$MINARI_DATASETS_PATH/{id}/data`; observations and
infos have one entry more than actions; its own collector marks the last step of an unfinished episode as truncated. The
datasets here follow all of them.
"""

# ruff: noqa: PLC0415 - minari imports gymnasium, h5py and pyarrow, which no other module here needs

from __future__ import annotations

import json
import re
import shutil
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from hippodrome.export import observations
from hippodrome.export.observations import Kind
from hippodrome.export.recording import humans_of, players_of
from hippodrome.export.records import Record
from hippodrome.export.values import as_number, as_whole

OF_HUMAN = (
    "Several players played: actions, rewards and observations are those of {player}. An action by none is the "
    "idle action; it was taken also when it was not the human's turn. Episodes end when the human left the game. "
    "infos: players (actions, rewards and more of each player, as JSON). "
)
IN_SESSIONS = (
    "Several people played together: the others' steps of the same games are in other datasets. A policy took "
    "the actions by policy while the participant was away. "
)
OTHER_NUMBERS = "To get the environment's own number of an action, add {start}. "
STEP_NUMBERS = "The observations were not recorded; the number of the step takes their place. "
NO_SPACE = (
    "The observations were recorded, but Minari has no space for them, such as one for lists of different lengths: the "
    "number of the step takes their place. "
)


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


@dataclass
class Texts:
    """The texts in a dataset's observations."""

    characters: set[str] = field(default_factory=set)
    longest: int = 0  # the most characters of a text


@dataclass
class Dataset:
    """A dataset that is being made."""

    spec: Spec
    id: str = ""
    began: str = "~"  # the first episode's time; it orders the datasets of a step
    highest: int = -1  # the highest number of an action
    texts: Texts = field(default_factory=Texts)
    files: list[str] = field(default_factory=list)  # converted recordings
    episodes: int = 0
    steps: int = 0
    left_out: Counter[str] = field(default_factory=Counter)  # episodes, by the reason

    def takes(self, spec: Spec) -> bool:
        """Return whether this is the dataset for recordings of `spec`.

        Numbers that are whole in some recordings and not in others are in one dataset.
        """
        if self.spec.kind is None or spec.kind is None:
            return self.spec == spec
        try:
            kind = observations.common(self.spec.kind, spec.kind)
        except observations.Unlike:
            return False
        if spec._replace(kind=kind) != self.spec._replace(kind=kind):
            return False
        self.spec = self.spec._replace(kind=kind)
        return True


def build(
    folder: Path, records: Iterable[Record], project: str, progress: Callable[[int, int], None]
) -> list[dict[str, Any]]:
    """Make `folder/minari` anew from the converted recordings, and return a summary of each dataset.

    `progress` is called with the number of recordings, and how many of them are done. Raises OSError.
    """
    import minari

    folder = folder.resolve()  # to get a dataset's size, Minari joins a relative path with itself
    datasets = _datasets(folder, records, project)
    part, target = folder / "private" / "minari.part", folder / "minari"
    shutil.rmtree(part, ignore_errors=True)
    done, total = 0, sum(len(dataset.files) for dataset in datasets)
    for dataset in datasets:
        data = part / dataset.id / "data"
        data.mkdir(parents=True)
        storage = _storage(data, dataset, minari.__version__)
        for path in dataset.files:
            _append(storage, folder / path, dataset)
            done += 1
            progress(total, done)
        storage.update_metadata({"dataset_size": float(storage.get_size())})
        if not dataset.episodes:
            shutil.rmtree(part / dataset.id)
    shutil.rmtree(target, ignore_errors=True)
    if part.exists():
        part.rename(target)
    return [
        {
            "id": dataset.id,
            "episodes": dataset.episodes,
            "steps": dataset.steps,
            "observations": dataset.spec.kind is not None,
            "observationsRecorded": dataset.spec.recorded,
            "leftOut": dict(dataset.left_out),
        }
        for dataset in datasets
    ]


def _datasets(folder: Path, records: Iterable[Record], project: str) -> list[Dataset]:
    found: list[Dataset] = []
    for file in (file for record in records for file in record.recordings() if file.episodes):
        first = file.episodes[0]
        for spec, highest, texts in specs(folder / file.path, str(first["step"]), first.get("people")):
            dataset = next((dataset for dataset in found if dataset.takes(spec)), None)
            if dataset is None:
                dataset = Dataset(spec)
                found.append(dataset)
            dataset.files.append(file.path)
            dataset.highest = max(dataset.highest, highest)
            dataset.texts.characters |= texts.characters
            dataset.texts.longest = max(dataset.texts.longest, texts.longest)
            dataset.began = min(dataset.began, str(first["started"]))
    humans: dict[str, set[str]] = {}
    for dataset in found:
        humans.setdefault(dataset.spec.step, set()).add(dataset.spec.human)
    versions: Counter[str] = Counter()
    for dataset in sorted(found, key=lambda dataset: (dataset.spec.step, dataset.began, dataset.spec.human)):
        spec = dataset.spec
        has_player = spec.human and (spec.together or len(humans[spec.step]) > 1)
        name = f"{project}-{spec.step}" + (f"-{_NOT_ALLOWED.sub('_', spec.human)}" if has_player else "")
        dataset.id = f"{name}-v{versions[name]}"
        versions[name] += 1
    return sorted(found, key=lambda dataset: dataset.id)


_NOT_ALLOWED = re.compile("[^A-Za-z0-9_-]")
"""Characters that the name of a dataset may not have (`DATASET_ID_RE` of minari 0.5.4)."""


def _storage(data: Path, dataset: Dataset, version: str) -> Any:
    from gymnasium.spaces import Box, Discrete
    from minari.dataset.minari_storage import MinariStorage

    spec = dataset.spec
    seen = Box(0, np.iinfo(np.int64).max, (1,), np.int64)
    if spec.kind is not None:
        seen = observations.space(spec.kind, "".join(sorted(dataset.texts.characters)), dataset.texts.longest)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        storage = MinariStorage.new(
            data,
            observation_space=seen,
            action_space=Discrete(max(len(spec.actions), dataset.highest + 1, 1)),
            jpeg_encoding=False,
        )
    description = "Recorded by Hippodrome: the actions of people and their results. "
    if spec.kind is None:
        description += NO_SPACE if spec.recorded else STEP_NUMBERS
    description += OTHER_NUMBERS.format(start=spec.start) if spec.start else ""
    player = f"the player {spec.human}" if spec.together else "the first human"
    description += OF_HUMAN.format(player=player) if spec.players else ""
    description += IN_SESSIONS if spec.together else ""
    storage.update_metadata(
        {
            "dataset_id": dataset.id,
            "minari_version": version,
            "description": description + "infos: by (who chose the action), human (the action of the keys; -1: none), "
            "info (the environment's, as JSON), extra (further values that step() returned, as JSON). "
            "Unfinished episodes end as truncated; metadata say why.",
            "action_names": list(spec.actions),
        }
    )
    return storage


def _append(storage: Any, path: Path, dataset: Dataset) -> None:
    """Add a recording's episodes, with their metadata."""
    first, metadata = storage.total_episodes, []
    shared = dataset.spec.together

    def buffers() -> Iterator[Any]:
        for rows, why in read(path, dataset.spec):
            buffer = _buffer(rows, dataset)
            if isinstance(buffer, str):
                dataset.left_out[buffer] += 1
                continue
            dataset.episodes += 1
            dataset.steps += len(buffer.rewards)
            metadata.append(
                {
                    "participant": rows[0]["participant"] or "",
                    **({"session": rows[0]["session"] or "", "player": _clean(dataset.spec.human)} if shared else {}),
                    "attempt": -1 if rows[0]["attempt"] is None else rows[0]["attempt"],
                    "trial": _clean(rows[0]["trial"]),
                    "episode": -1 if rows[0]["episode"] is None else rows[0]["episode"],
                    "why": _clean(why),
                }
            )
            yield buffer

    storage.update_episodes(buffers())
    if metadata:
        storage.update_episode_metadata(metadata, range(first, first + len(metadata)))


def _clean(value: Any) -> str:
    """The value as text for HDF5; "" for None."""
    return observations.as_text(str(value or ""))


_MISSING = "an observation is missing, or not like the others"


def _buffer(rows: list[dict[str, Any]], dataset: Dataset) -> Any:
    """An episode as Minari's EpisodeBuffer; if it cannot be one, a text that says why."""
    from minari.data_collector import EpisodeBuffer

    spec = dataset.spec
    rows = until_end_of(rows, spec.human) if spec.human else rows
    first = rows[0] if rows[0]["kind"] == "reset" else None
    steps = rows[1:] if first else rows
    if any(row["action"] is None or row["action"] < 0 for row in steps):
        return "an action that is no number from 0 on"
    if any(row["reward"] is None for row in steps):
        return "a reward that is no number"
    if spec.kind is None:
        seen: Any = np.arange(len(steps) + 1, dtype=np.int64).reshape(-1, 1)
    elif first is None:
        return _MISSING
    else:
        try:
            seen = observations.together(spec.kind, [row["seen"] for row in rows])
        except observations.Unlike:
            return _MISSING
    terminations = [bool(row["terminated"]) for row in steps]
    truncations = [bool(row["truncated"]) for row in steps]
    truncations[-1] = truncations[-1] or not terminations[-1]
    all_rows: list[dict[str, Any]] = [first or {}, *steps]
    return EpisodeBuffer(
        seed=first["seed"] if first else None,
        observations=seen,
        actions=np.array([row["action"] for row in steps], np.int64),
        rewards=np.array([row["reward"] for row in steps], np.float64),
        terminations=np.array(terminations),
        truncations=np.array(truncations),
        infos={
            "by": [_clean(row.get("by")) for row in all_rows],
            "human": np.array([-1 if row.get("human") is None else row["human"] for row in all_rows], np.int64),
            "info": [_clean(row.get("info")) for row in all_rows],
            **_other_field(all_rows, "extra"),
            **(_other_field(all_rows, "players") if spec.players else {}),
        },
    )


def _other_field(rows: list[dict[str, Any]], name: str) -> dict[str, list[str]]:
    """A field that has no column, as JSON for each row; {} if no row has this field."""
    values = [json.loads(row.get("other") or "{}").get(name) for row in rows]
    if all(value is None for value in values):
        return {}
    return {name: ["" if value is None else _clean(json.dumps(value)) for value in values]}


# Reading converted recordings


def specs(path: Path, step: str, people: Mapping[str, str | None] | None) -> Iterator[tuple[Spec, int, Texts]]:
    """Yield the properties of a converted recording for each human, the highest number of an action, and the texts.

    In a session, `people` has the participants' numbers by player; a player whose participant was erased is left out.
    """
    import pyarrow.parquet as pq

    if people and not any(people.values()):
        return  # all participants were erased
    with pq.ParquetFile(path) as file:
        header = _header(file)
        players, humans = players_of(header), humans_of(header)
        starts = header.get("actionStart") or {}
        chosen = humans[:1] or ("",)
        if people is not None:
            chosen = tuple(human for human in humans if people.get(human)) or humans
        for human in chosen:
            own = header["players"][human].get("actionSpace") if people is not None else None
            names = own if isinstance(own, list) else header.get("actionSpace")
            actions = tuple(map(str, names)) if isinstance(names, list) else ()
            kind, recorded, texts = _observed(file, "" if human in humans[:1] else human)
            start = starts.get(human or "player_0", 0)
            spec = Spec(step, actions, kind, recorded, players, human, together=people is not None, start=start)
            yield spec, _highest(file, "action" if people is None else f"action.{human}"), texts


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
            for row in batch.to_pylist():
                row["seen"] = _seen(row, "")
                if row["kind"] == "end" and rows and row["episode"] == rows[0]["episode"]:
                    why = row["why"] or why
                if row["kind"] not in ("reset", "step"):
                    continue
                if spec.together:
                    row["participant"] = row[participant]
                    row.update(_as_of(row, spec.human, header) if spec.human != humans[0] else {})
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


def _observed(file: Any, player: str) -> tuple[Kind | None, bool, Texts]:
    """The kind of the observations in a recording, whether it has any, and their texts.

    The kind is that of the first episode, and holds the observations of the others as far as it can. `player` is "", or
    another player than the first human.
    """
    columns = ["kind", "episode", "observationDtype", "observationShape", "other"]
    texts, kind, first = Texts(), None, None
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
            for text in observations.texts_in(seen):
                texts.characters.update(text)
                texts.longest = max(texts.longest, len(text))
    return kind, kind is not None, texts
