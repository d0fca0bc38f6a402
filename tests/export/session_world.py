"""Studies whose participants play together: their documents, and a session's recording as the trial writes it."""

from __future__ import annotations

import itertools
import json
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hippodrome.control.model import ids
from hippodrome.control.model.records import to_json
from hippodrome.control.model.sessions import Membership
from hippodrome.protocol.keys import membership_key, session_key, session_recordings_folder
from hippodrome.protocol.session import Member, SessionDocument
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.recording import Recording
from tests.export.data_world import GAME, PROJECT, TIME, Put, arrive, register

SID = "s.0123456789abcdef0123"
OTHER = "s.fedcba98765432100000"
ANN, BOB, CY = "annabel-0042", "bob-the-second", "cyrus-without-a-partner"
PLAYERS = ("left", "right")
_numbers = itertools.count()


def server(session: str = SID, attempt: int = 1) -> str:
    return ids.server_name(ids.server_label(PROJECT.id, session), attempt)


def recording_key(session: str = SID, name: str = "3-episode-0001", attempt: int = 1) -> str:
    folder = session_recordings_folder(PROJECT.id, session)
    return f"{folder}{server(session, attempt)}/{name}.jsonl.gz"


def session(*members: str, session_id: str = SID, players: int = 2) -> SessionDocument:
    """Make the document of a session with these members; an empty id stands for an erased member."""
    seated = tuple(Member(user, 1, seat) for seat, user in enumerate(members))
    return SessionDocument(session_id, players, seated, 1, TIME)


def said(user: str) -> str:
    """Return a text that only this participant has sent."""
    return f"words-of-{user.partition('-')[0]}"


def round_trip(user: str) -> float:
    """Return a round trip that only this participant has, in milliseconds."""
    return 20.5 + sum(user.encode())


def lines(
    members: Sequence[str] = (ANN, BOB),
    *,
    frames: int = 6,
    observe: bool = False,
    session_id: str = SID,
    attempt: int = 1,
    head: Mapping[str, Any] | None = None,
    replaced: Collection[int] = (),
) -> list[bytes]:
    """Make the lines of a session's recording: both members press keys, give feedback, leave and come back.

    In the steps of `replaced` the substitute has played in the place of the right player.
    """
    clock = itertools.count(1)
    stamp = {"v": recording.SCHEMA, "server": server(session_id, attempt), "trial": "t-1"}
    people = dict(zip(PLAYERS, members, strict=False))
    made: list[bytes] = []

    def line(kind: str, **fields: Any) -> None:
        n = next(clock)
        made.append(recording.line(kind, **stamp, time=f"2026-11-21T14:46:40.{n:06d}Z", ns=n, **fields))

    line(
        "header", project=PROJECT.id, session=session_id, group=1, step="3",
        game="grid", actionSpace=["noop", "up", "down"], frameRate=30, actionBufferLifespan=1, episode=1, seed=5,
        players=head or {name: {"kind": "human", "seat": seat} for seat, name in enumerate(PLAYERS)},
        pace="realtime", input="held", frameSkip=1, idleActions=dict.fromkeys(PLAYERS, 0),
        versions=recording.versions(),
    )  # fmt: skip
    for name in people:
        line("presence", player=name, what="joined")
    trips = {name: round_trip(user) for name, user in people.items()}
    seen = {"observation": recording.observation(np.array([0, 7], np.uint8))} if observe else {}
    theirs = {"observation": recording.observation(np.array([0, 9], np.uint8))} if observe else {}
    line("reset", episode=1, seed=41, info={}, players={"left": {}, "right": theirs}, roundTrip=trips, **seen)
    for n in range(1, frames + 1):
        seen = {"observation": recording.observation(np.array([n, 7], np.uint8))} if observe else {}
        theirs = {"observation": recording.observation(np.array([n, 9], np.uint8))} if observe else {}
        messages = [
            {"ns": 100 * n + seat, "player": name, "key": said(user), "held": n % 2 == 0}
            for seat, (name, user) in enumerate(people.items())
        ]
        if n == 2:
            messages += [{"ns": 250, "player": name, "command": "good"} for name in people]
            messages += [{"ns": 251, "player": name, "event": "connected"} for name in people]
        line(
            "step", episode=1, step=n, frame=n, human=1, action=1, actionName="up", by="human", reward=1.0,
            terminated=n == frames, truncated=False, info={"t": n}, messages=messages, extra={"score": n},
            players={
                "left": {"action": 1, "actionName": "up", "by": "human", "reward": 1.0, "pressedAt": 100 * n},
                "right": {"action": 2, "actionName": "down", "by": "policy" if n in replaced else "human", "reward": 0.5, "human": 2,
                          "pressedAt": 100 * n + 1, "info": {"right": n}, **theirs},
            }, **seen,
        )  # fmt: skip
        if n == 3:
            line("ping", roundTrip=trips)
            for name in people:
                line("presence", player=name, what="left", episode=1, step=n)
                line("presence", player=name, what="returned", episode=1, step=n)
    line("end", episode=1, steps=frames, score=1.0 * frames, scores={"left": 1.0 * frames, "right": 0.5 * frames},
         why="terminated", messages=[{"ns": 9000, "player": name, "key": said(user)} for name, user in people.items()])  # fmt: skip
    for name, user in people.items():
        line("callback", episode=1, step=frames, callback="on_feedback", name="liked", player=name, value=said(user))
    line("callback", episode=1, step=frames, callback="on_tick", name="level", value=3)
    return made


def packed(folder: Path, made: Sequence[bytes], *, close: bool = True) -> bytes:
    """Write these lines by the trial's own code, and return the bytes of the recording."""
    path = folder / f"session-{next(_numbers)}.gz"
    file = Recording(path, "unused")
    for line in made:
        file.add(line)
    if close:
        file.close()
    else:
        file.flush()
    return path.read_bytes()


def tape(members: Sequence[str] = (ANN, BOB)) -> bytes:
    """Make a piece of a session's tape: each member says a line, and the agent answers the first one by a model."""
    made: list[dict[str, Any]] = []

    def record(kind: str, second: int, **fields: Any) -> None:
        made.append({"time": f"2026-11-21T14:46:{second:02d}+00:00", "ns": second, "kind": kind, **fields})

    where = {"episode": 1, "step": 2}
    record("line", 10, n=1, by="left", text=said(members[0]), id=5, typed=2500, **where)
    request = {"messages": [{"role": "user", "content": said(members[0])}]}
    tokens = {"input": 9, "output": 2}
    record("call", 11, hash="abc", nth=1, request=request, answer={"x": 1}, tokens=tokens, model="small", **where)
    record("line", 12, n=2, by="ai", text="Hello", answers=1, **where)
    record("line", 15, n=3, by="right", text=said(members[1]), id=6, to=["left"], original="Rude", **where)
    record("line", 16, by="left", text=f"{said(members[0])}!", id=7, held=True, **where)
    return json.dumps({"schema": 1, "seats": list(PLAYERS), "records": made}).encode()


def tape_key(session: str = SID) -> str:
    return recording_key(session, "3-talk-0001").replace(".jsonl.gz", ".json")


def join(put: Put, user: str, seat: int, *, session_id: str = SID, score: float = 6.0) -> None:
    """Put a member's own documents, with all their answers."""
    game = {**GAME, "score": score, "session": session_id, "player": PLAYERS[seat], "outcome": "finished"}
    arrive(put, user, {"1": {"consent": "yes"}, "2": {"age": "30"}, "3": game, "4": {"words": said(user)}})
    put(membership_key(PROJECT.id, user), to_json(Membership(session_id, seat, members=2, waited=2.5 * seat)))


def unmatched(put: Put, user: str, code: str = "UNMATCHED7") -> None:
    """Put the documents of a participant for whom no partner was found."""
    arrive(put, user, {"1": {"consent": "yes"}, "2": {"age": "40"}, "3": {"outcome": "unmatched"}, "4": {"words": ""}})
    put(membership_key(PROJECT.id, user), to_json(Membership(unmatched=True, completion_code=code)))


def pair(put: Put, work: Path, *, members: Sequence[str] = (ANN, BOB), session_id: str = SID, **how: Any) -> None:
    """Put a session that is over, with the documents of its members."""
    for seat, user in enumerate(members):
        join(put, user, seat, session_id=session_id, score=(6.0, 3.0)[seat])
    put(session_key(PROJECT.id, session_id), session(*members, session_id=session_id).to_json())
    put(recording_key(session_id), packed(work, lines(members, session_id=session_id, **how)))


def study(put: Put, work: Path, **how: Any) -> None:
    """Put a pair, and a participant for whom no partner was found."""
    register(put)
    pair(put, work, **how)
    unmatched(put, CY)
