"""From converted recordings to Minari datasets: one per game step, or several where the game changed on the way.

Minari wants an observation for every step. Recordings hold them if the study said `recordObservations`; where they do
not, the number of the step stands in their place, and the dataset's description says so. Episodes are written one at a
time. Images are kept exactly: Minari would write them as JPEG, which loses something.

Facts (minari 0.5.4, read in its source): `load_dataset(id)` reads `$MINARI_DATASETS_PATH/{id}/data`; observations and
infos have one entry more than actions; its own collector marks the last step of an episode that was broken off as
truncated. All of that is done here too.
"""

# ruff: noqa: PLC0415 - minari brings gymnasium, h5py and pyarrow, which nothing else here needs

from __future__ import annotations

import json
import shutil
import warnings
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any, NamedTuple

from export.recording import players_of
from export.state import State

OF_HUMAN = (
    "Several players played: actions, rewards and observations are those of the first human. An action by none is the "
    "idle one, also where it was not the human's turn. Episodes end where the human left the game. "
    "infos: players (what each did and got, as JSON). "
)
STEP_NUMBERS = "The observations were not recorded; in their place stands the number of the step."


class Spec(NamedTuple):
    """What must be the same for two recordings to stand in one dataset."""

    step: str
    actions: tuple[str, ...]
    dtype: str  # of the observations; "" where there are none
    shape: tuple[int, ...]
    players: tuple[str, ...] = ()  # if several play
    human: str = ""  # the first of them


@dataclass
class Dataset:
    """A dataset in the making."""

    spec: Spec
    id: str = ""
    began: str = "~"  # the first episode's time, for the order
    highest: int = -1  # action
    files: list[str] = field(default_factory=list)
    episodes: int = 0
    steps: int = 0
    left_out: Counter[str] = field(default_factory=Counter)


def build(folder: Path, state: State, project: str, progress: Callable[[int, int], None]) -> list[dict[str, Any]]:
    """Make `folder/minari` anew from the converted recordings; what there is now. Raises OSError."""
    import minari

    folder = folder.resolve()  # Minari joins a relative path to itself when it asks for a dataset's size
    datasets = _datasets(folder, state, project)
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
            "observations": bool(dataset.spec.dtype),
            "leftOut": dict(dataset.left_out),
        }
        for dataset in datasets
    ]


def _datasets(folder: Path, state: State, project: str) -> list[Dataset]:
    found: dict[Spec, Dataset] = {}
    for path, several in groupby(state.episodes(), lambda row: row[1]):
        first = next(several)[2]
        spec, highest = _look(folder / path, str(first["step"]))
        dataset = found.setdefault(spec, Dataset(spec))
        dataset.files.append(path)
        dataset.highest = max(dataset.highest, highest)
        dataset.began = min(dataset.began, str(first["started"]))
    versions: Counter[str] = Counter()
    for dataset in sorted(found.values(), key=lambda dataset: (dataset.spec.step, dataset.began)):
        dataset.id = f"{project}-{dataset.spec.step}-v{versions[dataset.spec.step]}"
        versions[dataset.spec.step] += 1
    return sorted(found.values(), key=lambda dataset: dataset.id)


def _look(path: Path, step: str) -> tuple[Spec, int]:
    """What a converted recording is like, and its highest action, without reading it all."""
    import pyarrow.parquet as pq

    with pq.ParquetFile(path) as file:
        header = json.loads((file.metadata.metadata or {}).get(b"hippodrome", b"{}")).get("header", {})
        names = header.get("actionSpace")
        actions = tuple(map(str, names)) if isinstance(names, list) else ()
        players = players_of(header)
        human = _first_human(header) if players else ""
        column = file.schema_arrow.get_field_index("action")
        highest = -1
        for number in range(file.metadata.num_row_groups):
            statistics = file.metadata.row_group(number).column(column).statistics
            if statistics is not None and statistics.has_min_max:
                highest = max(highest, int(statistics.max))
        for batch in file.iter_batches(batch_size=256, columns=["observationDtype", "observationShape"]):
            for row in batch.to_pylist():
                if row["observationDtype"] is not None:
                    shape = tuple(row["observationShape"])
                    return Spec(step, actions, row["observationDtype"], shape, players, human), highest
            break
    return Spec(step, actions, "", (), players, human), highest


def _first_human(header: Mapping[str, Any]) -> str:
    kinds = header.get("players") or {}
    return next(
        (str(name) for name, said in kinds.items() if isinstance(said, dict) and said.get("kind") == "human"), ""
    )


def _storage(data: Path, dataset: Dataset, version: str) -> Any:
    import numpy as np
    from gymnasium.spaces import Box, Discrete
    from minari.dataset.minari_storage import MinariStorage

    spec = dataset.spec
    observations: Any
    if not spec.dtype:
        observations = Box(0, np.iinfo(np.int64).max, (1,), np.int64)
    elif spec.dtype == "bool":
        observations = Box(0, 1, spec.shape, np.uint8)
    elif spec.dtype.startswith("float"):
        observations = Box(-np.inf, np.inf, spec.shape, np.dtype(spec.dtype).type)
    else:
        limits = np.iinfo(spec.dtype)
        observations = Box(int(limits.min), int(limits.max), spec.shape, np.dtype(spec.dtype).type)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        storage = MinariStorage.new(
            data,
            observation_space=observations,
            action_space=Discrete(max(len(spec.actions), dataset.highest + 1, 1)),
            jpeg_encoding=False,
        )
    description = "Recorded by Hippodrome: what people did, and what came of it. " + (
        "" if spec.dtype else STEP_NUMBERS + " "
    )
    description += OF_HUMAN if spec.players else ""
    storage.update_metadata(
        {
            "dataset_id": dataset.id,
            "minari_version": version,
            "description": description
            + "infos: by (who chose the action), human (what the keys asked for; -1: nothing), "
            "info (the environment's, as JSON), extra (what else step() returned, as JSON). "
            "Episodes that were broken off end as truncated; metadata say why.",
            "action_names": list(spec.actions),
        }
    )
    return storage


def _append(storage: Any, path: Path, dataset: Dataset) -> None:
    """Add a recording's episodes."""
    first, abouts = storage.total_episodes, []

    def buffers() -> Iterator[Any]:
        for rows, why in _episodes(path):
            made = _buffer(rows, dataset)
            if isinstance(made, str):
                dataset.left_out[made] += 1
                continue
            dataset.episodes += 1
            dataset.steps += len(made.rewards)
            abouts.append(
                {
                    "participant": rows[0]["participant"] or "",
                    "attempt": -1 if rows[0]["attempt"] is None else rows[0]["attempt"],
                    "trial": (rows[0]["trial"] or "").replace("\0", ""),
                    "episode": -1 if rows[0]["episode"] is None else rows[0]["episode"],
                    "why": why.replace("\0", ""),
                }
            )
            yield made

    storage.update_episodes(buffers())
    if abouts:
        storage.update_episode_metadata(abouts, range(first, first + len(abouts)))


def _episodes(path: Path) -> Iterator[tuple[list[dict[str, Any]], str]]:
    """A recording's rows of `reset` and `step`, cut where an episode begins, and why each ended.

    Episodes that end before the first step are left out.
    """
    import pyarrow.parquet as pq

    columns = ["participant", "attempt", "trial", "kind", "episode", "step", "time", "action", "by", "human"]
    columns += ["reward", "terminated", "truncated", "info", "seed", "observation", "observationDtype"]
    columns += ["observationShape", "why", "other"]
    rows: list[dict[str, Any]] = []
    why = "cut off"
    with pq.ParquetFile(path) as file:
        for batch in file.iter_batches(batch_size=512, columns=columns):
            for row in batch.to_pylist():
                if row["kind"] == "end" and rows and row["episode"] == rows[0]["episode"]:
                    why = row["why"] or why
                if row["kind"] not in ("reset", "step"):
                    continue
                if rows and (row["kind"] == "reset" or row["episode"] != rows[0]["episode"]):
                    if rows[-1]["kind"] == "step":
                        yield rows, why
                    rows, why = [], "cut off"
                rows.append(row)
    if rows and rows[-1]["kind"] == "step":
        yield rows, why


def _buffer(rows: list[dict[str, Any]], dataset: Dataset) -> Any:
    """An episode as Minari takes it; else a sentence that says why not."""
    import numpy as np
    from minari.data_collector import EpisodeBuffer

    spec = dataset.spec
    rows = _own(rows, spec.human) if spec.human else rows
    first = rows[0] if rows[0]["kind"] == "reset" else None
    steps = rows[1:] if first else rows
    if any(row["action"] is None or row["action"] < 0 for row in steps):
        return "an action that is no number from 0 on"
    if any(row["reward"] is None for row in steps):
        return "a reward that is no number"
    if spec.dtype:
        if first is None or any(
            row["observation"] is None
            or row["observationDtype"] != spec.dtype
            or tuple(row["observationShape"]) != spec.shape
            for row in rows
        ):
            return "an observation is missing, or not like the others"
        dtype = np.dtype("uint8" if spec.dtype == "bool" else spec.dtype)
        observations = np.empty((len(rows), *spec.shape), dtype)
        for place, row in enumerate(rows):
            observations[place] = np.frombuffer(row["observation"], dtype).reshape(spec.shape)
    else:
        observations = np.arange(len(steps) + 1, dtype=np.int64).reshape(-1, 1)
    terminations = [bool(row["terminated"]) for row in steps]
    truncations = [bool(row["truncated"]) for row in steps]
    truncations[-1] = truncations[-1] or not terminations[-1]
    told: list[dict[str, Any]] = [first or {}, *steps]
    return EpisodeBuffer(
        seed=first["seed"] if first else None,
        observations=observations,
        actions=np.array([row["action"] for row in steps], np.int64),
        rewards=np.array([row["reward"] for row in steps], np.float64),
        terminations=np.array(terminations),
        truncations=np.array(truncations),
        infos={
            "by": [str(row.get("by") or "").replace("\0", "") for row in told],
            "human": np.array([-1 if row.get("human") is None else row["human"] for row in told], np.int64),
            "info": [str(row.get("info") or "").replace("\0", "") for row in told],
            **_more(told, "extra"),
            **(_more(told, "players") if spec.players else {}),
        },
    )


def _own(rows: list[dict[str, Any]], human: str) -> list[dict[str, Any]]:
    """The rows up to the human's own end, after which the others may play on."""
    for place, row in enumerate(rows):
        players = json.loads(row.get("other") or "{}").get("players")
        part = players.get(human) if isinstance(players, dict) else None
        if row["kind"] == "step" and isinstance(part, dict) and (part.get("terminated") or part.get("truncated")):
            ends = {name: bool(part.get(name)) for name in ("terminated", "truncated")}
            return [*rows[:place], row | ends]
    return rows


def _more(rows: list[dict[str, Any]], name: str) -> dict[str, list[str]]:
    """A field without a column, as JSON, if a line of this episode has it."""
    kept = [json.loads(row.get("other") or "{}").get(name) for row in rows]
    if all(value is None for value in kept):
        return {}
    return {name: ["" if value is None else json.dumps(value).replace("\0", "") for value in kept]}
