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
    "stager": "scenes",
    "experiment_config": "scenes",
    "callback": "callback",
    "remote_game": "remote_game",
    "inference_utils": "inference_utils",
    "onnx_inference_utils": "onnx_inference_utils",
}


def __getattr__(name: str) -> Any:
    """Load a name of Interactive Gym: `from trial import RemoteConfig`."""
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
