"""Reads the fields that a participant sends, as a form or as a JSON object, from untrusted bytes."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple
from urllib.parse import parse_qsl

from hippodrome.control.http import Refusal, Request
from hippodrome.control.model.texts import ENGLISH, Texts

MAX_BODY = 256 * 1024  # bytes
MAX_FIELDS = 2_000
MAX_DEPTH = 20  # levels of lists and objects in JSON: stored documents are indented, so each level makes lines longer
FORM = "application/x-www-form-urlencoded"
JSON = "application/json"
_WHOLE = re.compile(r"[0-9]{1,12}")
STEP, TICKET, SHOWN, ACTION = (f"hippodrome-{name}" for name in ("step", "ticket", "shown", "action"))  # hidden fields


class BadForm(Refusal):
    """The form is refused. `status` is the HTTP status, `text` the reason in English.

    `name` is the name of that text, if studies may have their own words for it (`model/texts.py`).
    """

    def __init__(self, status: int, text: str = "", *, name: str = "") -> None:
        super().__init__(status, text or ENGLISH[name])
        self._name = name

    def reason(self, texts: Texts) -> str:
        """Return the reason in the study's own words if it has a name, otherwise in English."""
        return texts[self._name] if self._name else self.text


@dataclass(frozen=True)
class PostedForm:
    """The answers of one page, and the hidden fields that the page's frame adds."""

    answers: Mapping[str, Any]  # a name that occurs twice, as checkboxes may have it, has a list of values
    step: str | None = None
    ticket: str | None = None
    action: str | None = None
    shown: str | None = None  # which try the page showed, and since when: see `Showing`


class Showing(NamedTuple):
    """A showing of a page whose tries or time are limited: the number of the try, and when the participant came to the
    step, in seconds.
    """

    number: int
    since: int

    @classmethod
    def read(cls, text: str | None) -> Showing | None:
        """Read the text in a form; None if it is none of a showing."""
        number, _, at = (text or "").partition(" ")
        return cls(int(number), int(at)) if _WHOLE.fullmatch(number) and _WHOLE.fullmatch(at) else None

    def __str__(self) -> str:
        return f"{self.number} {self.since}"


def read(request: Request) -> PostedForm:
    """Read the form in a request's body. Raises `BadForm`."""
    if request.body is None:
        raise BadForm(400, name="formUnread")
    if len(request.body) > MAX_BODY:
        raise BadForm(413, name="formTooLong")
    if request.content_type == FORM:
        fields = _urlencoded(request.body)
    elif request.content_type == JSON:
        fields = _json(request.body)
    else:
        raise BadForm(415, "Answers are accepted from a form or as JSON, and this was neither.")
    return _form(fields)


def read_query(query: Iterable[tuple[str, str]]) -> PostedForm:
    """Read the form in the fields of a query."""
    return _form(_gather(list(query)))


def _form(fields: dict[str, Any]) -> PostedForm:
    step, ticket, action, shown = (_text(fields.pop(name, None)) for name in (STEP, TICKET, ACTION, SHOWN))
    return PostedForm(fields, step, ticket, action, shown)


def _urlencoded(body: bytes) -> dict[str, Any]:
    try:
        pairs = parse_qsl(body.decode("utf-8"), keep_blank_values=True, max_num_fields=MAX_FIELDS, errors="strict")
    except UnicodeError:
        raise BadForm(400, "What your browser sent is not text in UTF-8.") from None
    except ValueError:
        raise BadForm(400, f"There are more than {MAX_FIELDS} fields in this form.") from None
    return _gather(pairs)


def _json(body: bytes) -> dict[str, Any]:
    try:
        data = json.loads(body.decode("utf-8"), object_pairs_hook=_gather)
        # Lone surrogates cannot be stored; NaN, which is no JSON, and 1e999 would be stored as nothing.
        json.dumps(data, ensure_ascii=False, allow_nan=False).encode("utf-8")
    except (ValueError, RecursionError):
        raise BadForm(400, "What was sent is not JSON in UTF-8.") from None
    if not isinstance(data, dict):
        raise BadForm(400, "Answers must be a JSON object: names with their values.")
    if len(data) > MAX_FIELDS:
        raise BadForm(400, f"There are more than {MAX_FIELDS} answers.")
    if _deeper(data, MAX_DEPTH):
        raise BadForm(400, f"Answers are nested more than {MAX_DEPTH} levels deep.")
    return data


def _deeper(data: Any, most: int) -> bool:
    """Whether JSON data has more than `most` levels of lists and objects."""
    level = [data]
    for _ in range(most):
        groups = [
            value.values() if isinstance(value, dict) else value for value in level if isinstance(value, dict | list)
        ]
        level = [value for group in groups for value in group]
        if not level:
            return False
    return any(isinstance(value, dict | list) for value in level)


def _gather(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A mapping of names to values; a name that occurs several times has the list of its values, in order."""
    values_of: dict[str, list[Any]] = {}
    for name, value in pairs:
        values_of.setdefault(name, []).append(value)
    return {name: values[0] if len(values) == 1 else values for name, values in values_of.items()}


def _text(value: Any) -> str | None:
    """A hidden field as text; None if it is no text. A client may send it twice, with the same value."""
    if isinstance(value, list) and value and all(value_part == value[0] for value_part in value):
        value = value[0]
    return value if isinstance(value, str) else None
