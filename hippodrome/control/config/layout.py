"""Finds the files of a project folder: config.yml, the pages, agent.py and requirements.txt.

They lie in the folder itself, or in the places of a clone of HIPPO Gym: agent.py and its modules in `App/` (v0.1.0 to
v1.1.0) or in `src/hippogym_app/` (commits before its version 2), and the pages in `StepFiles/`.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from hippodrome.control.config.diagnostics import ConfigErrors, Diagnostic

CONFIGS = ("config.yml", "config.yaml")
PAGES = ("steps", "StepFiles", "Steps")
AGENT = "agent.py"
REQUIREMENTS = "requirements.txt"
APPS = ("App", "src/hippogym_app")
"""The folders in which HIPPO Gym has agent.py."""

_VERSION_2 = "hippogym"  # the package of HIPPO Gym's version 2, in a clone or from pip
_NEAR = ("*.py", "*/*.py", f"src/{_VERSION_2}/*.py")  # where a study of version 2 has its programs
_TRIAL = "trial.py"
_PROGRAMS = (_TRIAL, "communicator.py")  # HIPPO's own files beside agent.py


@dataclass(frozen=True, slots=True)
class Layout:
    """The files of the project in `folder`. `pages`, `agent` and `requirements` are None if they do not exist."""

    folder: Path
    config: Path
    pages: Path | None
    agent: Path | None
    requirements: Path | None

    @property
    def agent_folder(self) -> Path:
        """The folder of agent.py and of the modules beside it; without an agent.py, the project's folder."""
        return self.folder if self.agent is None else self.agent.parent

    @property
    def of_hippo(self) -> bool:
        """Whether agent.py or the pages lie in a folder of HIPPO Gym's layout."""
        pages = self.pages is not None and (self.pages.parent != self.folder or self.pages.name != PAGES[0])
        return pages or self.agent_folder != self.folder

    def label(self, file: Path) -> str:
        """Return the name of the file for messages: its path from the project's folder."""
        return file.relative_to(self.folder).as_posix() if file.is_relative_to(self.folder) else file.name

    def problems(self) -> Iterator[Diagnostic]:
        """Yield mistakes and remarks on the place of agent.py. It is a mistake if servers would not use the agent."""
        program = self._program_of_version_2()
        if program is not None:
            message = (
                "this is for HIPPO Gym's version 2, whose studies are programs and have no agent of our form; write an "
                f"{AGENT} beside {self.config.name} (docs/hippo.md#version-2)"
            )
            yield Diagnostic(self.label(program), None, "", message)
            return
        if self.agent is None:
            yield from self._missing_agent()
            return
        if self.agent_folder != self.folder:
            yield from self._other_agent()
        for app in APPS:
            other = self.folder / app / AGENT
            if self.agent.parent == self.folder and other.is_file():
                message = f"not used, since there is an {AGENT} beside {self.config.name} too; keep one of them"
                yield Diagnostic(self.label(other), None, "", message, remark=True)

    def _other_agent(self) -> Iterator[Diagnostic]:
        """A mistake if HIPPO's trial.py, which researchers may change, takes its agent from another file."""
        trial = self.agent_folder / _TRIAL
        names = _imported(trial)
        own = {name for name in names if (self.agent_folder / f"{name}.py").is_file()}
        others = sorted(name for name in own if "agent" in name.lower())
        if others and AGENT.removesuffix(".py") not in names:
            message = (
                f"takes the agent from {others[0]}.py, and Hippodrome from {AGENT}: give the file that name, and its "
                "class the name Agent"
            )
            yield Diagnostic(self.label(trial), None, "", message)

    def _program_of_version_2(self) -> Path | None:
        """The file that imports HIPPO Gym's version 2: agent.py, or without an agent.py the first program."""
        near = (file for pattern in _NEAR for file in sorted(self.folder.glob(pattern)))
        files = near if self.agent is None else iter((self.agent,))
        return next((file for file in files if _VERSION_2 in _imported(file, whole=False)), None)

    def _missing_agent(self) -> Iterator[Diagnostic]:
        for file in sorted(self.folder.glob("*.py")):
            if _has_agent(file):
                message = (
                    f"its class Agent does not play, since Hippodrome takes the agent from {AGENT}: rename the file"
                )
                yield Diagnostic(self.label(file), None, "", message, remark=True)
        for app in APPS:
            place = self.folder / app
            candidates = sorted(place.glob(f"*/{AGENT}")) if place.is_dir() else []
            for file in candidates:
                message = f"not found by servers there; put it into {app}/ itself, with the modules that it imports"
                yield Diagnostic(self.label(file), None, "", message)
            if not candidates and any((place / name).is_file() for name in _PROGRAMS):
                message = f"there is no {AGENT} beside HIPPO Gym's own programs; the game would be played without agent"
                yield Diagnostic(app, None, "", message)


def find(folder: Path) -> Layout:
    """Return the files of the project in `folder`. Raises ConfigErrors if it has no config.yml, or several."""
    folder = Path(folder)
    config = _config(folder)
    return Layout(folder, config, _pages(folder), _agent(folder), requirements_file(folder))


def agent_folder(folder: Path) -> Path:
    """Return the folder of agent.py and of the modules beside it, whatever else is wrong with the project.

    The folder need not exist.
    """
    agent = _agent(folder)
    return folder if agent is None else agent.parent


def pages_folder(folder: Path) -> Path | None:
    """Return the folder of the pages, whatever else is wrong with the project; None if there is none.

    Raises OSError if the folders cannot be read.
    """
    candidates = (place / name for place in _places(folder) for name in PAGES)
    return next((path for path in candidates if path.is_dir()), None)


def requirements_file(folder: Path) -> Path | None:
    """Return the project's requirements.txt, in its folder or beside agent.py; None if there is none."""
    return _first(place / REQUIREMENTS for place in (folder, agent_folder(folder)))


def config_names() -> list[str]:
    """Return the possible paths of config.yml below the project's folder. The first path that exists counts."""
    return [*CONFIGS, *(f"{app}/{name}" for app in APPS for name in CONFIGS)]


def has_config(folder: Path) -> bool:
    """Return whether the folder has a config.yml, with mistakes or without."""
    return any((folder / name).is_file() for name in config_names())


def _config(folder: Path) -> Path:
    try:
        places = [[place / name for name in CONFIGS if (place / name).is_file()] for place in _places(folder)]
        there, is_folder = folder.exists(), folder.is_dir()
    except (OSError, ValueError):
        places, there, is_folder = [], True, True
    if not is_folder:
        message = "this is a file; name the folder it is in" if there else "there is no such folder"
        raise ConfigErrors([Diagnostic(str(folder), None, "", message)])
    config_path = next(filter(None, places), [])
    if len(config_path) > 1:
        raise ConfigErrors([Diagnostic(CONFIGS[0], None, "", f"there is a {CONFIGS[1]} too; keep only one of them")])
    if not config_path:
        raise ConfigErrors([Diagnostic(CONFIGS[0], None, "", f"there is no such file in {folder}{_above(folder)}")])
    return config_path[0]


def _above(folder: Path) -> str:
    """The end of the message about a missing config.yml, if the folder lies within a clone of HIPPO Gym that has it."""
    absolute = folder.absolute()
    for app in APPS:
        if absolute.as_posix().endswith(f"/{app}"):
            above = absolute.parents[app.count("/")]
            if any((above / name).is_file() for name in CONFIGS):
                return f"; name the folder {above}, which has it"
    return ""


def _has_agent(file: Path) -> bool:
    """Whether a file has a class `Agent`."""
    return any(isinstance(part, ast.ClassDef) and part.name == "Agent" for part in _parsed(file).body)


def _parsed(file: Path) -> ast.Module:
    """The file as Python reads it; empty if Python cannot."""
    try:
        return ast.parse(file.read_bytes())
    except (OSError, ValueError, SyntaxError, RecursionError):
        return ast.Module([], [])


def _imported(file: Path, *, whole: bool = True) -> set[str]:
    """The names of the modules that a file imports, without their packages; or of the packages, if not `whole`."""
    tree = _parsed(file)
    modules = [alias.name for node in ast.walk(tree) if isinstance(node, ast.Import) for alias in node.names]
    modules += [node.module for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) and node.module]
    return {module.rpartition(".")[2] if whole else module.partition(".")[0] for module in modules}


def _places(folder: Path) -> list[Path]:
    return [folder, *(folder / app for app in APPS)]


def _pages(folder: Path) -> Path | None:
    try:
        return pages_folder(folder)
    except OSError:
        return None


def _agent(folder: Path) -> Path | None:
    return _first(place / AGENT for place in _places(folder))


def _first(files: Iterator[Path]) -> Path | None:
    try:
        return next((file for file in files if file.is_file()), None)
    except (OSError, ValueError):
        return None
