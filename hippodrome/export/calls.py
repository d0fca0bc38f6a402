"""Makes the table of calls of language models, of the tapes of games (`trial/llm/endpoint.py` records them)."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from hippodrome.export import talk
from hippodrome.export.recording_columns import as_whole, when
from hippodrome.export.scrub import clean
from hippodrome.export.state import ExportState
from hippodrome.export.table_files import Column

KIND = "call"
CALLS = (
    Column("participant"),
    Column("studyStep"),
    Column("attempt", "whole"),
    Column("episode", "whole"),
    Column("step", "whole"),
    Column("n", "whole"),
    Column("time", "time"),
    Column("milliseconds", "whole"),
    Column("path"),
    Column("model"),
    Column("status", "whole"),
    Column("error"),
    Column("inputTokens", "whole"),
    Column("outputTokens", "whole"),
    Column("estimated"),
    Column("hash"),
)


def columns(in_sessions: bool) -> list[Column]:
    """Return the columns of `calls`."""
    return [*CALLS, *((Column("session"),) if in_sessions else ())]


def has_calls(state: ExportState) -> bool:
    """Return whether a language model was asked."""
    return any(found.record.get("kind") == KIND for found in talk.records(state))


def calls(state: ExportState, in_sessions: bool) -> Iterator[list[Any]]:
    """Yield a row for each call of a language model. `n` is the number of the line that was being answered."""
    for found in talk.records(state):
        call = found.record
        if call.get("kind") != KIND:
            continue
        tokens = call.get("tokens")
        tokens = tokens if isinstance(tokens, Mapping) else {}
        yield [
            found.participant.number if found.participant else None,
            found.step,
            found.attempt,
            *(as_whole(call.get(name)) for name in ("episode", "step", "line")),
            when(call.get("time")),
            as_whole(call.get("ms")),
            _text(call.get("path")),
            _text(call.get("model")),
            as_whole(call.get("status")),
            _code_of(call.get("answer")),
            as_whole(tokens.get("input")),
            as_whole(tokens.get("output")),
            "true" if tokens.get("estimated") is True else None,
            _text(call.get("hash")),
            *([found.session] if in_sessions else ()),
        ]


def _code_of(answer: Any) -> str | None:
    """Return the code of the error that an answer is, such as `timeout`; None if it is none."""
    error = answer.get("error") if isinstance(answer, Mapping) else None
    return _text(error.get("code")) if isinstance(error, Mapping) else None


def _text(value: Any) -> str | None:
    return clean(value) if isinstance(value, str) else None
