"""The trial server: runs the trial of one participant or one session, and talks to the browsers (docs/wire.md).

Experiments that were written for Interactive Gym import its modules from this package (docs/interactive-gym.md). Each
module is loaded at its first use, so that importing the package stays cheap.
"""

from __future__ import annotations

import importlib
import importlib.machinery
import sys
from typing import Any

_INTERACTIVE_GYM = {
    "RemoteConfig": "remote_config.RemoteConfig",
    "remote_config": "remote_config",
    "configuration_constants": "configuration_constants",
    "object_contexts": "object_contexts",
    "render_configs": "render_configs",
    "server_app": "server_app",
    "app": "server_app",
    "gym_scene": "scenes",
    "static_scene": "scenes",
    "scene": "scenes",
    "stager": "scenes",
    "experiment_config": "scenes",
    "callback": "callback",
    "remote_game": "remote_game",
    "inference_utils": "inference_utils",
    "onnx_inference_utils": "onnx_inference_utils",
}
_PAGE = "write its pages as files of steps/ (docs/pages.md)"
_PART = "it is a part of Interactive Gym's own server: take the import out"
_MISSING = {
    "unity_scene": "games made with Unity are not played here",
    "constructors": _PAGE,
    "utils": "write `from trial import onnx_inference_utils`, or take the import of server/utils.py out",
    "game_manager": _PART,
    "pyodide_game_coordinator": _PART,
    "typing": "its names are for type checkers alone: take the import out",
    "configurations": "write `from trial import remote_config` and the like",
    "scenes": "write `from trial import static_scene` and the like",
}
"""The modules and packages of Interactive Gym that are not here, and what to do."""


def __getattr__(name: str) -> Any:
    """Load a name of Interactive Gym: `from trial import RemoteConfig`.

    Raises ImportError with a sentence for a module of Interactive Gym that is not here.
    """
    if name in _MISSING:
        raise ImportError(f"Interactive Gym's {name} is not in Hippodrome: {_MISSING[name]} (docs/interactive-gym.md)")
    if name not in _INTERACTIVE_GYM:
        raise AttributeError(f"module 'trial' has no attribute {name!r}")
    module, _, attribute = _INTERACTIVE_GYM[name].partition(".")
    found = importlib.import_module(f"trial.interactive_gym.{module}")
    return getattr(found, attribute) if attribute else found


class _InteractiveGymFinder:
    """Imports Interactive Gym's modules as modules of `trial`: `from trial.remote_game import RemoteGame`.

    It is the last finder of `sys.meta_path`, so it hides no module of this package.
    """

    @staticmethod
    def find_spec(name: str, _path: Any = None, _target: Any = None) -> Any:
        module = name.removeprefix("trial.")
        if module != name and module in _MISSING:
            __getattr__(module)
        if module in (name, "RemoteConfig") or module not in _INTERACTIVE_GYM:
            return None
        return importlib.machinery.ModuleSpec(name, _InteractiveGymFinder)  # type: ignore[arg-type]

    @staticmethod
    def create_module(_spec: Any) -> None:
        """Return None: Python makes the usual empty module, which `exec_module` replaces."""

    @staticmethod
    def exec_module(module: Any) -> None:
        sys.modules[module.__name__] = __getattr__(module.__name__.removeprefix("trial."))


sys.meta_path.append(_InteractiveGymFinder)
