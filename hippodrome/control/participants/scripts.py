"""Joins the ES modules of a script into the one script that a page carries.

`hippodrome/web/game/` has modules that browsers could load one by one. That would take one request after the other
along their imports, also on bad Wi-Fi, and without one of them the page would not work. So the page contains all of
them, in the order in which a browser would run them. They share one scope then: no top-level name may occur in two of
them, and an import must keep its name (`tests/control/participants/test_scripts.py`).
"""

from __future__ import annotations

import re
from pathlib import Path

_IMPORT = re.compile(r'^import \{\s*\w+(?:,\s*\w+)*,?\s*\} from "\./([\w/-]+\.js)";\n', re.MULTILINE)
_EXPORT = re.compile(r"^export (?=async |const |function |let )", re.MULTILINE)
_LEFT = re.compile(r"^(?:import|export)\b.*", re.MULTILINE)


def join(main: Path, also: tuple[str, ...] = ()) -> str:
    """Return one script with this module and all modules that it imports: each once, after its own imports.

    `also` are modules in the same folder that `main` does not import. They and their imports come before it. Raises
    ValueError for an import or export of another form, and if a module imports itself.
    """
    modules: dict[Path, str] = {}
    for module in (*map(main.with_name, also), main):
        if module not in modules:
            _add(module, modules)
    return "".join(modules.values())


def _add(module: Path, modules: dict[Path, str], above: tuple[Path, ...] = ()) -> None:
    if module in above:
        raise ValueError(f"{module.name} imports itself, by way of {above[-1].name}")
    source = module.read_text(encoding="utf-8")
    for name in _IMPORT.findall(source):
        if module.parent / name not in modules:
            _add(module.parent / name, modules, (*above, module))
    script = _EXPORT.sub("", _IMPORT.sub("", source))
    if match := _LEFT.search(script):
        raise ValueError(f"{module.name} cannot be joined: {match[0]}")
    modules[module] = script
