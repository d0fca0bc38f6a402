"""The tables of games, `episodes`, `callbacks` and `presence`, and those of identities and problems."""

# ruff: noqa: PLC0415 - pyarrow is large, and imported when a recording is read

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from hippodrome.export import scrub
from hippodrome.export.answers import Answers
from hippodrome.export.keys import KeyKind
from hippodrome.export.recording import MAX_FORM_COLUMNS
from hippodrome.export.records import Record, SourceFile
from hippodrome.export.scrub import clean
from hippodrome.export.table_files import BATCH, Column, Table, as_columns, fit
from hippodrome.export.values import as_number, as_text, as_whole, when
from hippodrome.protocol.keys import sessions_folder
from hippodrome.protocol.players import MAX_PLAYERS

_SESSION = as_columns("session player")


class Episodes(Table):
    """A row per episode: its outcome, the file with its frames, who played each player with which score, and what was
    filled in on the pages in the game. An episode of a session has a row for each human player, with their score."""

    name = "episodes"

    def __init__(self) -> None:
        self._in_sessions = False
        self._players: dict[str, None] = {}
        self._forms: dict[str, None] = {}
        """The fields of all pages in games, such as `betweenEpisodes.trust`."""

    def see(self, record: Record) -> None:
        for episode in (episode for file in record.recordings() for episode in file.episodes):
            self._in_sessions = self._in_sessions or "session" in episode
            for name in (*episode["players"], *episode["scores"]):
                if len(self._players) < MAX_PLAYERS:
                    self._players[name] = None
            for field in (field for fields in episode["forms"].values() for field in fields):
                if len(self._forms) < MAX_FORM_COLUMNS:
                    self._forms[field] = None

    @property
    def columns(self) -> list[Column]:
        return [
            *as_columns(
                "participant studyStep attempt:whole trial episode:whole seed:whole frames:whole "
                "score:number why started:time ended:time file"
            ),
            *((*_SESSION, Column("framesByPolicy", "whole")) if self._in_sessions else ()),
            *(Column(f"player.{clean(name)}") for name in self._players),
            *(Column(f"score.{clean(name)}", "number") for name in self._players),
            *(Column(clean(name)) for name in self._forms),
        ]

    def rows(self, record: Record) -> Iterator[list[Any]]:
        for file in record.recordings():
            for episode in file.episodes:
                for number, player, score in _humans(record, episode):
                    session = [episode.get("session"), None, None]
                    if player is not None:
                        session[1:] = clean(player), episode["byPolicy"].get(player, 0)
                    filled = episode["forms"].get(player or "", {})
                    yield [
                        number,
                        *(episode[name] for name in ("step", "attempt", "trial", "episode", "seed", "frames")),
                        score,
                        episode["why"],
                        when(episode["started"]),
                        when(episode["ended"]),
                        file.path,
                        *(session if self._in_sessions else ()),
                        *(episode["players"].get(name) for name in self._players),
                        *(episode["scores"].get(name) for name in self._players),
                        *(as_text(filled.get(name)) for name in self._forms),
                    ]


def _humans(record: Record, episode: Mapping[str, Any]) -> list[tuple[str | None, str | None, float | None]]:
    """The number, player and score of each human in an episode; the player is None if one participant played alone.

    The number is None if the participant was erased, or if no participant ever played this player.
    """
    people = episode.get("people")
    if record.is_participant or not people:
        return [(record.number or None, None, episode["score"])]
    return [(number, player, episode["scores"].get(player)) for player, number in people.items()]


class _LinesTable(Table):
    """A table with rows of single lines, which it reads from the converted recordings in `folder`."""

    kinds: tuple[str, ...]

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.needed = self._in_sessions = False

    def see(self, record: Record) -> None:
        for file in record.recordings():
            self._in_sessions = self._in_sessions or any("session" in episode for episode in file.episodes)
            self.needed = self.needed or self._has_lines(file)

    def _has_lines(self, file: SourceFile) -> bool:
        raise NotImplementedError

    def rows(self, record: Record) -> Iterator[list[Any]]:
        import pyarrow.parquet as pq

        columns = ["kind", "trial", "episode", "step", "time", "error", "other"]
        for file in filter(self._has_lines, record.recordings()):
            with pq.ParquetFile(self._folder / file.path) as parquet:
                for batch in parquet.iter_batches(batch_size=BATCH, columns=columns):
                    for line in batch.to_pylist():
                        if line["kind"] in self.kinds:
                            yield from self._rows(record, file, line)

    def _rows(self, record: Record, file: SourceFile, line: Mapping[str, Any]) -> Iterator[list[Any]]:
        raise NotImplementedError

    def _where(self, file: SourceFile, line: Mapping[str, Any]) -> list[Any]:
        """The step of the study, the attempt, the trial, the episode, the step and the time of a line."""
        first = file.episodes[0]
        return [first["step"], first["attempt"], *(line[name] for name in ("trial", "episode", "step", "time"))]


class Callbacks(_LinesTable):
    """A row per line that a callback of the agent has recorded.

    If the line names a player of a session, the row's participant is the one who plays this player.
    """

    name = "callbacks"
    kinds = ("callback",)

    @property
    def columns(self) -> list[Column]:
        return [
            *as_columns(
                "participant studyStep attempt:whole trial episode:whole step:whole time:time callback "
                "name value error skipped:whole file"
            ),
            *(_SESSION if self._in_sessions else ()),
        ]

    def _has_lines(self, file: SourceFile) -> bool:
        return any(episode.get("callbacks") for episode in file.episodes)

    def _rows(self, record: Record, file: SourceFile, line: Mapping[str, Any]) -> Iterator[list[Any]]:
        other, first = _other_fields(line), file.episodes[0]
        player, value = as_text(other.get("player")), other.get("value")
        yield [
            record.number or first.get("people", {}).get(player),
            *self._where(file, line),
            as_text(other.get("callback")),
            as_text(other.get("name")),
            None if value is None else fit(value, "text"),
            line["error"],
            as_whole(other.get("skipped")),
            file.path,
            *([first.get("session"), player] if self._in_sessions else ()),
        ]


class Presence(_LinesTable):
    """A row for each time that a member of a session came, left or was back, and for each round trip, in
    milliseconds."""

    name = "presence"
    kinds = ("presence", "ping")
    columns = as_columns(
        "participant session player studyStep attempt:whole trial episode:whole step:whole time:time what "
        "roundTrip:number file"
    )

    def _has_lines(self, file: SourceFile) -> bool:
        return any("session" in episode for episode in file.episodes)

    def _rows(self, record: Record, file: SourceFile, line: Mapping[str, Any]) -> Iterator[list[Any]]:
        first = file.episodes[0]
        for player, what, trip in _presence(_other_fields(line)):
            yield [
                first.get("people", {}).get(player),
                first["session"],
                clean(player),
                *self._where(file, line),
                what,
                trip,
                file.path,
            ]


def _presence(line: Mapping[str, Any]) -> Iterator[tuple[str, str, float | None]]:
    """For each player in a line: the player, the event, and the milliseconds if the event is a round trip."""
    player, what, trips = line.get("player"), line.get("what"), line.get("roundTrip")
    if isinstance(player, str) and isinstance(what, str):
        yield player, clean(what), None
    elif isinstance(trips, Mapping):
        yield from ((name, "ping", as_number(trip)) for name, trip in trips.items())


def _other_fields(line: Mapping[str, Any]) -> Mapping[str, Any]:
    """The fields of a recording's line that have no columns: `other` has them as JSON."""
    try:
        other = json.loads(line["other"] or "{}")
    except ValueError:  # the replacement of an id has made it invalid
        return {"value": line["other"]}
    return other if isinstance(other, dict) else {}


class Identities(Table):
    """A row per participant: whose number is whose. It is kept in `private/`."""

    name = "identities"

    def __init__(self, answers: Answers) -> None:
        self._answers = answers

    @property
    def columns(self) -> list[Column]:
        fixed = as_columns("participant userId completionCode")
        return [*fixed, *(Column(clean(name)) for name in self._answers.links)]

    def rows(self, record: Record) -> Iterator[list[Any]]:
        if record.is_participant:
            link = scrub.columns(record.document)
            known = (clean(link[name]) if name in link else None for name in self._answers.links)
            yield [record.number, record.user, record.completion_code, *known]


class Problems(Table):
    """A row for each problem with a file of the source, with its key. With `apart` the key has no ids."""

    name = "problems"
    columns = as_columns("participant file problem")

    def __init__(self, project: str, apart: bool) -> None:
        self._project, self._apart = project, apart

    def rows(self, record: Record) -> Iterator[list[Any]]:
        for key, file in sorted(record.files.items()):
            shown = self._without_ids(record, file) if self._apart else key.removeprefix(f"{self._project}/users/")
            yield from ([record.number or None, clean(shown), problem] for problem in file.problems)

    def _without_ids(self, record: Record, file: SourceFile) -> str:
        """A file's key without ids. A session's id stays, since it identifies nobody; so do words of the format."""
        if not record.user:
            top = "sessions" if file.key.startswith(sessions_folder(self._project)) else "users"
            return f"(somewhere in {top}/)"
        match file.key.split("/")[3:]:
            case _ if file.kind == KeyKind.FOREIGN:
                shown = "(another file)"
            case ["trials", _, name]:
                shown = f"trials/(server)/{name}"
            case parts:
                shown = "/".join(parts)
        if record.is_session:
            return f"sessions/{record.user}/{shown}"
        return f"{record.number}/{scrub.Scrub(record.identities).text(shown)}"
