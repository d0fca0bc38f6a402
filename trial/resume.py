"""What earlier servers of the participant recorded of a step, so that a game that was cut off goes on where it was.

A server that Spot takes back, or that is lost, is followed by another one. If the environment plays the same way again
(the same seed and the same actions give the same rewards), the episode that was on is played again, unseen and as fast
as it can be, up to its last recorded step; else it begins again. Episodes that were over count as they did.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from itertools import count
from typing import Any

from trial import recording
from trial.messages import FEEDBACK
from trial.progress import Episode
from trial.store import Store

_ATTEMPT = re.compile(r"(.+)-([0-9]{1,3})")


@dataclass(frozen=True, slots=True)
class RecordedStep:
    """One step: the human's choice (None: no key acted), what came of it, and words for the agent before it."""

    human: int | None
    action: int | None
    reward: float
    feedback: tuple[str, ...] = ()


@dataclass(slots=True)
class UnfinishedEpisode:
    """An episode that was cut off. `seed` is None if the environment took none: it cannot be played again then."""

    number: int
    seed: int | None
    steps: list[RecordedStep] = field(default_factory=list)
    unheard: list[str] = field(default_factory=list)
    """Feedback that came after the last step; the server ended before the agent heard it."""

    @property
    def score(self) -> float:
        return sum(step.reward for step in self.steps)


@dataclass(slots=True)
class RecordedTrial:
    """All that was recorded: episodes that are over, perhaps one that was cut off, and the seconds they took."""

    ended: list[Episode] = field(default_factory=list)
    unfinished: UnfinishedEpisode | None = None
    seconds: float = 0.0


def load_recorded(store: Store, folder: str, server: str, step: str) -> RecordedTrial | None:
    """The past of a step, from the recordings of the servers before this one; None if there is none.

    `folder` is where the participant's recordings lie, `server` this one's name, which ends in the number of its
    attempt. Blocks; raises the store's errors.
    """
    named = _ATTEMPT.fullmatch(server)
    if named is None:
        return None
    past = RecordedTrial()
    found = False
    for attempt in range(1, int(named[2])):
        for lines in _recordings(store, f"{folder}/{named[1]}-{attempt}/{step}", past):
            found = True
            add_lines(past, lines)
    return past if found else None


def _recordings(store: Store, prefix: str, past: RecordedTrial) -> Iterable[list[dict[str, Any]]]:
    """One server's recordings of the step, in order, whichever way it named them."""
    whole = store.get(f"{prefix}-trial.jsonl.gz")
    if whole is not None:
        yield recording.read(whole)
        return
    first = past.unfinished.number if past.unfinished else len(past.ended) + 1
    for number in count(first):
        body = store.get(f"{prefix}-episode-{number:04d}.jsonl.gz")
        if body is None:
            return
        yield recording.read(body)


def add_lines(past: RecordedTrial, lines: Iterable[Mapping[str, Any]]) -> None:
    """Let a recording's lines happen to what is known. Lines of other kinds, or that make no sense, change nothing."""
    rate = 30.0
    for line in lines:
        with contextlib.suppress(KeyError, TypeError, ValueError):
            if line["kind"] == "header":
                rate = float(line["frameRate"]) or rate
            else:
                _happen(past, line, rate)


def _happen(past: RecordedTrial, line: Mapping[str, Any], rate: float) -> None:
    kind, number, current = line["kind"], int(line["episode"]), past.unfinished
    if kind == "reset":
        past.unfinished = UnfinishedEpisode(number, line["seed"])
    elif kind == "break":
        if line["why"] == "stop" and past.ended and past.ended[-1].number == number:
            past.ended[-1] = replace(past.ended[-1], why="stopped")  # the trial ended in the break after it
    elif current is None or number != current.number:
        return
    elif kind == "resume":
        del current.steps[max(0, int(line["steps"])) :]
    elif kind == "step":
        words = tuple(_feedback(line))
        current.steps.append(RecordedStep(line["human"], line["action"], float(line["reward"] or 0.0), words))
        current.unheard = []
        past.seconds += 1.0 / rate
        if line.get("terminated") or line.get("truncated"):  # over, even if its `end` was not written any more
            _end(past, current, "terminated" if line.get("terminated") else "truncated")
    elif kind == "end" and line["why"] == "shutdown":
        current.unheard = _feedback(line)
    elif kind == "end":
        _end(past, current, str(line["why"]))


def _end(past: RecordedTrial, episode: UnfinishedEpisode, why: str) -> None:
    past.ended.append(Episode(episode.number, len(episode.steps), episode.score, why))
    past.unfinished = None


def _feedback(line: Mapping[str, Any]) -> list[str]:
    return [message["command"] for message in line.get("messages", ()) if message.get("command") in FEEDBACK]
