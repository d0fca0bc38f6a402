"""The tables `messages` and `calls`, of the tapes of games in which people talk (`trial/recordings/tape.py`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any

from hippodrome.export.keys import KeyKind
from hippodrome.export.records import Record
from hippodrome.export.scrub import Scrub, clean
from hippodrome.export.table_files import Column, Table, as_columns
from hippodrome.export.values import as_text, as_whole, when

SCHEMA = 1
_Said = tuple[Mapping[str, Any], datetime]
_WHERE = as_columns("participant studyStep attempt:whole")
_WHEN = as_columns("episode:whole step:whole n:whole")


def document(
    piece: Mapping[str, Any], where: Mapping[str, Any], people: Mapping[int, str], hide: Scrub
) -> dict[str, Any]:
    """Return what tables need of a piece of a tape, without identities: `where` (step, attempt, session), the `people`
    by player instead of by seat, and the lines and calls. Raises ValueError if the piece cannot be read."""
    records, seats = piece.get("records"), piece.get("seats", [])
    if piece.get("schema") != SCHEMA or not isinstance(records, list) or not isinstance(seats, list):
        raise ValueError("it is no piece of a tape that this version can read")
    playing = {str(player): people[seat] for seat, player in enumerate(seats) if seat in people}
    hide = hide.sparing(list(map(str, seats)))
    kept = [_needed(hide.record(record)) for record in records if isinstance(record, Mapping)]
    return {**where, "people": playing, "records": [record for record in kept if record]}


def _needed(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """A line, or a call without request and answer, which may be long; {} of another record."""
    if record.get("kind") != "call":
        return record if record.get("kind") == "line" else {}
    answer = record.get("answer")
    error = answer.get("error") if isinstance(answer, Mapping) else None
    code = error.get("code") if isinstance(error, Mapping) else None
    return {name: value for name, value in record.items() if name not in ("request", "answer")} | {"error": code}


class _TapeTable(Table):
    """A table with rows of tapes' records of one kind. In a study with sessions it has a column for them."""

    kind: str
    own: Sequence[Column]

    def __init__(self) -> None:
        self.needed = self._in_sessions = False

    def see(self, record: Record) -> None:
        kinds = {file.kind for file in record.files.values()}
        self._in_sessions = self._in_sessions or bool(kinds & {KeyKind.SESSION, KeyKind.MEMBERSHIP})
        self.needed = self.needed or any(self._of(piece) for piece in record.tapes())

    def _of(self, piece: Mapping[str, Any]) -> list[Mapping[str, Any]]:
        return [record for record in piece["records"] if record["kind"] == self.kind]

    @property
    def columns(self) -> list[Column]:
        return [*_WHERE, *_WHEN, *self.own, *((Column("session"),) if self._in_sessions else ())]

    def _row(self, piece: Mapping[str, Any], number: str | None, *values: Any) -> list[Any]:
        session = (piece["session"],) if self._in_sessions else ()
        return [number, piece["step"], piece["attempt"], *values, *session]


class Messages(_TapeTable):
    """A row for each line that was said, or that the agent's `moderate` has held back.

    `participant` is who has said it, None if it was the agent. `replySeconds` is the time since the line that it
    answers: for a line of the agent's `reply`, the line that it was asked; else the last line of somebody else that its
    speaker has read, if that is newer than their own last line.
    """

    name = "messages"
    kind = "line"
    own = as_columns("by to time:time text replySeconds:number typedSeconds:number held original")

    def rows(self, record: Record) -> Iterator[list[Any]]:
        step = ""
        before: list[_Said] = []
        for piece in record.tapes():
            if piece["step"] != step:
                step, before = piece["step"], []
            for line in self._of(piece):
                by, time, typed = str(line.get("by", "")), when(line.get("time")), as_whole(line.get("typed"))
                to, held = line.get("to"), line.get("held") is True
                own = record.is_participant and "id" in line
                answered = None if held or time is None else _answered(line, by, before)
                yield self._row(
                    piece,
                    record.number if own else piece["people"].get(by),
                    *(as_whole(line.get(name)) for name in ("episode", "step", "n")),
                    clean(by),
                    " ".join(clean(str(name)) for name in to) if isinstance(to, list) else None,
                    time,
                    as_text(line.get("text")),
                    None if answered is None or time is None else round((time - answered).total_seconds(), 3),
                    None if typed is None else typed / 1000,
                    "true" if held else None,
                    as_text(line.get("original")),
                )
                if time is not None and not held:
                    before.append((line, time))


def _answered(line: Mapping[str, Any], by: str, before: Sequence[_Said]) -> datetime | None:
    """Return the time of the line that a line answers; None if it answers none."""
    if "answers" in line:
        return next((time for other, time in before if other.get("n") == line["answers"]), None)
    for other, time in reversed(before):
        if other.get("by") == by:
            return None
        if other.get("to") is None or by in other["to"]:
            return time
    return None


class Calls(_TapeTable):
    """A row for each call of a language model. `n` is the number of the line that was being answered."""

    name = "calls"
    kind = "call"
    own = as_columns(
        "time:time milliseconds:whole path model status:whole error inputTokens:whole outputTokens:whole estimated hash"
    )

    def rows(self, record: Record) -> Iterator[list[Any]]:
        for piece in record.tapes():
            for call in self._of(piece):
                tokens = call.get("tokens")
                tokens = tokens if isinstance(tokens, Mapping) else {}
                yield self._row(
                    piece,
                    record.number or None,
                    *(as_whole(call.get(name)) for name in ("episode", "step", "line")),
                    when(call.get("time")),
                    as_whole(call.get("ms")),
                    as_text(call.get("path")),
                    as_text(call.get("model")),
                    as_whole(call.get("status")),
                    as_text(call["error"]),
                    as_whole(tokens.get("input")),
                    as_whole(tokens.get("output")),
                    "true" if tokens.get("estimated") is True else None,
                    as_text(call.get("hash")),
                )
