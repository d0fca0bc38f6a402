"""The fields that a participant sends, as a form or as a JSON object, read from untrusted bytes."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any
from urllib.parse import parse_qsl

from hippodrome.http import Request
from hippodrome.model.texts import ENGLISH, Texts

MAX_BODY = 256 * 1024  # bytes
MAX_FIELDS = 2_000
MAX_DEPTH = (
    20  # levels of lists and objects in JSON: stored documents are indented, so each level makes every line longer
)
FORM = "application/x-www-form-urlencoded"
JSON = "application/json"
STEP, TICKET, ACTION = "hippodrome-step", "hippodrome-ticket", "hippodrome-action"


class BadForm(Exception):
    """The form is refused. `status` is the HTTP status, `text` the reason, in English."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status, self.text = status, text

    def reason(self, texts: Texts) -> str:
        """The reason in a study's own words, or in English if it has none for it."""
        return self.text


class BadPageForm(BadForm):
    """The same of a form that one of our pages can send. `name` is that of a text; a study may have its own for it."""

    def __init__(self, status: int, name: str) -> None:
        super().__init__(status, ENGLISH[name])
        self._name = name

    def reason(self, texts: Texts) -> str:
        """The study's text of this name."""
        return texts[self._name]


@dataclass(frozen=True)
class PostedForm:
    """The answers of one page, and the hidden fields of the frame."""

    answers: Mapping[str, Any]  # a field named twice (checkboxes) holds a list
    step: str | None = None
    ticket: str | None = None
    action: str | None = None


def read(request: Request) -> PostedForm:
    """Return the form in a request. Raises `BadForm`."""
    if request.body is None:
        raise BadPageForm(400, "formUnread")
    if len(request.body) > MAX_BODY:
        raise BadPageForm(413, "formTooLong")
    if request.content_type == FORM:
        fields = _urlencoded(request.body)
    elif request.content_type == JSON:
        fields = _json(request.body)
    else:
        raise BadForm(415, "Answers are accepted from a form or as JSON, and this was neither.")
    return _form(fields)


def of_query(query: Iterable[tuple[str, str]]) -> PostedForm:
    """The form in a query's fields."""
    return _form(_gather(list(query)))


def _form(fields: dict[str, Any]) -> PostedForm:
    step, ticket, action = (_text(fields.pop(name, None)) for name in (STEP, TICKET, ACTION))
    return PostedForm(fields, step, ticket, action)


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
        data = json.loads(body.decode("utf-8"), object_pairs_hook=_gather, parse_constant=_no_constant)
        # Lone surrogates cannot be stored, and 1e999 would be stored as nothing.
        json.dumps(data, ensure_ascii=False, allow_nan=False).encode("utf-8")
    except (ValueError, RecursionError):
        raise BadForm(400, "What was sent is not JSON in UTF-8.") from None
    if not isinstance(data, dict):
        raise BadForm(400, "Answers are a JSON object: names with their values.")
    if len(data) > MAX_FIELDS:
        raise BadForm(400, f"There are more than {MAX_FIELDS} answers.")
    if _deeper(data, MAX_DEPTH):
        raise BadForm(400, f"Answers are nested more than {MAX_DEPTH} levels deep.")
    return data


def _deeper(data: Any, most: int) -> bool:
    """Whether JSON data has more than so many levels of lists and objects."""
    level = [data]
    for _ in range(most):
        groups = [each.values() if isinstance(each, dict) else each for each in level if isinstance(each, dict | list)]
        level = [each for group in groups for each in group]
        if not level:
            return False
    return any(isinstance(each, dict | list) for each in level)


def _gather(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """A mapping of names to values; a name that is there twice gets the list of its values, in order."""
    seen: dict[str, list[Any]] = {}
    for name, value in pairs:
        seen.setdefault(name, []).append(value)
    return {name: values[0] if len(values) == 1 else values for name, values in seen.items()}


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


def _text(value: Any) -> str | None:
    """A hidden field as text. It may be there twice with the same value: a client's form may already contain it."""
    if isinstance(value, list) and value and all(each == value[0] for each in value):
        value = value[0]
    return value if isinstance(value, str) else None
