"""Reads the fields in the pages of a study: their order, and which of them send numbers or lists.

So a column has the same place and type whatever the participants have sent so far: `2.50` in a field for numbers is a
number, and one ticked box of several is a list.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from enum import StrEnum

from hippodrome.control.config.step_files import LIMIT_BYTES
from hippodrome.control.model.project import Project
from hippodrome.control.participants.page_parser import PageParser, attributes_of
from hippodrome.export.source import FileGone, Source, TooLarge


class FieldKind(StrEnum):
    """The kind of the values that a field sends, by its page."""

    NUMBER = "number"
    LIST = "list"
    TEXT = "text"  # text, and the kinds that are not listed


def read_fields(source: Source, project: Project | None) -> dict[tuple[str, str], FieldKind]:
    """Return the kinds of the fields in the study's pages, by step and name, in the order of the pages.

    A field whose kind differs between its step's pages for groups has the kind TEXT. Pages that cannot be
    read are left out.
    """
    if project is None:
        return {}
    found: dict[tuple[str, str], set[FieldKind]] = {}
    for step in project.steps:
        for file in step.files:
            for name, kind in fields_of(_page(source, project.page_key(file))).items():
                found.setdefault((step.key, name), set()).add(kind)
    return {field: kinds.pop() if len(kinds) == 1 else FieldKind.TEXT for field, kinds in found.items()}


def fields_of(page: str) -> Mapping[str, FieldKind]:
    """Return the kinds of the fields of one page, by name, in the order of the page. Jinja is not rendered."""
    reader = _Reader()
    reader.feed(page)
    reader.close()
    return dict(reader.kinds())


def _page(source: Source, key: str) -> str:
    try:
        return source.read(key, LIMIT_BYTES).decode("utf-8", "replace")
    except (FileGone, TooLarge):  # the types of columns then follow from the answers
        return ""


class _Reader(PageParser):
    """Counts the kinds of a page's fields, by name."""

    def __init__(self) -> None:
        super().__init__()
        self._counts: dict[str, Counter[str]] = {}

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = attributes_of(attrs)
        kind = tag
        if tag == "input":
            kind = attributes.get("type", "").strip().lower()
        elif tag == "select" and "multiple" in attributes:
            kind = "select multiple"
        if tag in ("input", "select", "textarea", "button") and attributes.get("name"):
            self._counts.setdefault(attributes["name"], Counter())[kind] += 1

    def kinds(self) -> Iterator[tuple[str, FieldKind]]:
        for name, counts in self._counts.items():
            match [*counts.items()]:
                case [("number" | "range", 1)]:
                    yield name, FieldKind.NUMBER
                case [("checkbox", count)] if count > 1:
                    yield name, FieldKind.LIST
                case [("select multiple", 1)]:
                    yield name, FieldKind.LIST
                case _:
                    yield name, FieldKind.TEXT
