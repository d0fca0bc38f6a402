"""Reads agent.py without running it: whether it is Python, and where its methods stand."""

from __future__ import annotations

import ast
import warnings
from pathlib import Path

from hippodrome.control.config import Config, Diagnostic, layout
from hippodrome.control.config.layout import AGENT
from hippodrome.control.model.matching import MATCH
from hippodrome.local.check.wording import short
from hippodrome.protocol.similar import SIMILAR, did_you_mean
from hippodrome.trial.agent.signatures import NAMES


def label_of(folder: Path) -> str | None:
    """Return the path of agent.py from the project's folder, as messages name it; None if there is no agent.py."""
    code = layout.agent_folder(folder)
    return (code / AGENT).relative_to(folder).as_posix() if (code / AGENT).is_file() else None


def read_agent(folder: Path) -> list[Diagnostic]:
    """Return the mistake for which Python cannot read agent.py, if there is one."""
    return read_module(layout.agent_folder(folder) / AGENT, label_of(folder) or AGENT)


def read_module(path: Path, label: str) -> list[Diagnostic]:
    """Return the mistake for which Python cannot read this file, if there is one; messages call it `label`."""
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
    except Exception as error:  # noqa: BLE001 - such as a file that is no text
        return [Diagnostic(label, None, "", f"Python cannot read this file: {short(str(error))}")]
    return []


def never_called(folder: Path, config: Config) -> list[Diagnostic]:
    """Return remarks on methods `on_…` that are no callbacks, and on a `match` that config.yml does not ask for."""
    path, label = layout.agent_folder(folder) / AGENT, label_of(folder) or AGENT
    try:
        tree = ast.parse(path.read_bytes())
    except (OSError, ValueError, SyntaxError):
        return []
    used = {part.attr for part in ast.walk(tree) if isinstance(part, ast.Attribute)}
    used |= {part.id for part in ast.walk(tree) if isinstance(part, ast.Name)} | set(NAMES)
    methods = [part.body for part in tree.body if isinstance(part, ast.ClassDef) and part.name == "Agent"]
    remarks = []
    for method in (part for body in methods for part in body if isinstance(part, ast.FunctionDef)):
        if method.name.startswith("on_") and method.name not in used:
            hint = did_you_mean(method.name, NAMES, SIMILAR) or "; docs/callbacks.md lists the callbacks"
            remarks.append((method.lineno, f"{method.name} is never called by Hippodrome{hint}"))
    line = _last(tree.body, MATCH)
    if config.project.has_sessions and config.project.matching != MATCH and line and MATCH not in used:
        sentence = f"{MATCH}() is never called; matching: {MATCH} under project of config.yml asks for it"
        remarks.append((line, sentence))
    return [Diagnostic(label, line, "", sentence, remark=True) for line, sentence in remarks]


def line_of(path: Path, method: str) -> int | None:
    """Return the line of a method of class Agent; the line of the class if it has no such method.

    A function `match` beside the class comes first. Without the class, the function of that name is looked for. None if
    nothing is found.
    """
    try:
        body = ast.parse(path.read_bytes()).body
    except (OSError, ValueError, SyntaxError):
        return None
    for agent in body:
        if isinstance(agent, ast.ClassDef) and agent.name == "Agent":
            beside = _last(body, method) if method == "match" else None
            return beside or _last(agent.body, method) or agent.lineno
    return _last(body, method)


def _last(body: list[ast.stmt], function: str) -> int | None:
    """The line of the last function of that name; None if there is none."""
    linenos = [part.lineno for part in body if isinstance(part, ast.FunctionDef) and part.name == function]
    return linenos[-1] if linenos else None
