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
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import groupby
from pathlib import Path
from typing import Any

from hippodrome.export import episodes, observations
from hippodrome.export.episodes import Spec
from hippodrome.export.state import ExportState

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


@dataclass
class Dataset:
    """A dataset that is being made."""

    spec: Spec
    id: str = ""
    began: str = "~"  # the first episode's time; it orders the datasets of a step
    highest: int = -1  # the highest number of an action
    characters: set[str] = field(default_factory=set)  # of texts in observations
    longest: int = 0  # the most characters of such a text
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


def build(folder: Path, state: ExportState, project: str, progress: Callable[[int, int], None]) -> list[dict[str, Any]]:
    """Make `folder/minari` anew from the converted recordings, and return a summary of each dataset.

    `progress` is called with the number of recordings, and how many of them are done. Raises OSError.
    """
    import minari

    folder = folder.resolve()  # to get a dataset's size, Minari joins a relative path with itself
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
            "observations": dataset.spec.kind is not None,
            "observationsRecorded": dataset.spec.recorded,
            "leftOut": dict(dataset.left_out),
        }
        for dataset in datasets
    ]


def _datasets(folder: Path, state: ExportState, project: str) -> list[Dataset]:
    found: list[Dataset] = []
    for path, several in groupby(state.episodes(), lambda row: row[1]):
        first = next(several)[2]
        for spec, highest, texts in episodes.specs(folder / path, str(first["step"]), first.get("people")):
            dataset = next((dataset for dataset in found if dataset.takes(spec)), None)
            if dataset is None:
                dataset = Dataset(spec)
                found.append(dataset)
            dataset.files.append(path)
            dataset.highest = max(dataset.highest, highest)
            dataset.characters |= texts.characters
            dataset.longest = max(dataset.longest, texts.longest)
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
    import numpy as np
    from gymnasium.spaces import Box, Discrete
    from minari.dataset.minari_storage import MinariStorage

    spec = dataset.spec
    seen = Box(0, np.iinfo(np.int64).max, (1,), np.int64)
    if spec.kind is not None:
        seen = observations.space(spec.kind, "".join(sorted(dataset.characters)), dataset.longest)
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
        for rows, why in episodes.read(path, dataset.spec):
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
    import numpy as np
    from minari.data_collector import EpisodeBuffer

    spec = dataset.spec
    rows = episodes.until_end_of(rows, spec.human) if spec.human else rows
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
