"""Makes the table of messages, of the tapes of games in which people talk (`trial/recordings/tape.py`)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from typing import Any, NamedTuple

from hippodrome.export.recording_columns import as_whole, when
from hippodrome.export.scrub import Scrub, clean
from hippodrome.export.state import ExportedParticipant, ExportState
from hippodrome.export.table_files import Column

SCHEMA = 1
_Said = tuple[Mapping[str, Any], datetime]

MESSAGES = (
    Column("participant"),
    Column("studyStep"),
    Column("attempt", "whole"),
    Column("episode", "whole"),
    Column("step", "whole"),
    Column("n", "whole"),
    Column("by"),
    Column("to"),
    Column("time", "time"),
    Column("text"),
    Column("replySeconds", "number"),
    Column("typedSeconds", "number"),
    Column("held"),
    Column("original"),
)


class TapeRecord(NamedTuple):
    """A record of a tape, and where it is from."""

    participant: ExportedParticipant | None
    """The participant; None in a session."""
    session: str | None
    people: Mapping[str, str]
    """In a session: the members' numbers by player."""
    step: str
    attempt: int | None
    record: Mapping[str, Any]


def document(
    piece: Mapping[str, Any], where: Mapping[str, Any], people: Mapping[int, str], hide: Scrub
) -> dict[str, Any]:
    """Return what the state keeps of a piece of a tape, without identities: `where` (step, attempt, session), the
    `people` by player instead of by seat, and the records. Raises ValueError if the piece cannot be read."""
    records, seats = piece.get("records"), piece.get("seats", [])
    if piece.get("schema") != SCHEMA or not isinstance(records, list) or not isinstance(seats, list):
        raise ValueError("it is no piece of a tape that this version can read")
    playing = {str(player): people[seat] for seat, player in enumerate(seats) if seat in people}
    hide = hide.sparing(list(map(str, seats)))
    kept = [hide.record(record) for record in records if isinstance(record, Mapping)]
    return {**where, "people": playing, "records": kept}


def records(state: ExportState) -> Iterator[TapeRecord]:
    """Yield the records of all tapes: those of a participant or a session in the order in which they were made."""
    for participant, piece in state.tapes():
        people = piece.get("people", {})
        for record in piece["records"]:
            yield TapeRecord(participant, piece["session"], people, piece["step"], piece["attempt"], record)


def columns(in_sessions: bool) -> list[Column]:
    """Return the columns of `messages`."""
    return [*MESSAGES, *((Column("session"),) if in_sessions else ())]


def messages(state: ExportState, in_sessions: bool) -> Iterator[list[Any]]:
    """Yield a row for each line that was said, or that the agent's `moderate` has held back.

    `participant` is who has said it, None if it was the agent. `replySeconds` is the
    time since the line that it answers: for a line of the agent's `reply`, the line that it was asked; else the last
    line of somebody else that its speaker has read, if that is newer than their own last line.
    """
    game: object = None
    before: list[_Said] = []
    for found in records(state):
        owner = found.participant.user if found.participant else found.session
        if (owner, found.step) != game:
            game, before = (owner, found.step), []
        line = found.record
        if line.get("kind") != "line":
            continue
        by, time, typed = str(line.get("by", "")), when(line.get("time")), as_whole(line.get("typed"))
        to = line.get("to")
        held = line.get("held") is True
        number = found.participant.number if found.participant and "id" in line else found.people.get(by)
        answered = None if held or time is None else _answered(line, by, before)
        yield [
            number,
            found.step,
            found.attempt,
            as_whole(line.get("episode")),
            as_whole(line.get("step")),
            as_whole(line.get("n")),
            clean(by),
            " ".join(clean(str(name)) for name in to) if isinstance(to, list) else None,
            time,
            _text(line.get("text")),
            None if answered is None or time is None else round((time - answered).total_seconds(), 3),
            None if typed is None else typed / 1000,
            "true" if held else None,
            _text(line.get("original")),
            *([found.session] if in_sessions else ()),
        ]
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


def _text(value: Any) -> str | None:
    return clean(value) if isinstance(value, str) else None
