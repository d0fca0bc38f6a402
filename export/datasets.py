"""From converted recordings to Minari datasets: one per game step, or several where the game changed on the way.

In sessions, one for each human player.

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
import re
import shutil
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from export import episodes
from export.episodes import Spec
from export.state import ExportState

OF_HUMAN = (
    "Several players played: actions, rewards and observations are those of {who}. An action by none is the "
    "idle one, also where it was not the human's turn. Episodes end where the human left the game. "
    "infos: players (what each did and got, as JSON). "
)
IN_SESSIONS = (
    "Several people played together: the others' steps of the same games are in datasets of their own. A policy took "
    "actions by policy while the participant was away. "
)
STEP_NUMBERS = "The observations were not recorded; in their place stands the number of the step."


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


def build(folder: Path, state: ExportState, project: str, progress: Callable[[int, int], None]) -> list[dict[str, Any]]:
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


def _datasets(folder: Path, state: ExportState, project: str) -> list[Dataset]:
    found: dict[Spec, Dataset] = {}
    for path, several in groupby(state.episodes(), lambda row: row[1]):
        first = next(several)[2]
        for spec, highest in episodes.look(folder / path, str(first["step"]), first.get("people")):
            dataset = found.setdefault(spec, Dataset(spec))
            dataset.files.append(path)
            dataset.highest = max(dataset.highest, highest)
            dataset.began = min(dataset.began, str(first["started"]))
    humans: dict[str, set[str]] = {}
    for spec in found:
        humans.setdefault(spec.step, set()).add(spec.human)
    versions: Counter[str] = Counter()
    for dataset in sorted(found.values(), key=lambda dataset: (dataset.spec.step, dataset.began, dataset.spec.human)):
        spec = dataset.spec
        named = spec.human and (spec.together or len(humans[spec.step]) > 1)
        name = f"{project}-{spec.step}" + (f"-{_NO_NAME.sub('_', spec.human)}" if named else "")
        dataset.id = f"{name}-v{versions[name]}"
        versions[name] += 1
    return sorted(found.values(), key=lambda dataset: dataset.id)


_NO_NAME = re.compile("[^A-Za-z0-9_-]")
"""What the name of a dataset may not have (`DATASET_ID_RE` of minari 0.5.4)."""


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
    who = f"the player {spec.human}" if spec.together else "the first human"
    description += OF_HUMAN.format(who=who) if spec.players else ""
    description += IN_SESSIONS if spec.together else ""
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
    shared = dataset.spec.together

    def buffers() -> Iterator[Any]:
        for rows, why in episodes.read(path, dataset.spec):
            made = _buffer(rows, dataset)
            if isinstance(made, str):
                dataset.left_out[made] += 1
                continue
            dataset.episodes += 1
            dataset.steps += len(made.rewards)
            abouts.append(
                {
                    "participant": rows[0]["participant"] or "",
                    **({"session": rows[0]["session"] or "", "player": _clean(dataset.spec.human)} if shared else {}),
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


def _clean(text: str) -> str:
    return text.replace("\0", "")


def _buffer(rows: list[dict[str, Any]], dataset: Dataset) -> Any:
    """An episode as Minari takes it; else a sentence that says why not."""
    import numpy as np
    from minari.data_collector import EpisodeBuffer

    spec = dataset.spec
    rows = episodes.own(rows, spec.human) if spec.human else rows
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


def _more(rows: list[dict[str, Any]], name: str) -> dict[str, list[str]]:
    """A field without a column, as JSON, if a line of this episode has it."""
    kept = [json.loads(row.get("other") or "{}").get(name) for row in rows]
    if all(value is None for value in kept):
        return {}
    return {name: ["" if value is None else json.dumps(value).replace("\0", "") for value in kept]}
