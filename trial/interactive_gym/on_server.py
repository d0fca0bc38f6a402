"""Loads the experiment's file on a participant's server, for the generated agent.py."""

from __future__ import annotations

import contextlib
import importlib.util
import sys
from pathlib import Path
from typing import Any

from trial.interactive_gym import playing
from trial.interactive_gym.remote_config import RemoteConfig
from trial.interactive_gym.scenes import game_of

_loading = False


def is_loading() -> bool:
    """Whether `load` is importing an experiment's file. Meanwhile `server_app.run` does nothing."""
    return _loading


class Experiment:
    """An experiment, and the folder of the project that was made from it."""

    def __init__(self, folder: Path, config: RemoteConfig) -> None:
        self._config = config
        self._locate = playing.located(folder)

    def agent(self) -> type:
        """Make the class `Agent` of the experiment."""
        return playing.agent_class(self._config)

    def policy(self, player: Any) -> type:
        """Make the class of the policy that plays this player."""
        return playing.policy_class(self._config, player, self._locate)


def load(agent_file: str, module: str, name: str) -> Experiment:
    """Load the experiment whose config is the variable `name` of `module`, a file beside agent.py.

    The module is imported under its own name, so code below `if __name__ == "__main__"` does not run. Raises Unplayable
    if there is no such config, and what the module raises.
    """
    folder = Path(agent_file).resolve().parent
    if str(folder) not in sys.path:
        sys.path.append(str(folder))
    config = game_of(getattr(_imported(folder, module), name, None))
    if not isinstance(config, RemoteConfig):
        raise playing.Unplayable(f"{module} has no RemoteConfig called {name}; run the experiment's file again")
    return Experiment(folder, config)


def _imported(folder: Path, module: str) -> Any:
    """Import the module from the project's folder, even if another module has the same name."""
    global _loading  # noqa: PLW0603 - one import at a time
    path = folder / f"{module.replace('.', '/')}.py"
    spec = importlib.util.spec_from_file_location(module, path)
    if spec is None or spec.loader is None:
        raise playing.Unplayable(f"there is no {path.name} beside agent.py; run the experiment's file again")
    loaded = importlib.util.module_from_spec(spec)
    sys.modules[module] = loaded
    _loading = True
    try:
        with contextlib.chdir(folder):  # the experiment may read files by their relative paths
            spec.loader.exec_module(loaded)
    finally:
        _loading = False
    return loaded
