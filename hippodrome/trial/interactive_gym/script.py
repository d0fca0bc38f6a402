"""Runs the script of an experiment, until it calls Interactive Gym's `run`.

While a process has loaded an experiment, Interactive Gym's module names lead to the modules of this package; no other
process of Hippodrome knows these names.
"""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from collections.abc import Sequence
from importlib.machinery import ModuleSpec, PathFinder
from pathlib import Path
from typing import Any

from hippodrome.trial.agent.loading import add_to_path
from hippodrome.trial.interactive_gym.options import RemoteConfig, Unplayable
from hippodrome.trial.interactive_gym.scenes import game_of

_MODULES = {
    "configurations.remote_config": "options",
    "configurations.configuration_constants": "options",
    "configurations.object_contexts": "objects",
    "configurations.render_configs": "objects",
    "configurations.experiment_config": "scenes",
    "scenes.scene": "scenes",
    "scenes.gym_scene": "scenes",
    "scenes.static_scene": "scenes",
    "scenes.stager": "scenes",
    "server.server_app": "script",
    "server.app": "script",
    "server.callback": "playing",
    "server.remote_game": "playing",
    "utils.onnx_inference_utils": "inference",
    "utils.inference_utils": "inference",
    "eventlet": "script",
}
"""Interactive Gym's modules, and the modules of this package that have their names.

Scripts import them from `interactive_gym.configurations` or, as in its first version, from `configurations`.
"""
_PACKAGES = {"interactive_gym", *(name.partition(".")[0] for name in _MODULES if "." in name)}


class _Run(BaseException):
    """The script has called `run`. No `except Exception` of the script catches it."""

    def __init__(self, config: Any) -> None:
        self.config = config


def run(config: Any, **_options: Any) -> None:
    """Hand the experiment to `load`: Interactive Gym's `app.run(config)`, with which a script ends."""
    raise _Run(config)


def monkey_patch(**_options: Any) -> None:
    """Do nothing: scripts call `eventlet.monkey_patch()` first, and here Python's threads stay as they are."""


class _Finder:
    """Finds those modules of Interactive Gym that are here. Others, such as its examples, are the researcher's."""

    @staticmethod
    def find_spec(name: str, path: Any = None, _target: Any = None) -> Any:
        own_name = name.removeprefix("interactive_gym.")
        if own_name in _MODULES:
            return ModuleSpec(name, _Finder)  # type: ignore[arg-type]
        if own_name in _PACKAGES:
            return PathFinder.find_spec(name, path) or ModuleSpec(name, None, is_package=True)
        return None

    @staticmethod
    def create_module(_spec: Any) -> None:
        """Return None: Python makes the usual empty module, which `exec_module` replaces."""

    @staticmethod
    def exec_module(module: Any) -> None:
        own_name = module.__name__.removeprefix("interactive_gym.")
        sys.modules[module.__name__] = importlib.import_module(f"hippodrome.trial.interactive_gym.{_MODULES[own_name]}")


def load(script: str, arguments: Sequence[str], folder: Path) -> tuple[RemoteConfig, dict[str, Any]]:
    """Run the script at this path below `folder`, in this folder. Return its game's config, and the script's variables.

    Raises Unplayable if it does not call `run` with a game that can be played here, and what the script raises.
    """
    if _Finder not in sys.meta_path:
        sys.meta_path.insert(0, _Finder)
    path = folder / script
    add_to_path(path.parent, folder)
    name = ".".join(Path(script).with_suffix("").parts)
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or not path.is_file():
        raise Unplayable(f"there is no Python file {path}")
    module = importlib.util.module_from_spec(spec)
    module.__name__ = "__main__"
    main, argv = sys.modules["__main__"], sys.argv
    sys.modules["__main__"], sys.argv = module, [str(path), *arguments]
    try:
        with contextlib.chdir(folder):
            exec(spec.loader.get_code(name), vars(module))  # type: ignore[union-attr] # noqa: S102 - the researcher's own
    except _Run as called:
        return game_of(called.config), vars(module)
    finally:
        sys.modules["__main__"], sys.argv = main, argv
    raise Unplayable(f"{script} has ended and has not called run(config)")
