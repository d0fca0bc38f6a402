"""Tries the agent: starts it, and lets it play whole episodes, in each group.

The agent is tried as a trial server would run it, in a process of its own (`agent_process.py`) with a server's
environment variables. With `warmServers` it is tried as on a warm server (`hippodrome/trial/server/assignment.py`): the
participant becomes known only before the first `reset`, and code that asks for the participant earlier gets a remark.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from hippodrome.control.config import Config, Diagnostic, layout
from hippodrome.control.config.step_files import StepFileError, open_folder
from hippodrome.control.model.design import Section, Step, answers_read, own_steps
from hippodrome.control.model.matching import MATCH
from hippodrome.local.check.agent_report import PLAY_STEPS, AgentReport
from hippodrome.local.check.earlier_answers import EarlierAnswers
from hippodrome.local.inherited import inherited_environment
from hippodrome.local.stand_in import StandIn
from hippodrome.protocol import environment as variables
from hippodrome.protocol.handover import Handover
from hippodrome.trial.server import process_group
from hippodrome.trial.server.earlier_answers import put
from hippodrome.trial.settings import STEP_SECONDS

SECONDS = 120.0  # seconds in which all calls of the agent must return, in each group
CALL_SECONDS = STEP_SECONDS  # seconds in which a single call of step, reset or render must return
PLAY_SECONDS = 20.0  # seconds of playing, in all groups together; the start is not counted

_STACK_SECONDS = 10.0  # seconds more, in which the agent's process must have written down where it hangs
_SESSION = f"s.{'0' * 20}"


def try_agent(
    folder: Path, config: Config, seconds: float = SECONDS, say: Callable[[str], None] = lambda line: None
) -> list[Diagnostic]:
    """Let the agent play in each group (Hippodrome's agent, if the project has none), and return its problems.

    `say` gets a line for each group: how far the agent played. After a mistake in one group the others are not tried.
    """
    folder = folder.resolve()
    diagnostics: list[Diagnostic] = []
    for group in config.each_group:
        with tempfile.TemporaryDirectory(prefix="hippodrome-check-") as temporary:
            place = Path(temporary)
            status = _try(folder, config, place, seconds, group)
            report = AgentReport(folder, config, place, seconds, group)
            diagnostics += [problem for problem in report.problems(status) if problem not in diagnostics]
            if report.played:
                say(report.how_far())
        if any(not problem.remark for problem in diagnostics):
            break
    return diagnostics


def _try(folder: Path, config: Config, place: Path, seconds: float, group: int | None) -> int | None:
    """Let the agent play in one group. Return the exit status of its process, or None if it had to be killed."""
    environment = _environment(folder, config, place, seconds, group)
    stand_in = StandIn(always=True, env=environment)
    stand_in.use(config)
    try:
        with (
            (place / "output").open("wb") as output,
            process_group.started(
                [sys.executable, "-P", "-m", "hippodrome.local.check.agent_process", str(place / "report")],
                env=environment,
                cwd=layout.agent_folder(folder).resolve(),
                stdout=output,
                stderr=subprocess.STDOUT,
            ) as process,
        ):
            return process.wait(seconds + _STACK_SECONDS)
    except subprocess.TimeoutExpired:
        return None
    finally:
        stand_in.close()


def _environment(folder: Path, config: Config, place: Path, seconds: float, group: int | None) -> dict[str, str]:
    """Environment variables as a trial server has them (`local/backend/task_process.py`, `trial/settings.py`)."""
    several = config.project.has_sessions
    settings = {
        "seconds": seconds,
        "callSeconds": CALL_SECONDS,
        "playSeconds": PLAY_SECONDS / len(config.each_group),
        "playSteps": PLAY_STEPS,
        "games": _games(folder, config, group),
        "match": _question(folder, config) if config.project.matching == MATCH and several else None,
        "owner": None,
    }
    owner = {variables.USER_ID: "check", variables.GROUP: variables.group_text(group)}
    if config.project.warm_servers or several:  # a session's members are not known when its server starts
        owner = {variables.WARM_SERVER: "on"}
        settings["owner"] = Handover(_SESSION if several else "check", group, "check").to_json().decode()
    return {
        **inherited_environment(),
        **owner,
        variables.PROJECT_ID: config.project.id,
        variables.SERVER: "check",
        variables.GAME_STEPS: ",".join(step.key for step in config.game_steps),
        variables.TRIAL: json.dumps(_trial(config)),
        variables.STORE: str(place),
        variables.AGENT_DIR: str(layout.agent_folder(folder).resolve()),
        "SETTINGS": json.dumps(settings),
        "PYTHONDONTWRITEBYTECODE": "1",
    }


def _trial(config: Config) -> dict[str, Any]:
    """The section `trial`, with the language model of another game or level if its own games have none."""
    trial = config.registration()["trial"]
    return {**trial, "llm": config.models[0]} if config.models else trial


def _games(folder: Path, config: Config, group: int | None) -> list[dict[str, Any]]:
    """The `options` and `answers` that `reset` gets in the games of the study and at all levels, each once.

    The first has the options of `trial`, with which the agent plays. The answers are made up, and None if a game's
    agent reads none. `condition` and `run` are those of `Session`, with the first level where the options are the same.
    """
    first = {factor.name: next(iter(factor.levels)) for factor in config.design.conditions}
    base = config.registration()["trial"]
    path = own_steps(config.design.steps, config.design.blocks, None)
    given = _made_up(folder, config, group)
    games: list[dict[str, Any]] = []
    for at, step in enumerate(path):
        for section in (step.sections or (Section(),)) if step.type.on_server else ():
            trial = {**base, **section.trial}
            if any(section.levels.get(name, level) != level for name, level in step.levels.items()):
                continue
            games.append(
                {
                    "options": trial.get("options") or {},
                    "answers": _answers(path[:at], step, trial["answers"], given) if trial.get("answers") else None,
                    "condition": {name: section.levels.get(name, level) for name, level in first.items()},
                    "run": {**step.levels, "position": 1} if step.levels else {},
                }
            )
    played = {**games[0], "options": base.get("options") or {}}
    return [played, *(game for at, game in enumerate(games) if game not in (played, *games[:at]))]


def _answers(before: list[Step], game: Step, names: list[str], given: Mapping[str, Any]) -> dict[str, Any]:
    """The answers that a game's agent gets, in the form in which it gets them."""
    answers: dict[str, Any] = {}
    steps = {step.key: step.step_name for step in before}
    for key, found_at in answers_read(before, game, names).items():
        put(answers, found_at, given.get(steps[key], {}))
    return answers


def _made_up(folder: Path, config: Config, group: int | None) -> dict[str, dict[str, Any]]:
    """Answers to all questions of the study, by step."""
    try:
        given = EarlierAnswers(open_folder(folder).path, config, config.steps).made_up(group)
    except StepFileError:
        return {}
    checks = (step.key for step in config.design.steps if step.right)
    return given | {key: {**given.get(key, {}), "passed": True, "tries": 1} for key in checks}


def _question(folder: Path, config: Config) -> dict[str, Any]:
    """What `match` is asked: made-up participants who have answered the pages before the game.

    Their answers are random, but the last of them give the answers of the first.
    """
    try:
        pages = EarlierAnswers.before_the_game(open_folder(folder).path, config)
    except StepFileError:
        pages = None
    players, groups = config.project.players, config.groups
    waiting = []
    for number in range(3 * players):
        group = number % groups if groups else None
        found = pages.answers(group, number % (2 * players))[number // players % 2] if pages else {}
        answers = {name: value for answered in found.values() for name, value in answered.items()}
        waiting.append(
            {"id": f"made-up-{number}", "waited": 5 * (3 * players - number), "group": group, "answers": answers}
        )
    return {"players": players, "waiting": waiting}
