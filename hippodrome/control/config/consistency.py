"""The second check: compares values with each other."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from hippodrome.control.config import fargate, sessions, texts
from hippodrome.control.config.diagnostics import Mistake
from hippodrome.control.config.each_value import Checked, check_values
from hippodrome.control.config.project_keys import STEPS
from hippodrome.control.config.step_order import step_name, step_range
from hippodrome.control.model import rules
from hippodrome.control.model.step_order import FINAL, default_start, position, visited
from hippodrome.control.model.step_types import type_of
from hippodrome.protocol.environment import PLAIN_ORIGINS
from hippodrome.protocol.players import HUMAN
from hippodrome.protocol.similar import did_you_mean
from hippodrome.protocol.trial import step_names
from hippodrome.protocol.values import KeyPath


def check(sections: dict[str, Any], invalid: Iterable[KeyPath] = (), named: Mapping[str, str] | None = None) -> Checked:
    """Check each value of a file's sections by itself, and then the values against each other.

    Returns the valid values and all mistakes. Paths in `invalid` have mistakes already, and yield no further ones.
    `named` are the pages of steps with names, which a registration has checked already.
    """
    checked = check_values(sections, invalid, named)
    checks = (
        _missing,
        _aws,
        _step_numbers,
        _game_step,
        _event_steps,
        _together,
        _answers_read,
        _hours,
        _warm,
        _plain_clients,
        _environment_size,
        sessions.mistakes,
        texts.mistakes,
    )
    checked.mistakes += [mistake for find in checks for mistake in find(checked)]
    return checked


def _missing(checked: Checked) -> Iterator[Mistake]:
    """Sections and keys that every study needs."""
    project = checked.project
    if not checked.has_project:
        if checked.valid(("project",)):
            yield Mistake((), "the section project is missing")
        return
    if not project.id and checked.valid(("project", "id")):
        yield Mistake(("project", "id"), "missing; give the project an id of letters, digits, dashes and underscores")
    if not checked.step_keys and checked.valid(STEPS):
        yield Mistake(STEPS, 'missing; list the pages in order, such as "1: consent"')
    if checked.game_steps and not checked.trial.game and checked.valid(("trial", "game")):
        yield Mistake(("trial", "game"), "missing; a project with a game step needs the name of its environment")


def _hours(checked: Checked) -> Iterator[Mistake]:
    """`maxServerHours` must cover `maxRuntime`: otherwise no server could start."""
    project, path = checked.project, ("project", "maxServerHours")
    if not checked.valid(path, ("project", "maxRuntime")) or project.max_server_hours is None:
        return
    if project.max_server_hours * 60 < project.max_runtime:
        needed = math.ceil(project.max_runtime / 60)
        yield Mistake(path, f"must be at least {needed}, since one server may run {project.max_runtime} minutes")


def _warm(checked: Checked) -> Iterator[Mistake]:
    """`warmServers` needs names without participants, a step that starts servers, and room within `maxServers`."""
    project, path = checked.project, ("project", "warmServers")
    if not project.warm_servers:
        return
    if project.subdomain == "userId":
        why = "a warm server gets its name before a participant takes it"
        yield Mistake(path, f"{why}: use subdomain: hash, or warmServers: 0")
    if _starts_nothing(checked):
        yield Mistake(path, "must be 0: no step of this study starts a server, so no participant would take one")
    most = project.max_servers
    if most is not None and project.warm_servers > most:
        yield Mistake(path, f"must be at most maxServers, which is {most}: a warm server is one of them")


def _plain_clients(checked: Checked) -> Iterator[Mistake]:
    """`plainClients` needs the origin of HIPPO's front end, which finds a server by the participant's id."""
    project, path = checked.project, ("project", "plainClients")
    if not project.plain_clients or not checked.valid(path):
        return
    if not project.front_end and checked.valid(("project", "frontEnd")):
        where = "plainClients is true, so say where the front end is, such as https://play.example.org"
        yield Mistake(("project", "frontEnd"), f"missing; {where}")
    if project.subdomain != "userId" and checked.valid(("project", "subdomain")):
        yield Mistake(path, "HIPPO's front end finds servers by the participant's id: use subdomain: userId, or false")


def _starts_nothing(checked: Checked) -> bool:
    """Whether it is certain that no step starts a server."""
    is_complete = bool(checked.step_keys) and checked.valid(STEPS, ("project", "events"))
    return is_complete and not checked.game_steps and checked.project.events.start_server_step is None


_AWS_NEEDS = {  # bucket, region and rootDomain may be missing: then the installation's count
    "cpu": "the vCPUs of a server, such as 1",
    "memory": "the memory of a server in GB, such as 4",
}


def _aws(checked: Checked) -> Iterator[Mistake]:
    """`useAWS: true` needs a size of servers, and Fargate must offer this size."""
    project, path = checked.project, ("project", "awsSetup")
    setup = project.aws_setup
    if not checked.valid(("project", "useAWS")) or project.keeps_off_aws:
        return
    for key, needed in _AWS_NEEDS.items():
        if project.use_aws and not setup.given(key) and checked.valid((*path, key)):
            yield Mistake((*path, key), f"missing; useAWS is true, so give {needed}")
    if setup.cpu is not None and setup.memory is not None and not fargate.fits(setup.cpu, setup.memory):
        fitting = fargate.memory_choices(setup.cpu)
        yield Mistake((*path, "memory"), f"{setup.memory:g} GB do not go with cpu {setup.cpu:g}; choose {fitting}")


def _keys_known(checked: Checked) -> bool:
    """Whether there are steps, and all their keys are valid."""
    invalid = [path[2:] for path in checked.invalid if path[:2] == STEPS]
    if checked.design.is_named:
        return bool(checked.step_keys) and not checked.design.mistakes
    return bool(checked.step_keys) and all(rest and rest[0] in checked.step_keys for rest in invalid)


_ECS_LIMIT = 8192
"""Characters of a task's overrides (https://docs.aws.amazon.com/AmazonECS/latest/APIReference/API_RunTask.html)."""
_OTHER_LENGTH = 1210
"""Characters of the names of variables, ids, secrets and addresses, each of its greatest length."""


def _environment_size(checked: Checked) -> Iterator[Mistake]:
    """The environment variables of a server must fit into the RunTask call, or ECS refuses it."""
    if not checked.valid(("trial",), STEPS):
        return
    project, trial = checked.project, checked.trial.registered()
    pages = [{"name": PLAIN_ORIGINS, "value": " ".join(project.front_end)}] if project.plain_clients else []
    length = _OTHER_LENGTH + sum(len(_json(part)) for part in (_json(trial), ",".join(checked.game_steps), pages))
    if length > _ECS_LIMIT:
        key = max(trial, key=lambda name: len(_json(trial[name])))
        message = (
            f"too long: a server would be told {length} characters in all, and ECS allows {_ECS_LIMIT}; shorten it"
        )
        yield Mistake(("trial", key), message)


def _json(value: object) -> str:
    return json.dumps(value, separators=(",", ":"))


def _step_numbers(checked: Checked) -> Iterator[Mistake]:
    """The numbers of steps have no gaps."""
    if not _keys_known(checked) or checked.design.is_named:
        return
    numbers = [int(key) for key in checked.step_keys if key != FINAL]
    for before, number in itertools.pairwise([0, *(numbers or [2])]):  # with finalStep alone, step 1 is missing
        if number > before + 1:
            gap = f"step {before + 1} is" if number == before + 2 else f"steps {before + 1} to {number - 1} are"
            after = str(number) if numbers else FINAL
            yield Mistake((*STEPS, after), f"{gap} missing before it; number the steps 1, 2, 3 … without gaps")


def _game_step(checked: Checked) -> Iterator[Mistake]:
    """The last step is no game step."""
    last = checked.project.steps.get(checked.step_keys[-1]) if checked.step_keys else None
    if last and type_of(last).on_server:
        path = checked.design.paths.get(checked.step_keys[-1], (*STEPS, checked.step_keys[-1]))
        yield Mistake(path, "the game cannot be the last step; add a page after it, which stops the server")


def _together(checked: Checked) -> Iterator[Mistake]:
    """Participants who play together are assigned when they are matched, at the first game; each game is for all."""
    design, people = checked.design, checked.project.players
    if not checked.project.has_sessions:
        return
    first = next((at for at, step in enumerate(design.steps) if step.type.on_server), len(design.steps))
    for step in design.steps[:first]:
        steps_asked = {names[0] for names in rules.mentioned(step.when)} if step.when else set()
        if step.block is not None or "{" in step.page or steps_asked & {"condition", "order"}:
            why = "with players: 2 or more, levels are drawn when participants are matched, at the first game"
            yield Mistake(design.paths[step.key], f"comes too early: {why}; move this step behind it")
    if design.steps and "{" in design.steps[-1].page:
        why = "the last page names a factor, and participants who are matched with nobody have no condition"
        what = "name one page for all, and ask in it for condition, such as {% if condition.pay %}"
        yield Mistake(design.paths[design.steps[-1].key], f"{why}; {what}")
    if any(len(humans) != people for _, humans in checked.trial.humans()):
        return  # that is said of trial.players
    for step in design.steps:
        for section in step.sections:
            players = section.trial.get("players")
            humans = [*players.values()].count(HUMAN) if isinstance(players, dict) else people
            if humans != people:
                at = ", ".join(f"{name}: {level}" for name, level in section.levels.items())
                are = f"{humans} of the players are human{f' with {at}' if at else ''}"
                message = f"{are}, and project.players is {people}; all who play together play each game"
                yield Mistake(design.paths[step.key], message)
                break


def _answers_read(checked: Checked) -> Iterator[Mistake]:
    """`answers` of a game names steps that come before it, or that lie in its block: then those of earlier runs."""
    design = checked.design
    if not _keys_known(checked) or not checked.valid(("trial", "answers")):
        return
    keys = [step.key for step in design.steps]
    for at, game in enumerate(design.steps):
        own = design.own_trial.get(game.key, {})
        names = step_names(own["answers"]) if "answers" in own else checked.trial.answers
        path = (*design.paths[game.key], "answers") if "answers" in own else ("trial", "answers")
        for place, name in enumerate(names if game.type.on_server else ()):
            source = next((step for step in design.steps if step.key == name), None)
            if source is None:
                yield Mistake((*path, place), f"there is no step {name}{did_you_mean(name, keys)}")
            elif source not in design.steps[:at] and (game.block is None or source.block != game.block):
                give = "" if "answers" in own else f"; give {game.key} its own answers, such as answers: []"
                message = f"{name} does not come before the game {game.key}, whose agent would read its answers{give}"
                yield Mistake((*path, place), message)


_START: KeyPath = ("project", "events", "startServerStep")
_STOP: KeyPath = ("project", "events", "stopServerStep")


def _event_steps(checked: Checked) -> Iterator[Mistake]:
    """The steps of `events` exist; the server starts at the first game step or before, and stops after the last."""
    steps, events = checked.project.steps, checked.project.events
    if not _keys_known(checked):
        return
    keys = visited(checked.step_keys, steps)
    names = [step_name(key) for key in keys]
    start, stop = position(events.start_server_step, keys), position(events.stop_server_step, keys)
    for path, key, event_step in ((_START, events.start_server_step, start), (_STOP, events.stop_server_step, stop)):
        if key is not None and event_step is None:
            yield Mistake(path, f"there is no {step_name(key)}; the steps are {step_range(keys)}")
    games = [index for index, key in enumerate(keys) if type_of(steps.get(key, "")).on_server]
    if start is not None and games and start > games[0]:
        default = keys[default_start(games)]
        why = f"comes after the game, {names[games[0]]}, which needs the server; {default} is the usual choice"
        yield Mistake(_START, f"{names[start]} {why}")
    if stop is not None and games and stop <= games[-1]:
        better = f"{keys[games[-1] + 1]} or later" if games[-1] + 1 < len(keys) else "a step after it"
        why = f"does not come after the game, {names[games[-1]]}, which needs the server; use {better}"
        yield Mistake(_STOP, f"{names[stop]} {why}")
    if start is not None and stop is not None and stop < start and not games:
        yield Mistake(_STOP, f"{names[stop]} comes before startServerStep, {names[start]}")
