"""Reads what earlier servers have recorded of a game step, so that an interrupted game goes on where it was.

Another server replaces a lost one, such as one that Spot took back. If the environment is deterministic (the same seed
and actions give the same rewards), the interrupted episode is replayed up to its last recorded step, without frames and
pauses; otherwise it begins again. Episodes that were over count as before.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterable, Mapping
from dataclasses import replace
from itertools import count
from typing import Any

from hippodrome.trial.core.history import (
    PARTNER_LEFT,
    Episode,
    RecordedAction,
    RecordedStep,
    RecordedTrial,
    UnfinishedEpisode,
    Word,
)
from hippodrome.trial.core.messages import is_feedback
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.store import Store

_ATTEMPT = re.compile(r"(.+)-([0-9]{1,3})")


def load_recorded(store: Store, folder: str, server: str, step: str) -> RecordedTrial | None:
    """Read the recordings that the servers before this one have made of a step; None if there are none.

    `folder` has the recordings of the participant or session. `server` is this server's name, which ends in the number
    of its attempt. Blocks; raises the store's errors.
    """
    recorded = RecordedTrial()
    found = False
    for name in earlier_servers(server):
        for lines in _recordings(store, f"{folder}/{name}/{step}", recorded):
            found = True
            add_lines(recorded, lines)
    return recorded if found else None


def earlier_servers(server: str) -> list[str]:
    """Return the names of the servers before this one, whose name ends in the number of its attempt."""
    match = _ATTEMPT.fullmatch(server)
    return [] if match is None else [f"{match[1]}-{attempt}" for attempt in range(1, int(match[2]))]


def _recordings(store: Store, prefix: str, recorded: RecordedTrial) -> Iterable[list[dict[str, Any]]]:
    """Yield the lines of one server's recordings of the step, in order: one file, or one for each episode."""
    whole = store.get(f"{prefix}-trial.jsonl.gz")
    if whole is not None:
        yield recording.read(whole)
        return
    first = recorded.unfinished.number if recorded.unfinished else len(recorded.ended) + 1
    for number in count(first):
        body = store.get(f"{prefix}-episode-{number:04d}.jsonl.gz")
        if body is None:
            return
        yield recording.read(body)


def add_lines(recorded: RecordedTrial, lines: Iterable[Mapping[str, Any]]) -> None:
    """Add the lines of a recording to `recorded`. Lines of unknown kinds and malformed lines are ignored."""
    rate = 30.0
    last: int | None = None
    for line in lines:
        with contextlib.suppress(AttributeError, KeyError, TypeError, ValueError):
            if line["kind"] == "header":
                rate = float(line["frameRate"]) or rate
            else:
                seconds = _seconds(line, last) if line["kind"] == "step" else None
                _add_line(recorded, line, 1.0 / rate if seconds is None else seconds)
            last = line.get("ns") if line["kind"] == "step" else None


def _seconds(line: Mapping[str, Any], last: int | None) -> float | None:
    """The time since the step at `last`, both in `ns`; None if the game stood still meanwhile, or it is not known."""
    messages = line.get("messages") or ()
    stood = any("event" in message or message.get("command") in ("pause", "start") for message in messages)
    return None if last is None or stood or "ns" not in line else max(0, line["ns"] - last) / 1e9


def _add_line(recorded: RecordedTrial, line: Mapping[str, Any], seconds: float) -> None:
    kind, number, current = line["kind"], int(line["episode"]), recorded.unfinished
    if kind in ("end", "break") and isinstance(line.get("outcomes"), Mapping):
        recorded.outcomes |= {str(player): str(outcome) for player, outcome in line["outcomes"].items()}
    if kind == "presence" and line["what"] == "refused":
        recorded.outcomes[str(line["player"])] = "ping"
    elif kind == "reset":
        recorded.unfinished = UnfinishedEpisode(number, line["seed"])
    elif kind == "break":
        ends = {"stop": "stopped", PARTNER_LEFT: PARTNER_LEFT}.get(line["why"])
        if ends is not None and recorded.ended and recorded.ended[-1].number == number:
            recorded.ended[-1] = replace(recorded.ended[-1], why=ends)  # the trial ended in the episode's break
    elif current is None or number != current.number:
        return
    elif kind == "resume":
        del current.steps[max(0, int(line["steps"])) :]
    elif kind == "step":
        words = tuple(_feedback(line))
        current.steps.append(_step(line, words))
        current.unheard = []
        recorded.seconds += seconds
        if line.get("terminated") or line.get("truncated"):  # over, even if the server was lost before the line `end`
            why = "terminated" if line.get("terminated") else "truncated"
            _end(recorded, current, why, success=recording.succeeded(line.get("info") or {}))
    elif kind == "end" and line["why"] == "shutdown":
        current.unheard = _feedback(line)
    elif kind == "end":
        _end(recorded, current, str(line["why"]))


def _step(line: Mapping[str, Any], words: tuple[Word, ...]) -> RecordedStep:
    # What the agent was asked to take if no key acted: the line's action, unless the agent reported its own (`by` is
    # `agent`). Then it is a program's advice, which the line has, or the idle action.
    advice = line.get("advice") if line.get("by") in (None, "agent") else line["action"]
    parts = line.get("players") or {}
    players = {
        str(name): RecordedAction(part["action"], float(part["reward"] or 0.0), part.get("observed"), part.get("by"))
        for name, part in parts.items()
    }
    return RecordedStep(line["human"], line["action"], float(line["reward"] or 0.0), words, advice, players)


def _end(recorded: RecordedTrial, episode: UnfinishedEpisode, why: str, *, success: bool = False) -> None:
    over = Episode(episode.number, len(episode.steps), episode.score, why, episode.scores, success=success)
    recorded.ended.append(over)
    recorded.unfinished = None


def _feedback(line: Mapping[str, Any]) -> list[Word]:
    feedback = (message for message in line.get("messages", ()) if is_feedback(message.get("command")))
    return [Word(message["command"], message.get("player")) for message in feedback]
