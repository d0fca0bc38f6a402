"""Whether what agent.py imports is in the image of the participants' servers: what `infra/Dockerfile` installs.

Read without running it: agent.py, and the modules beside it that it imports. The image holds `requirements/trial.txt`,
the project's `requirements.txt`, and what both bring, as far as the packages installed here say what they need.
"""

from __future__ import annotations

import ast
import sys
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from importlib import metadata
from pathlib import Path
from typing import NamedTuple

from packaging.requirements import InvalidRequirement, Requirement
from packaging.utils import canonicalize_name

from hippodrome.config import Config, Diagnostic, hippo_requirements, layout
from hippodrome.config.diagnostics import Keys, printable
from hippodrome.config.folder import read_source
from hippodrome.config.layout import AGENT, REQUIREMENTS
from protocol import players

_ROOT = Path(__file__).resolve().parents[2]
_IN_IMAGE = ("trial", "protocol", "pip")  # our own packages there, and what Python's image brings
_MISSING = ("ImportError", "ModuleNotFoundError", "Exception", "BaseException")


Choice = Callable[[ast.AST], Iterator[ast.Import | ast.ImportFrom]]


class _Image(NamedTuple):
    """The canonical names of the packages in the image that are known here, and why others may be there, too."""

    held: set[str]
    unknown: set[str]
    """Packages asked for that are not installed here, so that what they bring is not known."""
    unread: bool
    """Whether a line of a file of requirements names no package that can be looked up."""


class Import(NamedTuple):
    """A module that a file imports, by its full name, and the line."""

    file: str
    line: int
    module: str


def may_run_on_aws(config: Config) -> bool:
    """Whether the study may run on AWS: it has `useAWS: true`, or no useAWS, but a `cpu` in awsSetup."""
    project = config.project
    return project.use_aws or (not project.given("useAWS") and project.aws_setup.given("cpu"))


def missing(folder: Path) -> list[Diagnostic]:
    """A mistake for each package that a file imports and the image lacks, at its first line there; a remark if it may
    come with a package of requirements.txt that is not installed here.

    Imports whose failure the code expects (`try`, `TYPE_CHECKING`) are left out, and so are packages that are not
    installed here: which distribution they are is not known, and the agent is tried without them.
    """
    image = _image(folder)
    found: dict[tuple[str, str], Diagnostic] = {}
    for file, line, module in _imports(folder):
        name = module.partition(".")[0]
        message, sure = _lacking(name, image)
        if message:
            found.setdefault((file, name), Diagnostic(file, line, "", message, remark=not sure))
    return list(found.values())


def of_players(folder: Path, config: Config) -> list[Diagnostic]:
    """A mistake for each package that config.yml needs and the image lacks: what runs the files of policies, and that
    of a game which is a module and is made without an agent.py. A remark if it may come with another package."""
    image, source = _image(folder), read_source(folder)
    found: dict[str, Diagnostic] = {}
    for path, what, line in _needed_by_players(folder, config):
        name = canonicalize_name(line.partition("==")[0])
        if name in image.held or line in found:
            continue
        needs, reason = f"{what} needs the package {name}", _unknown(image)
        sentence = f"{needs}, which is not in the servers' image; write {line} into {REQUIREMENTS}"
        if reason:
            sentence = f"{needs}; whether it is in the servers' image is not checked, because {reason}"
        found[line] = source.diagnostic(path, sentence, remark=bool(reason))
    return list(found.values())


def _needed_by_players(folder: Path, config: Config) -> Iterator[tuple[Keys, str, str]]:
    """What in config.yml needs a package, and the line for requirements.txt that brings it."""
    for path, file in players.files_of(config.trial):
        yield ("trial", *path), file, players.ONNXRUNTIME
    game = config.trial.game or ""
    package = game.partition(".")[0]
    if package != game and all(map(str.isidentifier, game.split("."))) and layout.find(folder).agent is None:
        yield ("trial", "game"), "this game", wanted(package) or package


def loaded(folder: Path, config: Config, names: Iterable[str]) -> list[str]:
    """What to say of top-level modules that were loaded while the agent played, if the image lacks them and no file of
    the project imports them itself: such as pygame, with which Gymnasium draws CartPole."""
    if missing(folder):  # what the missing packages bring is not said again
        return []
    image = _image(folder)
    named = {module.partition(".")[0] for _, _, module in _imports(folder, _all)}
    named |= {line.partition("==")[0] for _, _, line in _needed_by_players(folder, config)}
    lacking = (_lacking(name, image)[0] for name in sorted(set(names) - named))
    return [f"playing loads a package that {AGENT} does not name: {message}" for message in lacking if message]


def _lacking(name: str, image: _Image) -> tuple[str, bool]:
    """What to do about a top-level module that the image lacks, and whether it surely does; empty if it is there or
    not known."""
    if name in sys.stdlib_module_names or name in _IN_IMAGE:
        return "", True
    shown = printable(name, 100)
    distributions = sorted(set(_distributions().get(name, ())))
    if not distributions:
        if not (_ROOT / name / "__init__.py").is_file():
            return "", True
        return f"{shown} is not in the servers' image; it is a part of Hippodrome that servers lack", True
    names = {canonicalize_name(distribution) for distribution in distributions}
    if names & image.held or canonicalize_name(name) in image.unknown:
        return "", True
    write = f"write {wanted(name)} into {REQUIREMENTS} beside {AGENT}"
    reason = _unknown(image)
    if reason:
        return f"whether {shown} is in the servers' image is not checked, because {reason}; to be sure, {write}", False
    return f"{shown} is not in the servers' image; {write}", True


def _unknown(image: _Image) -> str:
    """Why the image may hold more than is known here; empty if it does not."""
    unread = f"a line of {REQUIREMENTS} names no package" if image.unread else ""
    if not image.unknown:
        return unread
    first, *others = sorted(image.unknown)
    most = [printable(name, 100) for name in (first, *others[:2])]
    names = f"{', '.join(most)} and {len(others) - 2} more" if len(others) > 2 else " and ".join(most)
    return f"{names} {'are' if others else 'is'} not installed here"


def wanted(name: str) -> str:
    """The line for requirements.txt that brings this top-level module in the version here; empty if it is not here."""
    distributions = sorted(set(_distributions().get(name, ())))
    return f"{distributions[0]}=={metadata.version(distributions[0])}" if distributions else ""


# What the image holds


def project_requirements(folder: Path, text: str) -> tuple[str, list[Diagnostic]]:
    """The text of the project's requirements.txt as the image installs it; in a clone of HIPPO Gym lines are left out,
    and remarks name them."""
    file = layout.requirements_file(folder)
    if file is None or layout.agent_folder(folder) == folder:
        return text, []
    present = [requirement.name for requirement in _of_trial() if requirement is not None]
    return hippo_requirements.adapt(text, file.relative_to(folder).as_posix(), present)


def requirement_remarks(folder: Path) -> list[Diagnostic]:
    """What is left out of the project's requirements.txt."""
    return project_requirements(folder, _text(layout.requirements_file(folder)))[1]


def _image(folder: Path) -> _Image:
    """What is in the image, as far as it is known here."""
    text, _ = project_requirements(folder, _text(layout.requirements_file(folder)))
    return _closure(_of_trial() + _requirements(text))


def _of_trial() -> list[Requirement | None]:
    return _requirements((_ROOT / "requirements/trial.txt").read_text(encoding="utf-8"))


def _requirements(text: str) -> list[Requirement | None]:
    """The lines that name a package; None for one that cannot be read. Lines of options name none."""
    lines = (line.partition(" #")[0].strip() for line in text.replace("\\\n", " ").splitlines())
    return [_requirement(line) for line in lines if line and not line.startswith(("#", "--"))]


@cache
def _requirement(line: str) -> Requirement | None:
    try:
        return Requirement(line.partition(" --")[0])
    except InvalidRequirement:
        return None


def _closure(asked: Sequence[Requirement | None]) -> _Image:
    """These packages and all that they bring. None stands for a line that cannot be read.

    An extra's packages come too. What a package needs and is not installed here is not looked into.
    """
    readable = [requirement for requirement in asked if requirement is not None]
    image = _Image(set(), set(), unread=len(readable) < len(asked))
    seen: set[tuple[str, str]] = set()
    waiting = [(requirement, True) for requirement in readable]
    while waiting:
        requirement, first = waiting.pop()
        name = canonicalize_name(requirement.name)
        image.held.add(name)
        needs = _needs(requirement.name)
        if needs is None:
            if first:
                image.unknown.add(name)
            continue
        for extra in {"", *requirement.extras} - {extra for known, extra in seen if known == name}:
            seen.add((name, extra))
            waiting += [(need, False) for need in needs if not need.marker or need.marker.evaluate({"extra": extra})]
    return image


@cache
def _needs(name: str) -> Sequence[Requirement] | None:
    """What a package asks for; None for one that is not installed here, or says it so that it cannot be read."""
    try:
        return [Requirement(need) for need in metadata.requires(name) or ()]
    except (metadata.PackageNotFoundError, InvalidRequirement):
        return None


@cache
def _distributions() -> dict[str, list[str]]:
    """The installed distributions by the top-level modules that they bring."""
    return {name: list(found) for name, found in metadata.packages_distributions().items()}


# What the code imports


def _imports(folder: Path, chosen: Choice | None = None) -> Iterator[Import]:
    """The imports (those that must succeed, unless others are chosen) of agent.py and of the modules beside it that it
    imports, each file once, in the order of lines."""
    top, folder = folder.resolve(), layout.agent_folder(folder).resolve()
    waiting, seen = [folder / AGENT], set()
    while waiting:
        path = waiting.pop(0)
        if path in seen:
            continue
        seen.add(path)
        for line, modules in _read(path, folder, chosen or _needed):
            here = {file for module in modules for file in _beside(folder, module)}
            waiting += sorted(here)
            if not here and modules:
                yield Import(path.relative_to(top).as_posix(), line, modules[0])


def _read(path: Path, folder: Path, chosen: Choice) -> list[tuple[int, list[str]]]:
    """For each import, its line and the modules that it may load. Nothing of a file that Python cannot read."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            tree = ast.parse(path.read_bytes())
    except (OSError, ValueError, SyntaxError, RecursionError, MemoryError):
        return []
    package = path.relative_to(folder).parent.parts
    return sorted((node.lineno, modules) for node in chosen(tree) for modules in _modules(node, package))


def _all(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    return (node for node in ast.walk(tree) if isinstance(node, ast.Import | ast.ImportFrom))


def _needed(tree: ast.AST) -> Iterator[ast.Import | ast.ImportFrom]:
    """The imports that must succeed."""
    waiting: list[ast.AST] = [tree]
    while waiting:
        node = waiting.pop()
        if isinstance(node, ast.Import | ast.ImportFrom):
            yield node
        elif isinstance(node, ast.Try) and any(map(_expects, node.handlers)):
            waiting += [*node.handlers, *node.orelse, *node.finalbody]
        elif isinstance(node, ast.If) and _name(node.test) == "TYPE_CHECKING":
            waiting += node.orelse
        else:
            waiting += ast.iter_child_nodes(node)


def _expects(handler: ast.ExceptHandler) -> bool:
    """Whether it handles an import that fails."""
    kinds = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    return any(kind is None or _name(kind) in _MISSING for kind in kinds)


def _name(node: ast.AST) -> str:
    return node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""


def _modules(node: ast.Import | ast.ImportFrom, package: tuple[str, ...]) -> list[list[str]]:
    """The modules of one import, with `from a import b` as `a` and `a.b`, which may be one as well."""
    if isinstance(node, ast.Import):
        return [[alias.name] for alias in node.names]
    above = package[: len(package) - node.level + 1] if node.level else ()
    base = ".".join([*above, *filter(None, [node.module])])
    return [[name for name in (base, *(f"{base}.{alias.name}".lstrip(".") for alias in node.names)) if name]]


def _beside(folder: Path, module: str) -> list[Path]:
    """The project's own files that importing the module runs: those of its packages, and its own."""
    found, parts = [], module.split(".")
    if not all(part.isidentifier() for part in parts):
        return []
    for count in range(1, len(parts) + 1):
        path = folder.joinpath(*parts[:count])
        file = path / "__init__.py" if path.is_dir() else path.with_name(f"{path.name}.py")
        if file.is_file():
            found.append(file)
    return found


def _text(file: Path | None) -> str:
    """What the file says; nothing if it is not there or cannot be read, which `register` says."""
    try:
        return "" if file is None else file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return ""
