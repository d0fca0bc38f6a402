"""agent.py as a file, which is not run here: whether Python can read it, and where its methods stand."""

from __future__ import annotations

import ast
import warnings
from pathlib import Path

from hippodrome.config import Diagnostic, layout
from hippodrome.config.layout import AGENT
from local.check.wording import short


def label_of(folder: Path) -> str | None:
    """agent.py as messages name it, by its path from the project's folder; None if there is none."""
    code = layout.agent_folder(folder)
    return (code / AGENT).relative_to(folder).as_posix() if (code / AGENT).is_file() else None


def read_agent(folder: Path) -> list[Diagnostic]:
    """What Python says to agent.py without running it."""
    path, label = layout.agent_folder(folder) / AGENT, label_of(folder) or AGENT
    try:
        source = path.read_bytes() if path.is_file() else b""
    except OSError as error:
        return [Diagnostic(label, None, "", f"the file cannot be read: {error.strerror or 'unknown reason'}")]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            compile(source, label, "exec", dont_inherit=True)
    except SyntaxError as error:
        return [Diagnostic(label, error.lineno or None, "", f"Python cannot read this: {short(error.msg)}")]
    except Exception as error:  # noqa: BLE001 - such as a file that is not text at all
        return [Diagnostic(label, None, "", f"Python cannot read this file: {short(str(error))}")]
    return []


def line_of(path: Path, method: str) -> int | None:
    """Where the method of class Agent is written; else the class. Without that class, where the function is."""
    try:
        body = ast.parse(path.read_bytes()).body
    except (OSError, ValueError, SyntaxError):
        return None
    for agent in body:
        if isinstance(agent, ast.ClassDef) and agent.name == "Agent":
            return _last(agent.body, method) or agent.lineno
    return _last(body, method)


def _last(body: list[ast.stmt], function: str) -> int | None:
    found = [part.lineno for part in body if isinstance(part, ast.FunctionDef) and part.name == function]
    return found[-1] if found else None
