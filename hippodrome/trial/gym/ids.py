"""Finds the present id of an environment that a program of Gymie's users names by its id in gym 0.17.

`hippodrome/trial/agent/old_gym` does the same for agents that import gym. That is a package of its own, which imports
nothing of the trial, so it does not use this module.
"""

from __future__ import annotations

import contextlib
import re
from typing import Any

_ID = re.compile(r"(?P<name>.+)-v(?P<version>\d+)")
_OLD_ATARI = re.compile(r"(?P<game>[A-Z]\w*?)(?P<ram>-ram)?(?P<kind>Deterministic|NoFrameskip)?-v(?P<version>[04])")


def present(env_id: str) -> tuple[str, dict[str, Any]]:
    """Find the id under which the environment is registered now, and further arguments for `gymnasium.make`.

    A version that Gymnasium does not have any more becomes the newest one. An unknown id stays as it is. For the id of
    an Atari game, ALE's environments are registered first, if ALE is installed.
    """
    import gymnasium  # noqa: PLC0415 - the process that listens must not import it

    atari = _OLD_ATARI.fullmatch(env_id)
    if (env_id.startswith("ALE/") or atari) and env_id not in gymnasium.registry:
        with contextlib.suppress(ImportError):
            import ale_py  # noqa: PLC0415 - only Atari games need it

            gymnasium.register_envs(ale_py)
    if env_id in gymnasium.registry:
        return env_id, {}
    if atari:
        frameskip = "NoFrameskip" if atari["kind"] == "NoFrameskip" else ""
        plain = f"{atari['game']}{frameskip}-v{atari['version']}"
        if plain in gymnasium.registry:
            options = {"frameskip": 4} if atari["kind"] == "Deterministic" else {}
            return plain, options | ({"obs_type": "ram"} if atari["ram"] else {})
    return _newest(env_id, list(gymnasium.registry)), {}


def has_version(env_id: str) -> bool:
    """Whether the id ends in a version, which every id of gym 0.17 does."""
    return _ID.fullmatch(env_id) is not None


def _newest(env_id: str, env_ids: list[str]) -> str:
    """Return the newest version of the environment among the `known` ids; `env_id` itself if there is no newer one."""
    wanted_id = _ID.fullmatch(env_id)
    if wanted_id is None:
        return env_id
    same = [match for key in env_ids if (match := _ID.fullmatch(key)) and match["name"] == wanted_id["name"]]
    newest = max(same, key=lambda match: int(match["version"]), default=wanted_id)
    return newest[0] if int(newest["version"]) > int(wanted_id["version"]) else env_id
