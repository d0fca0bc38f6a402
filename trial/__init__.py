"""The trial server: runs one participant's trial and talks to their browser. Stands alone; see docs/wire.md.

The names of `_INTERACTIVE_GYM` are for experiments written for Interactive Gym (docs/interactive-gym.md). They are
imported when they are asked for, so that importing this package stays cheap.
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
    """`from trial import RemoteConfig`, and the other words of Interactive Gym."""
    if name not in _INTERACTIVE_GYM:
        raise AttributeError(f"module 'trial' has no attribute {name!r}")
    module, _, attribute = _INTERACTIVE_GYM[name].partition(".")
    found = importlib.import_module(f"trial.interactive_gym.{module}")
    return getattr(found, attribute) if attribute else found


class _Words:
    """`from trial.remote_game import RemoteGame`: the modules of Interactive Gym under their own names.

    They are found after all else, so that no module of this package is hidden.
    """

    @staticmethod
    def find_spec(name: str, _path: Any = None, _target: Any = None) -> Any:
        word = name.removeprefix("trial.")
        if word in (name, "RemoteConfig") or word not in _INTERACTIVE_GYM:
            return None
        return importlib.machinery.ModuleSpec(name, _Words)  # type: ignore[arg-type]

    @staticmethod
    def create_module(_spec: Any) -> None:
        """The usual empty one, which `exec_module` replaces."""

    @staticmethod
    def exec_module(module: Any) -> None:
        sys.modules[module.__name__] = __getattr__(module.__name__.removeprefix("trial."))


sys.meta_path.append(_Words)
