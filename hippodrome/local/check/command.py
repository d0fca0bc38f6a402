"""`hippodrome check`: finds what would go wrong in a study.

With a mistake the exit status is 1. A remark is about something that works, but most likely not as it was meant.
"""

from __future__ import annotations

import io
import sys
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from hippodrome.console.arguments import StudyFolder
from hippodrome.control.config import Config, ConfigErrors, Diagnostic, agent_imports, model_cost, read_project, remarks
from hippodrome.local import requirements
from hippodrome.local.check import agent, agent_file
from hippodrome.local.check.designs import check_designs
from hippodrome.local.check.pages import check_pages
from hippodrome.local.check.sessions import check_sessions
from hippodrome.local.study_folder import must_hold_study


def command(
    folder: StudyFolder = Path(),
    seconds: Annotated[float, typer.Option(min=1, help="How long agent.py may take.")] = agent.SECONDS,
    strict: Annotated[bool, typer.Option("--strict", help="Count remarks as mistakes.")] = False,
) -> None:
    """Name every mistake in config.yml and the step pages, and try agent.py. Nothing is changed.

    What the study's requirements.txt names is installed first. The exit code is 1 if there is a mistake.
    """
    must_hold_study(folder)
    requirements.prepare(folder)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a console that lacks a character must not hide the mistake
    config, found = None, []
    try:
        config = read_project(folder)
    except ConfigErrors as errors:
        found += errors.diagnostics
    found += check_project(folder, config)
    label = agent_file.label_of(folder)
    readable = not any(problem.file == label for problem in _mistakes(found))
    playable = config is not None and bool(config.game_steps) and readable
    if playable and config and config.project.may_run_on_aws:
        lacking = [*agent_imports.missing(folder), *agent_imports.missing_for_players(folder, config)]
        found += lacking if config.project.use_aws else [replace(problem, remark=True) for problem in lacking]
    _print(found)
    if playable and config:
        sys.stdout.write(f"trying {label or config.trial.game} …\n")
        sys.stdout.flush()
        tried = agent.try_agent(folder, config, seconds, _say)
        _print(tried)
        found += tried
    if config and (cost := model_cost.sentence(config)):
        sys.stdout.write(f"{cost}\n")
    sys.stdout.write(f"{_summary(found, config)}\n")
    if strict and found and not _mistakes(found):
        sys.stdout.write("With --strict, remarks count as mistakes.\n")
    raise typer.Exit(1 if _mistakes(found) or (strict and found) else 0)


def check_project(folder: Path, config: Config | None) -> list[Diagnostic]:
    """Return the problems of pages and agent.py, and remarks on the configuration. agent.py is not run.

    `config` is None if the configuration cannot be read.
    """
    plays = config is None or bool(config.game_steps)
    found: list[Diagnostic] = []
    if config:
        found += remarks.remarks_on(folder, config)
        if plays and config.project.may_run_on_aws:
            found += agent_imports.requirement_remarks(folder)
        found += [*check_sessions(folder, config), *check_designs(folder, config)]
        if plays:
            found += agent_file.never_called(folder, config)
            found += [*agent_imports.hiding_files(folder), *agent_imports.hidden_files(folder)]
    return found + check_pages(folder, config) + (agent_file.read_agent(folder) if plays else [])


def _say(line: str) -> None:
    sys.stdout.write(f"  {line}\n")
    sys.stdout.flush()


def _print(diagnostics: Iterable[Diagnostic]) -> None:
    for problem in diagnostics:
        sys.stdout.write(f"{problem}\n")


def _mistakes(diagnostics: Iterable[Diagnostic]) -> list[Diagnostic]:
    return [problem for problem in diagnostics if not problem.remark]


def _summary(diagnostics: list[Diagnostic], config: Config | None) -> str:
    mistakes = len(_mistakes(diagnostics))
    numbers = ((mistakes, "mistake"), (len(diagnostics) - mistakes, "remark"))
    counts = [f"{number} {word}{'' if number == 1 else 's'}" for number, word in numbers if number]
    if config is None or mistakes:
        return f"{' and '.join(counts)}."
    return f"No mistakes{f', {counts[0]}' if counts else ''}: {config.summary()}"
