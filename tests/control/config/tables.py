"""`python -m tests.control.config.tables`: write what the documentation says of each key, from its declaration.

That is docs/config.schema.json, and the tables of keys in docs/config.md, docs/objects.md and docs/talk.md. The rows of a table keep
their order; the row of a new key comes after the row of the key that is declared before it.
"""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

from hippodrome.control.config import config_schema
from hippodrome.control.config.project_keys import SECTIONS
from hippodrome.protocol.section_keys import Key, Section, keys

DOCS = Path(__file__).resolve().parents[3] / "docs"
PAGES = (DOCS / "config.md", DOCS / "objects.md", DOCS / "talk.md")
SCHEMA = DOCS / "config.schema.json"
TABLE = re.compile(r"(?<=<!-- the keys of )(\S+)(, made by .* -->\n\n)((?:\|.*\n)+)")
HEAD = ("key", "meaning", "type", "default", "example")


def page_with_tables(text: str) -> str:
    """Return the page with its tables as the declarations have them."""
    return TABLE.sub(lambda found: found[1] + found[2] + _table(SECTIONS[tuple(found[1].split("."))], found[3]), text)


def schema() -> str:
    """Return the text of docs/config.schema.json."""
    return json.dumps(config_schema(), indent=2, ensure_ascii=False) + "\n"


def _table(section: type[Section], before: str) -> str:
    declared = {key.name: key for key in keys(section)}
    order = [name for name in re.findall(r"^\| `(\w+)`", before, re.MULTILINE) if name in declared]
    for name, previous in zip(declared, ["", *declared], strict=False):
        if name not in order:
            order.insert(order.index(previous) + 1 if previous else 0, name)
    columns = len(HEAD) if any(key.example for key in declared.values()) else len(HEAD) - 1
    cells = [HEAD, ("---",) * len(HEAD), *(_cells(declared[name]) for name in order)]
    rows = [row[:columns] for row in cells]
    return (
        "".join(f"| {' | '.join(row)} |\n".replace("|  |", "| |") for row in rows)
        .replace("| --- |", "|---|")
        .replace(" --- |", "---|")
    )


def _cells(key: Key) -> tuple[str, ...]:
    default = "**needed**" if key.needed else key.otherwise or _in_words(key.default)
    return f"`{key.name}`", key.meaning, key.kind or _kind(key), default, f"`{key.example}`" if key.example else ""


def _kind(key: Key) -> str:
    match key.schema:
        case {"enum": [*words]}:
            quoted = [f"`{word}`" for word in words]
            return f"{', '.join(quoted[:-1])} or {quoted[-1]}"
        case {"minimum": low, "maximum": high}:
            return f"{low} to {high}"
        case {"type": "boolean"}:
            return "true/false"
        case {"type": "string"}:
            return "text"
    assert key.section, f"{key.name}: its declaration needs a `kind`, the possible values in words"
    return "section"


def _in_words(default: Any) -> str:
    if default == "":
        return "empty"
    if default is None or default == ():
        return "none"
    if isinstance(default, tuple):
        return f"`[{', '.join(default)}]`"
    return f"`{json.dumps(default) if not isinstance(default, str) or '#' in default else default}`"


if __name__ == "__main__":
    for page in PAGES:
        page.write_text(page_with_tables(page.read_text(encoding="utf-8")), encoding="utf-8")
    SCHEMA.write_text(schema(), encoding="utf-8")
