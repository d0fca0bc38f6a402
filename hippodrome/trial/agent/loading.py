"""Finds the researcher's agent: `Agent` of agent.py, its functions, or else the default one.

Also what an agent finds when it starts: its modules on Python's path, HIPPO's form of its section, the game `talk`.
"""

from __future__ import annotations

import difflib
import importlib.util
import json
import re
import sys
import sysconfig
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

import hippodrome
from hippodrome.protocol import environment, server_modules
from hippodrome.protocol.similar import nearest
from hippodrome.trial.agent import environments

METHODS = ("start", "step", "render", "reset", "close")
"""The five methods of an agent."""
_OLD_GYM = Path(__file__).with_name("old_gym")
_OLD_ATARI = re.compile(r"[A-Z]\w*-v[04]")
_OURS = str(Path(hippodrome.__path__[0]).resolve().parent)


class AgentError(Exception):
    """The researcher's code does not do what docs/agent.md asks of it. The message is for the researcher."""


class Agent:
    """The agent of a project without an agent.py. Its environment takes the human's actions."""

    def __init__(self) -> None:
        self.env: Any = None

    def start(self, game: str) -> Any:
        """Make and return the environment `game`.

        `game` is an id of Gymnasium (ale_py is imported for ids of Atari games, old ones too), or the name of a module
        that has `parallel_env` or `env`, such as `pettingzoo.butterfly.cooperative_pong_v6`. Raises AgentError if the
        module does not exist or makes no environment, and Gymnasium's error if there is no such id.
        """
        import gymnasium  # noqa: PLC0415 - a researcher's own agent may need no Gymnasium

        if environments.is_module(game) and game not in gymnasium.registry:
            try:
                self.env = environments.made_by_module(game)
            except environments.PlayersUnknown as error:
                raise AgentError(str(error)) from None
            return self.env
        if game.startswith("ALE/") or (game not in gymnasium.registry and _OLD_ATARI.match(game)):
            import ale_py  # noqa: PLC0415

            gymnasium.register_envs(ale_py)
        self.env = gymnasium.make(game, render_mode="rgb_array")
        return self.env

    def step(self, action: int) -> Any:
        """Take the human's action. Return observation, reward, terminated, truncated and info."""
        return self.env.step(action)

    def render(self) -> Any:
        """Return the present picture: height x width x 3 bytes."""
        return self.env.render()

    def reset(self, seed: int | None = None) -> Any:
        """Begin an episode. Return its first observation and info."""
        return self.env.reset(seed=seed)

    def close(self) -> None:
        """Close the environment."""
        self.env.close()


def load(folder: Path, *, talks: bool = False) -> Any:
    """Return the agent of a project folder.

    That is an object of the class `Agent` in the folder's agent.py; or the module agent.py itself, if it has no such
    class but the five functions; or the default agent, if there is no agent.py. agent.py can import the files beside
    it, and `gym`. With `talks` the class needs no `start`. Raises AgentError if methods or functions are missing or a
    file hides a module that servers need, and whatever agent.py itself raises.
    """
    path = folder / "agent.py"
    if not path.is_file():
        return Agent()
    if hiding := server_modules.hiding(folder):  # what a server loads from now on would be the researcher's
        raise AgentError("; ".join(hiding))
    add_to_path(folder)
    if str(_OLD_GYM) not in sys.path:
        sys.path.append(str(_OLD_GYM))  # last, so that it hides no Gym that is installed
    sys.argv = [path.name]  # an agent that reads arguments gets none: this process's differ between check and server
    spec = importlib.util.spec_from_file_location("agent", path)
    if spec is None or spec.loader is None:
        raise AgentError(f"{path.name} cannot be imported")
    module = importlib.util.module_from_spec(spec)
    sys.modules["agent"] = module
    spec.loader.exec_module(module)
    agent_class = getattr(module, "Agent", None)
    if isinstance(agent_class, type):
        missing = missing_methods(agent_class)
        misspelt = {name: near for name in missing for near in _similar_methods(name, agent_class)}
        if misspelt or ("start" in missing and not talks):
            hint = "".join(f"; is {near} meant to be {name}?" for name, near in misspelt.items())
            raise AgentError(f"Agent in {path.name} has no {', '.join(misspelt or missing)}{hint}")
        return agent_class()
    missing = missing_methods(module)
    if len(missing) == len(METHODS):
        raise AgentError(f"{path.name} has no class Agent{_question_about_class(module)}")
    if missing:
        raise AgentError(
            f"{path.name} has no class Agent, and of its functions no {', '.join(missing)}; write these, or a class"
        )
    return module


def missing_methods(methods: Any) -> list[str]:
    """Return which of the five methods an agent lacks."""
    return [name for name in METHODS if not callable(getattr(methods, name, None))]


def _question_about_class(module: Any) -> str:
    """Return a question about a class of the module with a name similar to `Agent`; empty if there is none."""
    near = nearest("Agent", (name for name, found in vars(module).items() if isinstance(found, type)))
    return f"; is {near} meant to be Agent?" if near else ""


def _similar_methods(name: str, agent_class: type) -> list[str]:
    """Return the method of the class whose name is most similar to `name`, as a list; empty if none is similar."""
    # `load` refuses an agent with such a method, so the names must be more similar than for a mere question
    # (`hippodrome/protocol/similar.py`).
    members = {other: getattr(agent_class, other, None) for other in dir(agent_class) if not other.startswith("_")}
    others = [other for other, member in members.items() if callable(member)]
    return difflib.get_close_matches(name, set(others) - set(METHODS), n=1, cutoff=0.88)


def add_to_path(*folders: Path) -> None:
    """Let imports find modules in these folders: after Python's own, and before those of installed packages."""
    sys.path[:] = with_folders(sys.path, [str(folder) for folder in folders])


def with_folders(path: Sequence[str], folders: Sequence[str]) -> list[str]:
    """Return the path with these folders behind the standard library, wherever they were before.

    A clone of Hippodrome that is in PYTHONPATH comes behind them: its `testing/` would hide a researcher's testing.py.
    """
    library = sysconfig.get_path("stdlib")
    standard = {library, f"{library}/lib-dynload"}
    others = [entry for entry in path if entry not in folders]
    end = max((place for place, entry in enumerate(others, 1) if entry in standard), default=0)
    first = [entry for entry in others[:end] if entry != _OURS]
    ours = [entry for entry in others[:end] if entry == _OURS]
    return [*first, *dict.fromkeys(folders), *ours, *others[end:]]


def hippo_config(variables: Mapping[str, str]) -> dict[str, Any]:
    """Read the section `trial` from a server's environment `variables`, and return it in HIPPO's form.

    The keys of `options` stand beside the others, also one that the section has without a value (`instructions`). `ui`
    is a list of the controls that are shown, and `projectId` is the project's id.
    """
    section: dict[str, Any] = json.loads(variables.get(environment.TRIAL) or "{}")
    options, controls = section.pop("options", None) or {}, section.get("ui") or {}
    if isinstance(controls, dict):
        section["ui"] = [name for name, shown in controls.items() if shown is True]
    set_keys = {name: value for name, value in section.items() if value is not None or name not in options}
    return {**options, **set_keys, "projectId": variables.get(environment.PROJECT_ID, "")}


class TalkGame:
    """The built-in game `talk`: participants only talk. Its steps count the time, one a second.

    It is an environment with one action and a picture of one pixel. With `players`, it has several.
    """

    def __init__(self, players: Sequence[str] = ()) -> None:
        self.possible_agents = list(players) if len(players) > 1 else []
        self._end: tuple[Any, bool] | None = None

    def end(self, reward: float | Mapping[str, float] = 0.0, *, success: bool = False) -> None:
        """End the episode within a second, such as when people have agreed. For any thread.

        `reward` is added to the score: a number, or with several players one for each by name. `success` counts for
        `trial.until`.
        """
        self._end = reward, bool(success)

    def get_action_meanings(self) -> list[str]:
        """Return the name of its action."""
        return ["noop"]

    def reset(self, seed: int | None = None, options: Mapping[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin an episode."""
        self._end = None
        return self._for_each(0), self._for_each({})

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Let a second pass."""
        reward, success = self._end or (0.0, False)
        over = self._end is not None
        if isinstance(reward, Mapping) and self.possible_agents:
            rewards: Any = {player: float(reward.get(player, 0.0)) for player in self.possible_agents}
        elif isinstance(reward, Mapping):
            rewards = float(sum(reward.values()))
        else:
            rewards = self._for_each(float(reward))
        info = {"success": True} if success else {}
        return self._for_each(0), rewards, self._for_each(over), self._for_each(False), self._for_each(info)

    def render(self) -> Any:
        """Return a picture of one pixel."""
        return np.zeros((1, 1, 3), np.uint8)

    def close(self) -> None:
        """Do nothing."""

    def _for_each(self, value: Any) -> Any:
        return dict.fromkeys(self.possible_agents, value) if self.possible_agents else value
