"""Makes a project from an experiment: config.yml, steps/, agent.py, and copies of the experiment's own files."""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from hippodrome.trial.agent import environments
from hippodrome.trial.interactive_gym import files as project_files
from hippodrome.trial.interactive_gym import pages, playing, script
from hippodrome.trial.interactive_gym.options import (
    ActionSettings,
    Look,
    PolicyTypes,
    RemoteConfig,
    Unplayable,
    settings,
    without_effect,
)

_MADE_BY = "made by `python -m hippodrome.trial.interactive_gym {}`; change that file and run it again"


def make(path: Path, arguments: Sequence[str], target: Path) -> tuple[RemoteConfig, list[str]]:
    """Make the project `target` of the experiment whose script is at `path`, below the present folder.

    Return its game's config, and sentences for the researcher. A file that was changed by hand since it was made stays
    as it is. Raises Unplayable if the experiment cannot be played here, OSError, and what the experiment's code raises.
    """
    modules_before = list(sys.modules)
    config, variables = script.load(path.as_posix(), arguments, Path.cwd())
    look = _look(config, variables)
    remarks = without_effect(config)
    files = project_files.own_files(path.absolute(), modules_before, target)
    for name in files.keys() & {"agent.py", "config.yml"}:
        raise Unplayable(f"there is a {name} beside {path.name}, and the project needs its own: rename yours")
    for name in (*_policy_files(config), *(name for scene in config.scenes for name in scene.files)):
        files[Path(name).as_posix()] = Path(name).read_bytes()
    files |= project_files.assets(config.assets_to_preload, remarks.append)
    before, after = pages.around(config)
    instructions, between = pages.instructions(config, look, remarks.append), pages.between(config)
    for name, page in {**before, **after, "instructions": instructions, "between": between}.items():
        if page:
            files[f"steps/{name}.html"] = pages.with_files(page, files).encode()
    document = _document(config, look, path.stem, [*before, "game", *after])
    document["trial"] |= _labels(document["trial"].get("keys", {}), variables)
    if instructions:
        document["trial"]["instructions"] = "instructions"
    if between:
        document["trial"]["betweenEpisodes"] = "between"
    files["config.yml"] = _yaml(document, path).encode()
    files["agent.py"] = _agent_file(path, arguments, _policies(config)).encode()
    files.setdefault("requirements.txt", project_files.requirements(files, config.packages_to_install))
    if config.default_action is None:
        remarks.append("there is no default_action: while no key is pressed, noop or else action 0 is taken")
    return config, remarks + project_files.write(target, files)


def _look(config: RemoteConfig, variables: Mapping[str, Any]) -> Look:
    """Make the environment, begin an episode and draw it. Raises Unplayable, and what the experiment's code raises."""
    if not config.humans:
        raise Unplayable("policy_mapping has no PolicyTypes.Human: say which player the participant plays")
    agent = playing.ExperimentAgent(config)
    env = agent.start()
    try:
        agent.reset(1)
        owner = env if agent.several else playing.Several(env, config.policy_mapping)
        counts = environments.players_of(owner, list(config.policy_mapping), ("unnamed",), stepped=False).counts
        for player, count in counts.items():
            if count is None:
                raise Unplayable(
                    f"the environment does not say how many actions {player} has: its action_space must be a Discrete "
                    "space, or a map of such spaces by player, or a method that returns the space of a player"
                )
        names = _action_names(max(filter(None, counts.values())), variables)
        return Look(agent.several, names, isinstance(agent.render(), Mapping), agent.game)
    finally:
        agent.close()


def _action_names(count: int, variables: Mapping[str, Any]) -> tuple[str, ...]:
    """Name the actions by the constants of the script (`LEFT = 1`), if each action has exactly one, else by numbers."""
    constants = [(value, name.lower()) for name, value in variables.items() if _is_action(name, value, count)]
    names = dict(constants)
    if len(constants) == len(names) == len(set(names.values())) == count:
        return tuple(names[number] for number in range(count))
    return tuple(map(str, range(count)))


def _is_action(name: str, value: Any, count: int) -> bool:
    return type(value) is int and 0 <= value < count and name[:1].isupper()


def _labels(keys: Mapping[str, str], variables: Mapping[str, Any]) -> dict[str, Any]:
    """Return `labels`, the texts for actions whose constants have several words: `Pick up` for `PickUp`."""
    constants = {name.lower(): name for name, value in variables.items() if type(value) is int}
    labels = {}
    for name in keys.values():
        label = re.sub(r"_+|(?<=[a-z0-9])(?=[A-Z])", " ", constants.get(name, name)).lower().capitalize()
        if " " in label:
            labels[name] = label
    return {"labels": labels} if labels else {}


def _policies(config: RemoteConfig) -> dict[str, Any]:
    """Return the names of the classes in agent.py that play a player, with this player."""
    others = (PolicyTypes.Human, PolicyTypes.Random)
    return {
        f"Policy{number}": player
        for number, (player, plays) in enumerate(config.policy_mapping.items())
        if not (isinstance(plays, str) and plays in others)
    }


def _policy_files(config: RemoteConfig) -> list[str]:
    """Return the policies' files, by their paths below the present folder. Raises Unplayable."""
    files = []
    for player in _policies(config).values():
        plays = config.policy_mapping[player]
        if playing.functions_of(config, plays)[1] is None:
            raise Unplayable(f"there is no policies(policy_inference_fn=…) that could play {player} by {plays!r}")
        if isinstance(plays, str) and os.path.isfile(plays):
            files.append(os.path.relpath(plays))
        elif isinstance(plays, str) and plays.endswith(".onnx"):
            raise Unplayable(f"the policy of {player} is not found: {plays}")
    for file in files:
        if file.startswith(".."):
            raise Unplayable(f"{file} is not below {Path.cwd()}: copy it there, or start in a folder above both")
    return files


def _document(config: RemoteConfig, look: Look, stem: str, steps: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Make config.yml, with the keys that no option has alone."""
    name = stem.replace("_", " ") if config.page_title == RemoteConfig().page_title else config.page_title
    project: dict[str, Any] = {
        "id": study_id(config.env_name or stem),
        "name": name,
        "steps": {**dict(enumerate(steps[:-1], 1)), "finalStep": steps[-1]},
    }
    if len(config.humans) > 1:
        project["players"] = len(config.humans)
    trial: dict[str, Any] = {
        "minFrameRate": 1,
        "maxFrameRate": max(90, round(config.fps)),
        "actionSpace": list(look.actions),
    }
    if look.several:
        # Interactive Gym's server ignores action_population_method for policies; its games in the browser do for humans
        repeats = config.action_population_method == ActionSettings.PreviousSubmittedAction
        trial["policyActions"] = "held" if repeats and config.run_through_pyodide else "single"
        classes = {player: f"agent:{name}" for name, player in _policies(config).items()}
        trial["players"] = {str(player): classes.get(player, plays) for player, plays in config.policy_mapping.items()}
    sections = settings(config, look)
    return {"project": project | sections["project"], "trial": sections["trial"] | trial}


def _agent_file(path: Path, arguments: Sequence[str], policies: Mapping[str, Any]) -> str:
    """Write the project's agent.py, with these classes of policies."""
    lines = [
        f'"""The agent of {path.name}, {_MADE_BY.format(path.name)}."""',
        "",
        "from hippodrome.trial.interactive_gym.playing import Experiment",
        "",
        f"_experiment = Experiment(__file__, {json.dumps(path.as_posix())}, {json.dumps(list(arguments))})",
        "",
        "Agent = _experiment.agent()",
        *(f"{name} = _experiment.policy({player!r})" for name, player in policies.items()),
    ]
    return "\n".join(lines) + "\n"


def study_id(name: str) -> str:
    """Return the name in the form of a project's id."""
    return re.sub(r"[^A-Za-z0-9]+", "-", name).strip("-")[:60] or "experiment"


def _yaml(document: Mapping[str, Any], path: Path) -> str:
    import yaml  # noqa: PLC0415 - servers do not need it

    head = f"# {path.name}, {_MADE_BY.format(path.name)}.\n\n"
    return head + yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=120)
