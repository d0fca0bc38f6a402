"""Makes a project from an experiment: config.yml, steps/, agent.py, and copies of the experiment's own files."""

from __future__ import annotations

import html
import json
import os
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hippodrome.trial.agent import environments
from hippodrome.trial.interactive_gym import files as project_files
from hippodrome.trial.interactive_gym import playing, script
from hippodrome.trial.interactive_gym.files import locate, put
from hippodrome.trial.interactive_gym.options import (
    ActionSettings,
    Look,
    PolicyTypes,
    RemoteConfig,
    Unplayable,
    settings,
    without_effect,
)
from hippodrome.trial.interactive_gym.scenes import CompletionCodeScene

_LINKED = re.compile(r'(?P<before>\b(?:src|href)=")(?P<path>[^":#?{}]+\.[A-Za-z0-9]+)(?=")')
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
    before, after = around(config)
    instructions, between = instructions_page(config, look, remarks.append), between_page(config)
    for name, page in {**before, **after, "instructions": instructions, "between": between}.items():
        if page:
            files[f"steps/{name}.html"] = with_files(page, files).encode()
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


# ---- the pages of steps/, from the experiment's texts


def around(config: RemoteConfig) -> tuple[dict[str, str], dict[str, str]]:
    """Make the pages before the game, and the pages after it. Return both by the pages' names, in their order."""
    scenes = config.scenes
    place = scenes.index(config) if scenes else 0
    before = {_name("before", number, scene): _static(scene) for number, scene in enumerate(scenes[:place], 1)}
    after = {_name("after", number, scene): _static(scene) for number, scene in enumerate(scenes[place + 1 :], 1)}
    heading = config.welcome_header_text or config.page_title
    welcome = _page(heading, config.welcome_text or "Press the button to begin.")
    return before or {"welcome": welcome}, after or {"final": _final(config)}


def _name(where: str, number: int, scene: Any) -> str:
    """Return the name of a scene's page. It begins with the scene's id, if that can be part of a name."""
    name = str(scene.scene_id)
    fits = scene.scene_id and re.fullmatch(r"[A-Za-z][A-Za-z0-9_]{0,60}", name)
    return f"{name}_{where}_{number}" if fits else f"{where}_{number}"


def _static(scene: Any) -> str:
    subheader = _text(scene.scene_subheader)
    page = _page(scene.scene_header, f"<p>{subheader}</p>" if subheader else "", scene.scene_body)
    if isinstance(scene, CompletionCodeScene):
        page += '<p class="code">{{ completion_code }}</p>\n'
    url = getattr(scene, "url", None)
    return page + (_onward(url, scene.append_subject_id) if url else "")


def instructions_page(config: RemoteConfig, look: Look, remark: Callable[[str], None]) -> str:
    """Make the page with the instructions; empty if the experiment has none. Raises Unplayable."""
    parts = []
    if config.instructions_html_file is not None:
        path = locate(config.instructions_html_file)
        if path is None:
            raise Unplayable(f"instructions_html_file: there is no {config.instructions_html_file}")
        parts.append(path.read_text(encoding="utf-8"))
    parts += [config.instructions, config.game_page_text]
    if config.game_page_html_fn is not None:
        first, *others = config.humans
        look.game.human_players = {first: "participant"}
        parts.append(config.game_page_html_fn(look.game, "participant"))
        if others:
            remark(f"game_page_html_fn is called for {first} alone: all participants read the same instructions")
    return _page(config.game_header_text or "How to play", *parts) if any(map(_text, parts)) else ""


def between_page(config: RemoteConfig) -> str:
    """Make the page between two episodes; empty if there is none."""
    texts = config.between_episode_header, config.between_episode_text
    return _page(*texts) if any(texts) else ""


def _final(config: RemoteConfig) -> str:
    """Make the last page, with a link if the experiment has an address. Unmatched participants get another text."""
    page = _page(config.final_page_header_text or "Thank you!", config.final_page_text or "This is the end.")
    page += _redirect(config, config.experiment_end_redirect_url or config.end_game_redirect_url)
    if len(config.humans) == 1:
        return page
    alone = _page("There was nobody to play with", "Thank you for waiting.")
    alone += _redirect(config, config.waitroom_timeout_redirect_url)
    return "{% if participant.unmatched %}\n" + alone + "{% else %}\n" + page + "{% endif %}\n"


def _redirect(config: RemoteConfig, address: str | None) -> str:
    """Make a link to this address, and a script that opens it after `redirect_timeout`; empty without an address."""
    if not address:
        return ""
    return _onward(address, config.append_subject_id_to_redirect or config.append_subject_name_to_redirect) + (
        "<script>\n"
        '  const onward = document.getElementById("onward");\n'
        f"  setTimeout(() => location.assign(onward.href), {max(0, round(config.redirect_timeout))});\n"
        "</script>\n"
    )


def _onward(address: str, appended: bool) -> str:
    """Make a link to another site. If `appended`, its address ends in the participant's id."""
    user_id = "{{ participant.userId|urlencode }}" if appended else ""
    return f'<p><a id="onward" href="{_raw(html.escape(_text(address), quote=True))}{user_id}">Go on</a></p>\n'


def with_files(page: str, files: dict[str, bytes]) -> str:
    """Add the files to which the page links to `files`, beside the page. Return the page with links to their places."""

    def beside(link: re.Match[str]) -> str:
        path = locate(link["path"])
        return link[0] if path is None else link["before"] + put(path, "steps", files)

    return _LINKED.sub(beside, page)


def _page(heading: Any, *parts: Any) -> str:
    """Make a page. Its heading is left out if one of the parts has an `<h1>`."""
    shown = [_as_html(text) for text in map(_text, parts) if text.strip()]
    if _text(heading) and not any("<h1" in text for text in shown):
        shown.insert(0, f"<h1>{html.escape(_text(heading), quote=False)}</h1>")
    return _raw("\n".join(shown)) + "\n"


def _text(value: Any) -> str:
    """Return the text that an option or a scene is given. Parts of a tuple, as by a stray comma, are joined."""
    if isinstance(value, list | tuple):
        return "\n".join(map(_text, value))
    return "" if value is None else str(value)


def _as_html(text: str) -> str:
    """Put plain text into paragraphs; return HTML as it is."""
    if re.search(r"<[A-Za-z/!]", text):
        return text
    return "\n".join(f"<p>{html.escape(part.strip(), quote=False)}</p>" for part in text.split("\n\n") if part.strip())


def _raw(text: str) -> str:
    """Write the text in a form that a template shows unchanged."""
    return "{% raw %}" + text + "{% endraw %}" if re.search(r"\{[{%#]", text) else text
