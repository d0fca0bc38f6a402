"""Reads the fields in the pages of a study: their order, and which of them send numbers or lists.

So a column has the same place and type whatever the participants have sent so far: `2.50` in a field for numbers is a
number, and one ticked box of several is a list.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum

from hippodrome.control.config.step_files import LIMIT_BYTES
from hippodrome.control.model.project import Project
from hippodrome.control.participants import markup
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
    kinds: dict[str, list[str]] = {}
    for token in markup.tokens(page):
        attributes, kind = markup.attributes(token.attributes), token.start
        if token.start == "input":
            kind = attributes.get("type", "").strip().lower()
        elif token.start == "select" and "multiple" in attributes:
            kind = "select multiple"
        if token.start in ("input", "select", "textarea", "button") and attributes.get("name"):
            kinds.setdefault(attributes["name"], []).append(kind)
    return {name: _kind(of_name) for name, of_name in kinds.items()}


def _kind(kinds: list[str]) -> FieldKind:
    """The kind of the values of one name, of whose inputs these are the types."""
    match kinds:
        case ["number" | "range"]:
            return FieldKind.NUMBER
        case ["select multiple"]:
            return FieldKind.LIST
        case [_, _, *_] if set(kinds) == {"checkbox"}:
            return FieldKind.LIST
        case _:
            return FieldKind.TEXT


def _page(source: Source, key: str) -> str:
    try:
        return source.read(key, LIMIT_BYTES).decode("utf-8", "replace")
    except (FileGone, TooLarge):  # the types of columns then follow from the answers
        return ""
