"""Studies with participants, answers and real recordings, on a folder or in a bucket on moto."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from hippodrome.control.model import ids
from hippodrome.control.model.project import MASTER_LIST, MasterList
from hippodrome.control.model.records import to_json
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.recording import Recording
from testing.studies import study

PROJECT = study()
Put = Callable[[str, bytes], None]
PAGES = {step.key: (step.files or [step.page])[-1] for step in PROJECT.steps}
TIME = "2026-11-21T14:46:40.123456Z"


def into_folder(root: Path) -> Put:
    def put(key: str, body: bytes) -> None:
        path = root / key
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(body)

    return put


def register(put: Put) -> None:
    put(MASTER_LIST, to_json(MasterList([PROJECT])))


def key(user: str, rest: str) -> str:
    return f"{PROJECT.id}/users/{user}/{rest}"


def participant(user: str, **changes: Any) -> dict[str, Any]:
    return {
        "projectId": PROJECT.id,
        "userId": user,
        "arrived": TIME,
        "group": 1,
        "completionCode": ids.completion_code(PROJECT.secret, user),
        "link": {"PROLIFIC_PID": f"prolific-of-{user}", "STUDY_ID": "study-77"},
        "headers": {"user-agent": "Firefox on a phone"},
        **changes,
    }


def answer(step: str, answers: Any, **changes: Any) -> dict[str, Any]:
    return {
        "step": step,
        "page": PAGES.get(step, f"page-{step}"),
        "group": 1,
        "answered": TIME,
        "answers": answers,
        "schema": 1,
        **changes,
    }


def arrive(put: Put, user: str, answers: Mapping[str, Any], **changes: Any) -> None:
    put(key(user, "participant.json"), json.dumps(participant(user, **changes)).encode())
    for step, given in answers.items():
        put(key(user, f"answers/{step}.json"), json.dumps(answer(step, given)).encode())


GAME = {"episodes": 1, "score": 12.5, "frames": 5, "seconds": 0.5, "trial": "t-1", "outcome": "finished"}


def server(user: str, attempt: int = 1) -> str:
    return ids.server_name(ids.server_label(PROJECT.id, user), attempt)


_numbers = itertools.count()


def record(
    folder: Path,
    user: str,
    *,
    episodes: int = 1,
    frames: int = 5,
    observe: bool = False,
    attempt: int = 1,
    step: str = "3",
    close: bool = True,
    picture: Callable[[int], np.ndarray] | None = None,
    callbacks: Sequence[Mapping[str, Any]] = (),
    head: Mapping[str, Any] = MappingProxyType({}),
    **more: Any,
) -> bytes:
    """Make a recording by the trial's own code, and return its bytes."""
    path = folder / f"{next(_numbers)}.gz"
    made = Recording(path, "unused")
    stamp = {"v": recording.SCHEMA, "server": server(user, attempt), "trial": "t-1"}
    clock: Iterator[int] = itertools.count(1)
    look = picture or (lambda number: np.array([number % 256, 7], np.uint8))

    def line(kind: str, **fields: Any) -> None:
        number = next(clock)
        made.add(recording.line(kind, **stamp, time=f"2026-11-21T14:46:40.{number:06d}Z", ns=number, **fields))

    line(
        "header", project=PROJECT.id, userId=user, step=step, game="grid",
        actionSpace=["noop", "up", "down"], frameRate=30, episode=1, seed=5, versions=recording.versions(),
        **head,
    )  # fmt: skip
    for episode in range(1, episodes + 1):
        seen = {"observation": recording.observation(look(0))} if observe else {}
        line("reset", episode=episode, seed=40 + episode, info={"start": np.int64(3)}, **seen)
        for number in range(1, frames + 1):
            seen = {"observation": recording.observation(look(number))} if observe else {}
            line(
                "step", episode=episode, step=number, frame=number, human=number % 3, action=number % 3,
                actionName="up", by="human", reward=0.5 * number, terminated=number == frames, truncated=False,
                info={"t": np.int64(number), "nan": float("nan")}, **seen, **more,
            )  # fmt: skip
        line("end", episode=episode, steps=frames, score=1.0, why="terminated", messages=[])
        for each in callbacks:
            line("callback", episode=episode, step=frames, **each)
    if close:
        made.close()
    else:
        made.flush()
    return path.read_bytes()


def recording_key(user: str, name: str = "3-episode-0001", attempt: int = 1) -> str:
    return key(user, f"trials/{server(user, attempt)}/{name}.jsonl.gz")


def crowd(put: Put, work: Path, people: int = 3, **how: Any) -> list[str]:
    """Put the data of a small study. All participants have finished except the last, who has not played.

    Return their ids.
    """
    register(put)
    users = [f"user-{number:04d}" for number in range(people)]
    for number, user in enumerate(users):
        done = {"1": {"consent": "yes"}, "2": {"age": str(20 + number), "pet": ["cat", "dog"]}}
        if number < people - 1 or people == 1:
            done |= {"3": GAME, "4": {"words": "fine, thank you"}}
            put(recording_key(user), record(work, user, **how))
        arrive(put, user, done)
    return users
