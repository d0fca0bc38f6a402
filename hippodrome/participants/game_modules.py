"""The modules of `web/game/` that only some projects need, and which projects those are.

The game page of every project carries `main.js` and what that imports. A module in this table adds itself to
`web/game/hooks.js` when it is loaded; `main.js` does not import it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

MODULES: Mapping[str, Callable[[Mapping[str, Any]], bool]] = {}
"""By file name in `web/game/`: whether a project with this `trial` section, as it is registered, needs the module."""


def of(trial: Mapping[str, Any]) -> tuple[str, ...]:
    """The names of the modules that a project needs besides those of every project."""
    return tuple(name for name, needed in MODULES.items() if needed(trial))
