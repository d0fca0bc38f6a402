"""Makes all tables but those of answers (`answers.py`): episodes, callbacks, presence, identities and problems.

All rows are read one at a time, so that memory does not grow with the study.
"""

# ruff: noqa: PLC0415 - pyarrow is large, and imported when a recording is read

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from hippodrome.export import scrub
from hippodrome.export.recording import MAX_FORM_COLUMNS
from hippodrome.export.recording_columns import as_number, as_whole, when
from hippodrome.export.scrub import clean
from hippodrome.export.state import ExportedParticipant, ExportState
from hippodrome.export.table_files import BATCH, Column, fit
from hippodrome.protocol.keys import sessions_folder
from hippodrome.protocol.players import MAX_PLAYERS
from hippodrome.protocol.session import is_session_id

EPISODES = (
    Column("participant"),
    Column("studyStep"),
    Column("attempt", "whole"),
    Column("trial"),
    Column("episode", "whole"),
    Column("seed", "whole"),
    Column("frames", "whole"),
    Column("score", "number"),
    Column("why"),
    Column("started", "time"),
    Column("ended", "time"),
    Column("file"),
)


_SESSION_COLUMNS = (Column("session"), Column("player"))
_BY_POLICY = Column("framesByPolicy", "whole")
"""In an episode of a session: the frames in which the substitute played in the participant's place."""


def in_sessions(state: ExportState) -> bool:
    """Return whether there are episodes of sessions."""
    return any("session" in found for _, _, found in state.episodes())


def players(state: ExportState) -> tuple[str, ...]:
    """Return the players of all episodes, at most MAX_PLAYERS; () if no game has several players."""
    names = (name for _, _, found in state.episodes() for name in (*found.get("players", ()), *found.get("scores", ())))
    return tuple(dict.fromkeys(names))[:MAX_PLAYERS]


def form_fields(state: ExportState) -> tuple[str, ...]:
    """Return the fields of all pages in games, such as `betweenEpisodes.trust`, at most MAX_FORM_COLUMNS."""
    forms = (fields for _, _, found in state.episodes() for fields in found.get("forms", {}).values())
    return tuple(dict.fromkeys(name for fields in forms for name in fields))[:MAX_FORM_COLUMNS]


def episodes(state: ExportState, *, in_sessions: bool) -> tuple[list[Column], Iterator[list[Any]]]:
    """Return the columns of `episodes`, and its rows: one for each episode, or in a session for each human player."""
    humans, forms = players(state), form_fields(state)
    columns = [
        *EPISODES,
        *((*_SESSION_COLUMNS, _BY_POLICY) if in_sessions else ()),
        *(Column(f"player.{clean(name)}") for name in humans),
        *(Column(f"score.{clean(name)}", "number") for name in humans),
        *(Column(clean(name)) for name in forms),
    ]
    return columns, _episode_rows(state, humans, in_sessions, forms)


def _episode_rows(
    state: ExportState, players: Sequence[str], in_sessions: bool, forms: Sequence[str]
) -> Iterator[list[Any]]:
    """Yield a row per episode: its outcome, the file with its frames, who played each player with which score, and what
    was filled in on the pages in the game.

    An episode of a session has a row for each human player, with their own score.
    """
    for participant, path, found in state.episodes():
        for number, player, score in _humans(participant, found):
            filled = found.get("forms", {}).get(player or "", {})
            yield [
                number,
                found["step"],
                found["attempt"],
                _text(found["trial"]),
                found["episode"],
                found["seed"],
                found["frames"],
                score,
                _text(found["why"]),
                when(found["started"]),
                when(found["ended"]),
                path,
                *(_in_session(found, player) if in_sessions else ()),
                *(_text(found.get("players", {}).get(name)) for name in players),
                *(found.get("scores", {}).get(name) for name in players),
                *(_text(filled.get(name)) for name in forms),
            ]


def _text(value: Any) -> str | None:
    return clean(value) if isinstance(value, str) else None


def _in_session(found: Mapping[str, Any], player: str | None) -> list[Any]:
    """The session, the player, and the frames that the substitute played."""
    if player is None:
        return [found.get("session"), None, None]
    return [found.get("session"), clean(player), found["byPolicy"].get(player, 0)]


def _humans(
    participant: ExportedParticipant | None, found: Mapping[str, Any]
) -> list[tuple[str | None, str | None, float | None]]:
    """The number, player and score of each human in an episode; the player is None if one participant played alone.

    The number is None if the participant was erased, or if no participant ever played this player.
    """
    people = found.get("people")
    if participant is not None or not people:
        return [(participant.number if participant else None, None, found["score"])]
    scores = found.get("scores", {})
    return [(number, player, scores.get(player)) for player, number in people.items()]


CALLBACKS = (
    Column("participant"),
    Column("studyStep"),
    Column("attempt", "whole"),
    Column("trial"),
    Column("episode", "whole"),
    Column("step", "whole"),
    Column("time", "time"),
    Column("callback"),
    Column("name"),
    Column("value"),
    Column("error"),
    Column("skipped", "whole"),
    Column("file"),
)


def callback_columns(in_sessions: bool) -> list[Column]:
    """Return the columns of `callbacks`."""
    return [*CALLBACKS, *(_SESSION_COLUMNS if in_sessions else ())]


def callbacks(state: ExportState, folder: Path, in_sessions: bool) -> Iterator[list[Any]]:
    """Yield a row per line that a callback of the agent has recorded. `folder` holds the converted recordings.

    If the line names a player of a session, the row's participant is the one who plays this player.
    """
    for participant, first, path, row in _lines(state, folder, "callbacks", ("callback",)):
        other = _other_fields(row)
        player = other.get("player") if isinstance(other.get("player"), str) else None
        number = participant.number if participant else first.get("people", {}).get(player)
        value = other.get("value")
        yield [
            number,
            first["step"],
            first["attempt"],
            _text(row["trial"]),
            row["episode"],
            row["step"],
            row["time"],
            _text(other.get("callback")),
            _text(other.get("name")),
            None if value is None else fit(value, "text"),
            _text(row["error"]),
            as_whole(other.get("skipped")),
            path,
            *([first.get("session"), None if player is None else clean(player)] if in_sessions else ()),
        ]


PRESENCE = (
    Column("participant"),
    Column("session"),
    Column("player"),
    Column("studyStep"),
    Column("attempt", "whole"),
    Column("trial"),
    Column("episode", "whole"),
    Column("step", "whole"),
    Column("time", "time"),
    Column("what"),
    Column("roundTrip", "number"),
    Column("file"),
)


def presence(state: ExportState, folder: Path) -> Iterator[list[Any]]:
    """Yield a row for each time that a member of a session came, left or was back, and for each round trip.

    `folder` holds the converted recordings. Round trips are in milliseconds.
    """
    for _, first, path, row in _lines(state, folder, "session", ("presence", "ping")):
        people = first.get("people", {})
        for player, what, trip in _presence(_other_fields(row)):
            yield [
                people.get(player),
                first["session"],
                clean(player),
                first["step"],
                first["attempt"],
                _text(row["trial"]),
                row["episode"],
                row["step"],
                row["time"],
                what,
                trip,
                path,
            ]


def _presence(line: Mapping[str, Any]) -> Iterator[tuple[str, str, float | None]]:
    """For each player in a line: the player, the event, and the milliseconds if the event is a round trip."""
    player, what, trips = line.get("player"), line.get("what"), line.get("roundTrip")
    if isinstance(player, str) and isinstance(what, str):
        yield player, clean(what), None
    elif isinstance(trips, Mapping):
        yield from ((name, "ping", as_number(trip)) for name, trip in trips.items())


def _lines(
    state: ExportState, folder: Path, has: str, kinds: Sequence[str]
) -> Iterator[tuple[ExportedParticipant | None, Mapping[str, Any], str, Mapping[str, Any]]]:
    """The lines of these kinds, from all recordings that have an episode with a value for `has`.

    Each comes with the recording's participant, its first episode, and its file.
    """
    import pyarrow.parquet as pq

    columns = ["kind", "trial", "episode", "step", "time", "error", "other"]
    for path, several in groupby(state.episodes(), lambda row: row[1]):
        rows = list(several)
        if not any(found.get(has) for _, _, found in rows):
            continue
        participant, _, first = rows[0]
        with pq.ParquetFile(folder / path) as file:
            for batch in file.iter_batches(batch_size=BATCH, columns=columns):
                yield from ((participant, first, path, row) for row in batch.to_pylist() if row["kind"] in kinds)


def _other_fields(row: Mapping[str, Any]) -> Mapping[str, Any]:
    """The fields of a recording's line that have no columns: `other` has them as JSON."""
    try:
        other = json.loads(row["other"] or "{}")
    except ValueError:  # the replacement of an id has made it invalid
        return {"value": row["other"]}
    return other if isinstance(other, dict) else {}


def identities(state: ExportState, links: Sequence[str]) -> tuple[list[Column], Iterator[list[Any]]]:
    """Return the columns and rows of the table of identities, which is kept in `private/`."""
    columns = [Column("participant"), Column("userId"), Column("completionCode")]
    columns += [Column(clean(name)) for name in links]

    def rows() -> Iterator[list[Any]]:
        for participant in state.participants():
            link = scrub.columns(participant.document)
            yield [
                participant.number,
                participant.user,
                scrub.completion_code(participant),
                *(clean(link[name]) if name in link else None for name in links),
            ]

    return columns, rows()


PROBLEMS = (Column("participant"), Column("file"), Column("problem"))


def problems(state: ExportState, project: str, apart: bool) -> Iterator[list[Any]]:
    """Yield a row for each problem with a file of the source, with its key. With `apart` the key has no ids."""
    for participant, key, problem in state.problems():
        shown = key.removeprefix(f"{project}/users/")
        if apart and key.startswith(sessions_folder(project)):
            yield [None, _of_session(key.removeprefix(f"{project}/")), problem]
            continue
        if apart:
            shown = _without_ids(shown, participant, project)
        yield [participant.number if participant else None, clean(shown), problem]


def _of_session(key: str) -> str:
    """A key below `sessions/` without ids of participants. The session's id stays, since it does not identify anyone;
    unknown parts are left out."""
    match key.split("/"):
        case [top, session, "session.json" | "assignment.json" as name] if is_session_id(session):
            return f"{top}/{session}/{name}"
        case [top, session, "trials", _, name] if is_session_id(session) and _RECORDED.fullmatch(name):
            return f"{top}/{session}/trials/(server)/{name}"
    return "(somewhere in sessions/)"


_RECORDED = re.compile(r"[A-Za-z0-9_-]{1,64}-(?:(?:trial|episode)[0-9-]*\.jsonl\.gz|talk-[0-9]*\.json)")


def _without_ids(key: str, participant: ExportedParticipant | None, project: str) -> str:
    """A participant's key without ids. Known parts stay; unknown parts are left out."""
    if participant is None:
        return "(somewhere in users/)"
    parts = key.split("/")
    match parts[1:]:
        case ["participant.json" | "session.json" | "assignment.json" | "end.json"]:
            rest = parts[1]
        case ["answers", name] if (
            re.fullmatch(r"[A-Za-z0-9_-]{1,64}(\.[0-9]{1,4})?\.json", name) and name != f"{participant.user}.json"
        ):
            rest = f"answers/{name}"
        case ["trials", _, name] if _RECORDED.fullmatch(name):
            rest = f"trials/(server)/{name}"
        case _:
            rest = "(another file)"
    hide = scrub.Scrub(scrub.identities(participant))
    return f"{participant.number}/{hide.text(rest)}"
