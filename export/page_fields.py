"""What the pages of a study say of their fields: in which order they stand, which send numbers, and which send lists.

So a column has the same place and the same type whatever was sent so far: `2.50` in a field for numbers is a number,
and one ticked box of several is a list.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from enum import StrEnum

from botocore.exceptions import ClientError

from export.source import FileGone, Source, TooLarge
from hippodrome.model.project import Project
from hippodrome.participants.page_parser import PageParser

_MOST = 1024 * 1024  # bytes of a page, as in docs/config.md


class FieldKind(StrEnum):
    """What a field sends, as far as its page tells."""

    NUMBER = "number"
    LIST = "list"
    TEXT = "text"  # or whatever else


def read_fields(source: Source, project: Project | None) -> dict[tuple[str, str], FieldKind]:
    """By step and name, the fields of the pages that are there, in the order of the pages.

    A field that is not of one kind on all pages of its step is one of texts.
    """
    found: dict[tuple[str, str], set[FieldKind]] = {}
    if project is None:
        return {}
    for step in project.steps:
        for file in step.files:
            for name, kind in fields_of(_page(source, project.page_key(file))).items():
                found.setdefault((step.key, name), set()).add(kind)
    return {field: kinds.pop() if len(kinds) == 1 else FieldKind.TEXT for field, kinds in found.items()}


def fields_of(page: str) -> Mapping[str, FieldKind]:
    """The fields of one page. Jinja stays as it is: what it makes of a field is not known here."""
    reader = _Reader()
    reader.feed(page)
    reader.close()
    return dict(reader.kinds())


def _page(source: Source, key: str) -> str:
    try:
        return source.read(key, _MOST).decode("utf-8", "replace")
    except (FileGone, TooLarge, ClientError):  # the types of columns then follow from what was sent
        return ""


class _Reader(PageParser):
    """Counts, by name, the kinds of a page's fields."""

    def __init__(self) -> None:
        super().__init__()
        self._seen: dict[str, Counter[str]] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = {name: value or "" for name, value in reversed(attrs)}  # of equal attributes the first counts
        kind = {"input": given.get("type", "").strip().lower(), "select": f"select {'multiple' in given}"}.get(tag, tag)
        if tag in ("input", "select", "textarea", "button") and given.get("name"):
            self._seen.setdefault(given["name"], Counter())[kind] += 1

    def kinds(self) -> Iterator[tuple[str, FieldKind]]:
        for name, seen in self._seen.items():
            match [*seen.items()]:
                case [("number" | "range", 1)]:
                    yield name, FieldKind.NUMBER
                case [("checkbox", count)] if count > 1:
                    yield name, FieldKind.LIST
                case [("select True", 1)]:
                    yield name, FieldKind.LIST
                case _:
                    yield name, FieldKind.TEXT
