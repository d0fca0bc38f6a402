"""Checks a whole project without running it."""

from __future__ import annotations

from pathlib import Path

from hippodrome.control.config import Config, Diagnostic, agent_imports, remarks
from hippodrome.local.check.agent_file import never_called, read_agent
from hippodrome.local.check.designs import check_designs
from hippodrome.local.check.pages import check_pages
from hippodrome.local.check.sessions import check_sessions


def check_project(folder: Path, config: Config | None) -> list[Diagnostic]:
    """Return the problems of pages and agent.py, and remarks on the configuration. agent.py is not run.

    `config` is None if the configuration cannot be read.
    """
    plays = config is None or bool(config.game_steps)
    remarks_on = remarks.remarks_on(folder, config) if config else []
    if config and plays and config.project.may_run_on_aws:
        remarks_on += agent_imports.requirement_remarks(folder)
    if config:
        remarks_on += check_sessions(folder, config)
        remarks_on += check_designs(folder, config)
    if config and plays:
        remarks_on += never_called(folder, config)
        remarks_on += [*agent_imports.hiding_files(folder), *agent_imports.hidden_files(folder)]
    return remarks_on + check_pages(folder, config) + (read_agent(folder) if plays else [])
