"""Joins the ES modules of a script into the one script that a page carries.

`web/game/` is written as modules that browsers could load one by one. That would cost a request for each, one after the
other along their imports, on a page that people open on bad Wi-Fi, and a page without one of them would not work. So
the page carries all of them, in the order in which a browser would run them. They then share one scope: no top-level
name may occur in two of them, and an import keeps its name (`tests/hippodrome/participants/test_scripts.py`).
"""

from __future__ import annotations

import re
from pathlib import Path

_IMPORT = re.compile(r'^import \{\s*\w+(?:,\s*\w+)*,?\s*\} from "\./([\w-]+\.js)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=async |const |function |let )", re.MULTILINE)
_LEFT = re.compile(r"^(?:import|export)\b.*", re.MULTILINE)


def join(main: Path, also: tuple[str, ...] = ()) -> str:
    """The script of this module and of all that it imports, each once and after what it imports itself.

    `also` are modules beside it that it does not import: they and what they import stand before it.
    Raises ValueError for an import or export of another form.
    """
    found: dict[Path, str] = {}
    for module in (*map(main.with_name, also), main):
        if module not in found:
            _add(module, found)
    return "".join(found.values())


def _add(module: Path, found: dict[Path, str], above: tuple[Path, ...] = ()) -> None:
    if module in above:
        raise ValueError(f"{module.name} imports itself, by way of {above[-1].name}")
    source = module.read_text(encoding="utf-8")
    for name in _IMPORT.findall(source):
        if module.with_name(name) not in found:
            _add(module.with_name(name), found, (*above, module))
    script = _EXPORT.sub("", _IMPORT.sub("", source))
    if left := _LEFT.search(script):
        raise ValueError(f"{module.name} cannot be joined: {left[0]}")
    found[module] = script
