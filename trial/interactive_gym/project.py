"""Makes a project from an experiment: config.yml, steps/, agent.py, and copies of the experiment's own files."""

from __future__ import annotations

import hashlib
import json
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from trial.interactive_gym import assets, looking, options, pages, playing, sources, trying
from trial.interactive_gym.configuration_constants import ActionSettings, InputModes, PolicyTypes
from trial.interactive_gym.looking import Look
from trial.interactive_gym.playing import Unplayable
from trial.interactive_gym.remote_config import RemoteConfig
from trial.interactive_gym.sources import HASHES, ConfigModule, Locate

MIN_PATIENCE, MAX_PATIENCE = 10, 3600
"""The limits of `project.patience`, in seconds."""
MAX_BUFFER = 10_000
"""The highest value of `actionBufferLifespan`, in steps."""
_NO_ID = re.compile(r"[^A-Za-z0-9_-]+")
_MADE_BY = "made by `python {file}`; change that file and run it again"


@dataclass(frozen=True, slots=True)
class MadeProject:
    """The project that was made from an experiment."""

    folder: Path
    remarks: list[str] = field(default_factory=list)
    """Sentences for the researcher: on what was left out, and on options that have no effect or another one."""


def make(config: RemoteConfig, folder: Path | None = None, candidates: tuple[Any, ...] = ()) -> MadeProject:
    """Make the project in `folder`, or in a folder beside the experiment's file.

    One of `candidates`, by default the config, must be a variable of the experiment's file (`sources.find`).
    A file that was changed by hand since it was made stays as it is. Raises Unplayable if the experiment cannot be
    played here, or if the folder has other files in it; OSError; and what the experiment's code raises.
    """
    source = sources.find(*(candidates or (config,)))
    target = (folder or source.file.parent / f"{_id(source.file.stem)}-study").resolve()
    remarks: list[str] = []
    files = files_of(config, source, target, remarks.append)
    remarks += ignored(config)
    remarks += write(target, files)
    return MadeProject(target, remarks)


def files_of(
    config: RemoteConfig, source: ConfigModule, target: Path, remark: Callable[[str], None]
) -> dict[str, bytes]:
    """Make the project's files, by their paths in it. Raises Unplayable, and what the experiment's code raises."""
    look = looking.look(config)
    looking.check_actions(config, look.actions)
    find = sources.locate(source)
    own, sentences = sources.belonging(source, target)
    for sentence in sentences:
        remark(sentence)
    files = {name: path.read_bytes() for name, path in own.items()}
    for name in files.keys() & {"agent.py", "config.yml"}:
        raise Unplayable(
            f"there is a {name} beside {source.file.name}, and the project needs one of its own: rename it"
        )
    players = _players(config, look, find, files, remark)
    for sentence in trying.try_policies(config, look, find, source.root):
        remark(sentence)
    files |= {f"assets/{name}": data for name, data in assets.asset_files(config, find, remark).items()}
    before, after = pages.around(config)
    steps = {
        **before,
        **after,
        "instructions": pages.instructions(config, look.game, look.human, find, remark),
        "between": pages.between(config, remark),
    }
    for name, page in steps.items():
        if page:
            files[f"steps/{name}.html"] = pages.with_files(page, find, files).encode()
    trial = trial_section(config, look, looking.names_of(config, look.actions, source.names))
    labels = looking.labels_of(dict.fromkeys(trial.get("keys", {}).values()), source.names)
    if labels:
        trial["labels"] = labels
    if steps["instructions"]:
        trial["instructions"] = "instructions"
    if steps["between"]:
        trial["betweenEpisodes"] = "between"
    if look.several:
        trial["players"] = {str(player): plays for player, (plays, _) in players.items()}
    max_steps = getattr(config, "max_steps", None)
    if max_steps:
        trial["maxSteps"] = int(max_steps)
    document = {"project": _project(config, source, [*before, "game", *after]), "trial": trial}
    files["config.yml"] = _yaml(document, source).encode()
    files["agent.py"] = agent_file(source, [(name, key) for key, (_, name) in players.items() if name]).encode()
    if "requirements.txt" not in files:
        models = any(name.endswith(".onnx") for name in files)
        lines = sources.requirements(own.values(), config.packages_to_install, ("onnxruntime",) if models else ())
        files["requirements.txt"] = "".join(f"{line}\n" for line in lines).encode()
    if config.default_action is None:
        remark("there is no default_action: while no key is pressed, noop or else action 0 is taken")
    return files


def ignored(config: RemoteConfig) -> list[str]:
    """Return a sentence about each option of the experiment that has no effect here."""
    several = len(playing.humans_of(config)) > 1
    return [f"{name} has no effect: the game runs on a server" for name in getattr(config, "ignored", ())] + [
        f"{option.name} has no effect: {option.ignored}"
        for option in options.OPTIONS
        if option.ignored and not (several and option.of_several)
        if option.name in config.given and getattr(config, option.name) != option.new_default()
    ]


def trial_section(config: RemoteConfig, look: Look, names: list[str]) -> dict[str, Any]:
    """Make the section `trial` of config.yml, without pages and players. `names` are the actions' names."""
    trial: dict[str, Any] = {
        "game": config.env_name or "experiment",
        "maxEpisodes": config.num_episodes,
        "startingFrameRate": round(config.fps),
        "minFrameRate": 1,
        "maxFrameRate": max(90, round(config.fps)),
        "actionSpace": names,
        "betweenEpisodes": _number(config.reset_timeout / 1000),
    }
    if config.default_action is not None:
        trial["idleAction"] = names[int(config.default_action)]
    if config.action_mapping:
        trial["keys"] = {_keys(key): names[int(action)] for key, action in config.action_mapping.items()}
    previous = config.action_population_method == ActionSettings.PreviousSubmittedAction
    if config.input_mode == InputModes.SingleKeystroke:
        trial["input"] = "single"
        if previous and not config.run_through_pyodide:
            trial["actionBufferLifespan"] = MAX_BUFFER
    if look.several:
        # Interactive Gym's server ignores action_population_method for policies; its games in the browser do for humans
        holds = previous and config.run_through_pyodide
        trial |= {"frameSkip": config.frame_skip, "policyActions": "held" if holds else "single"}
    if config.reset_freeze_s:
        trial["resetFreeze"] = config.reset_freeze_s
    if "seed" in config.given:
        trial["seed"] = config.seed
    if config.max_ping is not None and len(playing.humans_of(config)) > 1:
        trial |= {"maxPing": round(config.max_ping), "pingSamples": int(config.min_ping_measurements)}
    if look.objects:
        trial["scene"] = {
            "width": round(config.game_width),
            "height": round(config.game_height),
            "background": config.background,
            "coordinates": config.location_representation,
        }
    return trial


def agent_file(source: ConfigModule, policies: list[tuple[str, Any]]) -> str:
    """Write the project's agent.py. `policies` has the name of each policy's class, and the player whom it plays."""
    lines = [
        f'"""The agent of {source.file.name}, {_MADE_BY.format(file=source.file.name)}."""',
        "",
        "from trial.interactive_gym import on_server",
        "",
        f"_experiment = on_server.load(__file__, {pages.quoted(source.module)}, {pages.quoted(source.variable)})",
        "",
        "Agent = _experiment.agent()",
        *(f"{name} = _experiment.policy({player!r})" for name, player in policies),
    ]
    return "\n".join(lines) + "\n"


def write(folder: Path, files: Mapping[str, bytes]) -> list[str]:
    """Write the files of a project, and remove the files that only its earlier version had.

    A file that was changed by hand stays as it is. Return a sentence about each file that was not written for
    this reason. Raises Unplayable if the folder has files in it and none of them was made here, and OSError.
    """
    hashes = folder / HASHES
    if folder.exists() and any(folder.iterdir()) and not hashes.is_file():
        raise Unplayable(f"{folder} holds something else; give server_app.run(config, project=…) another folder")
    before: dict[str, str] = json.loads(hashes.read_text()) if hashes.is_file() else {}
    sentences = []
    now = {}
    for name, data in files.items():
        path = folder / name
        now[name] = _hash(data)
        if path.is_file() and name in before and _hash(path.read_bytes()) not in (before[name], now[name]):
            sentences.append(f"{path} was changed by hand and stays; delete it to have it made anew")
            now[name] = before[name]
            continue
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data)
    for name in before.keys() - files.keys():
        path = folder / name
        if path.is_file() and _hash(path.read_bytes()) == before[name]:
            path.unlink()
    hashes.write_text(json.dumps(now, indent=0, sort_keys=True))
    return sentences


def _players(
    config: RemoteConfig,
    look: Look,
    find: Locate,
    files: dict[str, bytes],
    remark: Callable[[str], None],
) -> dict[Any, tuple[str, str]]:
    """Return, by player, the value in `trial.players`, and the policy's class in agent.py or an empty name.

    Adds the files of policies to `files`. Raises Unplayable if a class would find another policy's file under the name
    of its own (`playing.located`).
    """
    players: dict[Any, tuple[str, str]] = {}
    for number, (player, plays) in enumerate(playing.mapping_of(config).items()):
        if isinstance(plays, str) and plays in (PolicyTypes.Human, PolicyTypes.Random):
            players[player] = (plays, "")
            continue
        file = find(plays) if isinstance(plays, str) and ("/" in plays or "." in plays) else None
        name = Path(str(plays)).name
        if file is not None and file.is_file():
            name = sources.put(file, "policies", files)
        elif isinstance(plays, str) and plays.endswith(".onnx"):
            remark(f"the policy of {player} is not found: {plays}")
        if looking.is_file(config, plays) and look.joined_as_sorted:
            players[player] = (f"sample:policies/{name}", "")
        elif file is not None and name != file.name and os.path.normpath(plays) not in files:
            raise Unplayable(f"policy_mapping has two files that are called {file.name}: give them different names")
        else:
            players[player] = (f"agent:Policy{number}", f"Policy{number}")
    return players


def _project(config: RemoteConfig, source: ConfigModule, steps: list[str]) -> dict[str, Any]:
    named = "page_title" in config.given
    project: dict[str, Any] = {
        "id": _id(config.env_name or source.file.stem),
        "name": config.page_title if named else source.file.stem.replace("_", " "),
        "steps": {**dict(enumerate(steps[:-1], 1)), "finalStep": steps[-1]},
    }
    if "max_concurrent_games" in config.given:
        project["maxServers"] = config.max_concurrent_games
    humans = len(playing.humans_of(config))
    if humans > 1:
        project["players"] = humans
        if config.waitroom_timeout is not None:
            seconds = round(config.waitroom_timeout / 1000, 3)
            project["patience"] = _number(max(MIN_PATIENCE, min(MAX_PATIENCE, seconds)))
    return project


def _number(value: float) -> float:
    """Return a whole number as an int, so that config.yml has 5 and not 5.0."""
    return int(value) if value == int(value) else value


def _id(name: str) -> str:
    return _NO_ID.sub("-", name.replace("_", "-")).strip("-_")[:60] or "experiment"


def _keys(key: Any) -> str:
    return "+".join(map(str, key)) if isinstance(key, tuple) else str(key)


def _yaml(document: Mapping[str, Any], source: ConfigModule) -> str:
    import yaml  # noqa: PLC0415 - servers do not need it

    head = f"# {source.file.name}, {_MADE_BY.format(file=source.file.name)}.\n\n"
    return head + yaml.safe_dump(document, sort_keys=False, allow_unicode=True, width=120)


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
