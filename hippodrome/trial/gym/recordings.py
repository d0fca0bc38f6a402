"""Records environments in the form of a study's recordings, and under the same keys, for `data` (docs/data.md).

The project's id is `gym`. Each connection stands for a participant, each environment for a server, and the id of the
environment for the step: `gym/users/{connection}/trials/{environment}/{id}-trial.jsonl.gz`.
"""

from __future__ import annotations

import re
import time
import uuid
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from hippodrome.protocol.keys import recordings_folder
from hippodrome.trial.agent import environments
from hippodrome.trial.gym.forms import EnvironmentFailed
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.recording import Recording

PROJECT = "gym"
FLUSH_SECONDS = 1.0
"""The seconds between two writes to the disk. If the process is killed, the steps since the last write are lost."""


class ConnectionRecorder:
    """Writes the recordings of one connection into a folder."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        began = datetime.now(UTC).strftime("%Y%m%dT%H%M%S")
        self._user = f"{began}-{uuid.uuid4().hex[:12]}"

    def record(self, env: Any, env_id: str, seed: int | None) -> Recorded:
        """Begin a recording of the environment, and wrap it. Raises EnvironmentFailed if the file cannot be written."""
        server = uuid.uuid4().hex
        step = re.sub("[^A-Za-z0-9_-]", "-", env_id)[:64] or "environment"
        key = f"{recordings_folder(PROJECT, self._user)}{server}/{step}-trial.jsonl.gz"
        try:
            file = Recording(self._folder / key, key)
        except OSError as error:
            raise _not_written(error) from error
        recorded = Recorded(env, file, {"v": recording.SCHEMA, "server": server, "trial": server})
        count, first = environments.count_of(env.action_space), environments.first_number(env.action_space)
        recorded.write(
            "header",
            project=PROJECT,
            userId=self._user,
            step=step,
            game=env_id,
            actionSpace=[str(first + at) for at in range(count or 0)],
            seed=seed,
            versions=recording.versions(),
        )
        return recorded


class Recorded:
    """Wraps an environment, and writes its steps into a recording. It has all attributes of the environment."""

    def __init__(self, env: Any, file: Recording, stamp: dict[str, Any]) -> None:
        self.env = env
        self._file = file
        self._stamp = stamp
        self._flushed = time.monotonic()
        self._episode = 0
        self._steps = 0
        self._score = 0.0
        self._open = False  # whether an episode has begun and has not ended

    def __getattr__(self, name: str) -> Any:
        return getattr(self.env, name)

    def reset(self, **named: Any) -> Any:
        """Reset the environment, and record the reset."""
        result = self.env.reset(**named)
        if self._open:
            self._end("reset")
        self._episode, self._steps, self._score, self._open = self._episode + 1, 0, 0.0, True
        first, info = result if isinstance(result, tuple) and len(result) == 2 else (result, {})
        self.write(
            "reset",
            episode=self._episode,
            seed=named.get("seed"),
            info=recording.plain(info),
            observation=recording.observation(first),
        )
        return result

    def step(self, action: Any) -> Any:
        """Take a step of the environment. Record the step, and the end of the episode."""
        results = self.env.step(action)
        if not isinstance(results, tuple | list) or len(results) not in (4, 5):
            return results  # `Instance` refuses it
        observation, reward, *ends, info = results
        terminated, truncated = (ends[0], ends[1]) if len(ends) == 2 else (ends[0], False)
        number = float(reward.item() if isinstance(reward, np.ndarray) else reward)
        self._steps += 1
        self._score += number
        plain_action = recording.plain(action)
        self.write(
            "step",
            episode=self._episode,
            step=self._steps,
            action=plain_action,
            actionName=str(plain_action),
            by="agent",
            human=None,
            reward=number,
            terminated=bool(terminated),
            truncated=bool(truncated),
            info=info,
            observation=recording.observation(observation),
        )
        if (terminated or truncated) and self._open:
            self._end("terminated" if terminated else "truncated")
        return results

    def close(self) -> None:
        """Close the environment and the recording."""
        try:
            if self._open:
                self._end("closed")
            self._file.close()
        except OSError as error:
            raise _not_written(error) from error
        finally:
            self.env.close()

    def write(self, kind: str, **fields: Any) -> None:
        """Write a line of the recording. Raises EnvironmentFailed if the file cannot be written."""
        now = datetime.now(UTC)
        self._file.add(recording.line(kind, **self._stamp, time=now, ns=time.monotonic_ns(), **fields))
        if time.monotonic() >= self._flushed + FLUSH_SECONDS or kind == "header":
            self._flushed = time.monotonic()
            try:
                self._file.flush()
            except OSError as error:
                raise _not_written(error) from error

    def _end(self, why: str) -> None:
        self._open = False
        self.write("end", episode=self._episode, steps=self._steps, score=self._score, why=why)


def _not_written(error: OSError) -> EnvironmentFailed:
    return EnvironmentFailed(f"The recording cannot be written: {error.strerror}.")
