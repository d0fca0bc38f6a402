"""Checks that the servers' image (`infra/Dockerfile`) has the packages that agent.py imports.

It reads agent.py, and the modules beside it that agent.py imports, without running them. The image has the packages of
`requirements/trial.txt` and of the project's `requirements.txt`, and their dependencies. Dependencies are known only
for packages that are installed on this machine.
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

from hippodrome import places
from hippodrome.control.config import Config, Diagnostic, hippo_requirements, layout
from hippodrome.control.config.folder import read_source
from hippodrome.control.config.layout import AGENT, REQUIREMENTS
from hippodrome.protocol import players, server_modules
from hippodrome.protocol.values import KeyPath, printable

_IN_IMAGE = ("llm", "protocol", "trial")  # modules of Hippodrome
_MISSING = ("ImportError", "ModuleNotFoundError", "Exception", "BaseException")


ImportFilter = Callable[[ast.AST], Iterator[ast.Import | ast.ImportFrom]]
"""Yields imports of a syntax tree."""


class _Image(NamedTuple):
    """The known packages in the image, by their canonical names, and why the image may have others."""

    held: set[str]
    unknown: set[str]
    """Packages of the requirements that are not installed here, so that their dependencies are not known."""
    unread: bool
    """Whether the requirements have a line that names no package."""


class Import(NamedTuple):
    """An import of a module, by its full name, at a line of a file."""

    file: str
    line: int
    module: str


def missing(folder: Path) -> list[Diagnostic]:
    """Return a mistake for each package that a file imports and the image lacks, at its first import in the file.

    There is a remark instead of a mistake if this is not certain, for example because a package of requirements.txt is
    not installed on this machine and may bring others. Imports whose failure the code expects (`try`, `TYPE_CHECKING`)
    are left out. So are packages that are not installed on this machine: their distribution is not known, and `make
    check` tries the agent without them.
    """
    image = _image(folder)
    diagnostics: dict[tuple[str, str], Diagnostic] = {}
    for file, line, module in _imports(folder):
        name = module.partition(".")[0]
        message, sure = _lacking(module, image)
        if message:
            diagnostics.setdefault((file, name), Diagnostic(file, line, "", message, remark=not sure))
    return list(diagnostics.values())


def missing_for_players(folder: Path, config: Config) -> list[Diagnostic]:
    """Return a mistake for each package that config.yml needs and the image lacks.

    Policies' files need ONNX Runtime. Without an agent.py, a game such as `package.module` needs its package. There is
    a remark instead of a mistake if it is not certain that the image lacks the package.
    """
    image, source = _image(folder), read_source(folder)
    diagnostics: dict[str, Diagnostic] = {}
    for path, user, line in _needed_by_players(folder, config):
        name = canonicalize_name(line.partition("==")[0])
        if name in image.held or line in diagnostics:
            continue
        needs, reason = f"{user} needs the package {name}", _unknown(image)
        sentence = f"{needs}, which is not in the servers' image; write {line} into {REQUIREMENTS}"
        if reason:
            sentence = f"{needs}; whether it is in the servers' image is not checked, because {reason}"
        diagnostics[line] = source.diagnostic(path, sentence, remark=bool(reason))
    return list(diagnostics.values())


def _needed_by_players(folder: Path, config: Config) -> Iterator[tuple[KeyPath, str, str]]:
    """The path and the name of each policy's file or game that needs a package, and the package's line for
    requirements.txt."""
    for path, file in config.trial.policy_files():
        yield ("trial", *path), file, players.ONNXRUNTIME
    game = config.trial.game or ""
    package = game.partition(".")[0]
    if package != game and all(map(str.isidentifier, game.split("."))) and layout.find(folder).agent is None:
        yield ("trial", "game"), "this game", requirement_line(package) or package


def missing_of_loaded(folder: Path, config: Config, names: Iterable[str]) -> list[str]:
    """Return a sentence for each of the modules `names` that the image lacks and that no file of the project imports.

    `names` are the top-level modules that were loaded while the agent played, such as pygame, with which Gymnasium
    draws CartPole.
    """
    if missing(folder):  # the missing packages may be what loads them, and are reported already
        return []
    image = _image(folder)
    imported = {module.partition(".")[0] for _, _, module in _imports(folder, _all)}
    imported |= {line.partition("==")[0] for _, _, line in _needed_by_players(folder, config)}
    lacking = (_lacking(name, image)[0] for name in sorted(set(names) - imported))
    return [f"playing loads a package that {AGENT} does not name: {message}" for message in lacking if message]


def _lacking(module: str, image: _Image) -> tuple[str, bool]:
    """The message about a module that the image lacks, and whether this is certain. "" if the image has the module, or
    if its distribution is not known."""
    name = module.partition(".")[0]
    if name in sys.stdlib_module_names or name == "pip":  # Python's base image has pip
        return "", True
    if name == "hippodrome":
        if module == name or module.split(".")[1] in _IN_IMAGE:
            return "", True
        shown = printable(module, 100)
        return f"{shown} is not in the servers' image; it is a part of Hippodrome that servers do not have", True
    shown = printable(name, 100)
    distributions = sorted(set(_distributions().get(name, ())))
    if not distributions:
        return "", True
    names = {canonicalize_name(distribution) for distribution in distributions}
    if names & image.held or canonicalize_name(name) in image.unknown:
        return "", True
    write = f"write {requirement_line(name)} into {REQUIREMENTS} beside {AGENT}"
    reason = _unknown(image)
    if reason:
        return f"whether {shown} is in the servers' image is not checked, because {reason}; to be sure, {write}", False
    return f"{shown} is not in the servers' image; {write}", True


def _unknown(image: _Image) -> str:
    """Why the image may have packages that are not known here; "" if all are known."""
    unread = f"a line of {REQUIREMENTS} names no package" if image.unread else ""
    if not image.unknown:
        return unread
    first, *others = sorted(image.unknown)
    shown = [printable(name, 100) for name in (first, *others[:2])]
    names = f"{', '.join(shown)} and {len(others) - 2} more" if len(others) > 2 else " and ".join(shown)
    return f"{names} {'are' if others else 'is'} not installed here"


def requirement_line(name: str) -> str:
    """Return the line for requirements.txt that installs this top-level module in the version of this machine.

    The result is "" if the module is not installed on this machine.
    """
    distributions = sorted(set(_distributions().get(name, ())))
    return f"{distributions[0]}=={metadata.version(distributions[0])}" if distributions else ""


# What the image holds


def project_requirements(folder: Path, text: str) -> tuple[str, list[Diagnostic]]:
    """Return the text of the project's requirements.txt for the image, and remarks on the lines that are left out.

    Lines are left out only in a clone of HIPPO Gym (`hippo_requirements`).
    """
    file = layout.requirements_file(folder)
    if file is None or layout.agent_folder(folder) == folder:
        return text, []
    present = [requirement.name for requirement in _of_trial() if requirement is not None]
    return hippo_requirements.adapt(text, file.relative_to(folder).as_posix(), present)


def hiding_files(folder: Path) -> list[Diagnostic]:
    """Return a mistake for each file beside agent.py that hides a module which servers need."""
    agent = layout.agent_folder(folder) / AGENT
    if not agent.is_file():
        return []
    label = agent.relative_to(folder).as_posix()
    return [Diagnostic(label, None, "", sentence) for sentence in server_modules.hiding(agent.parent)]


def hidden_files(folder: Path) -> list[Diagnostic]:
    """Return a mistake for each file beside agent.py that an import means and does not get.

    Python and Hippodrome have a module of this name, and it comes first. Only the first import of each file is named.
    """
    code, hidden = layout.agent_folder(folder).resolve(), dict[str, Diagnostic]()
    for (file, line, module), own_files in _imports_and_files(folder, _all):
        name = module.partition(".")[0]
        whose = _also_has(name) if own_files else ""
        if whose:
            shown = name if (code / name).is_dir() else f"{name}.py"
            message = f"import {name} finds a module of {whose}, and not {shown} beside {AGENT}; rename {shown}"
            hidden.setdefault(name, Diagnostic(file, line, "", message))
    return list(hidden.values())


def _also_has(name: str) -> str:
    """Who else has a module of this name; "" if nobody."""
    if name in sys.stdlib_module_names or name == "test":  # Python's own tests, which that list leaves out
        return "Python"
    return "Hippodrome" if name == "hippodrome" else ""


def requirement_remarks(folder: Path) -> list[Diagnostic]:
    """Return remarks on the lines of the project's requirements.txt that are left out."""
    return project_requirements(folder, _text(layout.requirements_file(folder)))[1]


def _image(folder: Path) -> _Image:
    """The packages in the image, as far as they are known here."""
    text, _ = project_requirements(folder, _text(layout.requirements_file(folder)))
    return _closure(_of_trial() + _requirements(text))


def _of_trial() -> list[Requirement | None]:
    return _requirements((places.ROOT / "requirements/trial.txt").read_text(encoding="utf-8"))


def _requirements(text: str) -> list[Requirement | None]:
    """The requirement of each line, None for a line that cannot be read. Lines with options are left out."""
    lines = (line.partition(" #")[0].strip() for line in text.replace("\\\n", " ").splitlines())
    return [_requirement(line) for line in lines if line and not line.startswith(("#", "--"))]


@cache
def _requirement(line: str) -> Requirement | None:
    try:
        return Requirement(line.partition(" --")[0])
    except InvalidRequirement:
        return None


def _closure(requirements: Sequence[Requirement | None]) -> _Image:
    """These packages, their dependencies, and the dependencies of their extras.

    In `requirements` None stands for a line that cannot be read. If a dependency is not installed here, its own
    dependencies are left out.
    """
    readable = [requirement for requirement in requirements if requirement is not None]
    image = _Image(set(), set(), unread=len(readable) < len(requirements))
    visited: set[tuple[str, str]] = set()
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
        for extra in {"", *requirement.extras} - {extra for package, extra in visited if package == name}:
            visited.add((name, extra))
            waiting += [(need, False) for need in needs if not need.marker or need.marker.evaluate({"extra": extra})]
    return image


@cache
def _needs(name: str) -> Sequence[Requirement] | None:
    """The dependencies of a package; None if it is not installed here, or its metadata cannot be read."""
    try:
        return [Requirement(need) for need in metadata.requires(name) or ()]
    except (metadata.PackageNotFoundError, InvalidRequirement):
        return None


@cache
def _distributions() -> dict[str, list[str]]:
    """The installed distributions, by their top-level modules."""
    return {
        name: list(packages_distribution) for name, packages_distribution in metadata.packages_distributions().items()
    }


# What the code imports


def _imports(folder: Path, chosen: ImportFilter | None = None) -> Iterator[Import]:
    """The imports of agent.py and of the modules beside it that it imports, each file once, in the order of lines.

    By default these are the imports that must succeed (`_needed`). Imports of the project's own files are left out.
    """
    for found, own_files in _imports_and_files(folder, chosen or _needed):
        if not own_files:
            yield found


def _imports_and_files(folder: Path, chosen: ImportFilter) -> Iterator[tuple[Import, set[Path]]]:
    """The imports as in `_imports`, each with the project's own files that it names."""
    top, folder = folder.resolve(), layout.agent_folder(folder).resolve()
    waiting, visited = [folder / AGENT], set()
    while waiting:
        path = waiting.pop(0)
        if path in visited:
            continue
        visited.add(path)
        for line, modules in _read(path, folder, chosen):
            own_files = {file for module in modules for file in _beside(folder, module)}
            waiting += sorted(own_files)
            if modules:
                yield Import(path.relative_to(top).as_posix(), line, modules[0]), own_files


def _read(path: Path, folder: Path, chosen: ImportFilter) -> list[tuple[int, list[str]]]:
    """The line of each import, and the modules that it may load; [] if Python cannot read the file."""
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
    """Whether the handler catches the exception of a failed import."""
    kinds = handler.type.elts if isinstance(handler.type, ast.Tuple) else [handler.type]
    return any(kind is None or _name(kind) in _MISSING for kind in kinds)


def _name(node: ast.AST) -> str:
    return node.id if isinstance(node, ast.Name) else node.attr if isinstance(node, ast.Attribute) else ""


def _modules(node: ast.Import | ast.ImportFrom, package: tuple[str, ...]) -> list[list[str]]:
    """The modules of each name in an import statement. `from a import b` may load `a` and `a.b`."""
    if isinstance(node, ast.Import):
        return [[alias.name] for alias in node.names]
    above = package[: len(package) - node.level + 1] if node.level else ()
    base = ".".join([*above, *filter(None, [node.module])])
    return [[name for name in (base, *(f"{base}.{alias.name}".lstrip(".") for alias in node.names)) if name]]


def _beside(folder: Path, module: str) -> list[Path]:
    """The project's own files that Python runs when it imports the module: its packages' files, and its own."""
    files, parts = [], module.split(".")
    if not all(part.isidentifier() for part in parts):
        return []
    for count in range(1, len(parts) + 1):
        path = folder.joinpath(*parts[:count])
        file = path / "__init__.py" if path.is_dir() else path.with_name(f"{path.name}.py")
        if file.is_file():
            files.append(file)
    return files


def _text(file: Path | None) -> str:
    """The text of the file; "" if it is missing or cannot be read, which `register` reports."""
    try:
        return "" if file is None else file.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError):
        return ""
