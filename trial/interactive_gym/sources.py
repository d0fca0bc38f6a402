"""Finds the files of an experiment: the module with its config, and the other files that the project needs."""

from __future__ import annotations

import ast
import functools
import re
import site
import sys
import sysconfig
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

from protocol.players import ONNXRUNTIME
from trial.interactive_gym.playing import Unplayable

Locate = Callable[[Any], Path | None]
"""A function that finds the file or folder that an option names, and returns None if there is none."""

MAX_BYTES = 50 * 2**20
"""The most bytes of one file. Larger files are left out."""
MAX_BYTES_IN_ALL = 500 * 2**20
"""The most bytes of all files of an experiment together, without those that are left out."""
HASHES = ".made-by-interactive-gym.json"
"""The file of a project's folder that names the files that were made there, with their hashes."""
_HIPPODROME = Path(__file__).resolve().parents[2]
_SERVER_FOLDERS = ("", "server", "interactive_gym/server")  # Interactive Gym's assets are in its server's folder
_LEFT_OUT = {"__pycache__", "data", "node_modules"}
_PACKAGE = re.compile(r"(?P<name>[A-Za-z0-9._-]+) *(?:$|[\[<>=!~;@#])")  # what may follow a name: PEP 508
_INSTALLED = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})
_TAKEN = {"agent", "trial", "protocol"}  # a server's own modules, which no module of an experiment may hide
_OF_THE_MACHINE = {"sitecustomize", "usercustomize"}
"""Modules that Python imports when it starts. Debian and Ubuntu have theirs outside Python's folders, below /etc."""


@dataclass(frozen=True, slots=True)
class ConfigModule:
    """The researcher's module that holds a config, and the name of the config's `variable`."""

    module: str
    variable: str
    file: Path
    root: Path
    """The folder from which the experiment's modules are imported."""
    names: Mapping[str, Any]
    """The values of all variables of the module."""


def find(*configs: Any) -> ConfigModule:
    """Find the researcher's module in which one of these objects is a variable.

    If several objects are variables, the last one counts: an earlier one may be a variable only below
    `if __name__ == "__main__"`, which does not run on a server. Raises Unplayable if none is a variable.
    """
    for config in reversed(configs):
        if config is not None and (source := _find(config)) is not None:
            return source
    raise Unplayable(
        "the config must be a variable of the experiment's file, such as config = RemoteConfig()…, so that servers "
        'find it there: write it above `if __name__ == "__main__"`'
    )


def _find(config: Any) -> ConfigModule | None:
    main = sys.modules.get("__main__")
    others = [module for module in list(sys.modules.values()) if module is not main and _file(module) is not None]
    for module in filter(None, (main, *others)):
        names = getattr(module, "__dict__", {})
        variable = next((name for name, value in names.items() if value is config and name.isidentifier()), None)
        file = _file(module)
        if variable is not None and file is not None and not file.is_relative_to(_HIPPODROME / "trial"):
            return _source(module, variable, file)
    return None


def _source(module: ModuleType, variable: str, file: Path) -> ConfigModule:
    spec = getattr(module, "__spec__", None)
    name = spec.name if spec is not None else file.stem if module.__name__ == "__main__" else module.__name__
    if name.partition(".")[0] in _TAKEN:
        raise Unplayable(f"the experiment's file cannot be called {file.name}: a module of Hippodrome has this name")
    if not all(part.isidentifier() for part in name.split(".")):
        raise Unplayable(f"give {file.name} a name that Python can import: letters, digits, underscores")
    root = file.parents[name.count(".")]
    return ConfigModule(name, variable, file, root, vars(module))


def locate(source: ConfigModule) -> Locate:
    """Make a function that finds the files and folders that options name.

    It looks in the current folder, in the folder of the experiment's file, and in the four folders above that one.
    """
    folders = [Path.cwd(), source.file.parent, *list(source.file.parents)[1:5]]

    def find_file(name: Any) -> Path | None:
        if not str(name):
            return None
        for folder in folders:
            for below in _SERVER_FOLDERS:
                path = folder / below / str(name)
                if path.exists():
                    return path
        return None

    return find_file


def belonging(source: ConfigModule, target: Path) -> tuple[dict[str, Path], list[str]]:
    """Return the files for the project by their paths in it, and sentences about files that are left out.

    They are the modules that the experiment has imported from the researcher's folders, and all files in the folder of
    the experiment's file. Raises Unplayable if all of them together are too large.
    """
    files: dict[str, Path] = {}
    sentences = []
    for module in list(sys.modules.values()):
        file = _file(module)
        if file is not None and file.is_relative_to(source.root) and _is_own(file, source.root, target):
            files[file.relative_to(source.root).as_posix()] = file
        if file is not None and (name := _from_elsewhere(module, file, source.root, target)):
            files[name] = file
    for file in _beside(source.file.parent, target):
        files.setdefault(file.relative_to(source.root).as_posix(), file)
    total = 0
    for name, file in sorted(files.items()):
        size = file.stat().st_size
        if size <= MAX_BYTES:
            total += size
            continue
        del files[name]
        megabytes, most = size / 2**20, MAX_BYTES / 2**20
        sentences.append(f"{name} is left out: it has {megabytes:.0f} MB, and {most:.0f} are the most")
    if total > MAX_BYTES_IN_ALL:
        raise Unplayable(
            f"{source.file.parent} holds {total / 2**20:.0f} MB: put the experiment into a folder of its own"
        )
    files[source.file.relative_to(source.root).as_posix()] = source.file
    return files, sentences


def put(file: Path, folder: str, files: dict[str, bytes]) -> str:
    """Add a file to this folder of the project's `files`, and return its name there.

    The name gets a number if the folder has another file of this name.
    """
    data, name, number = file.read_bytes(), file.name, 1
    while files.get(f"{folder}/{name}", data) != data:
        number += 1
        name = f"{file.stem}-{number}{file.suffix}"
    files[f"{folder}/{name}"] = data
    return name


def requirements(files: Iterable[Path], given: Iterable[str], modules: Collection[str] = ()) -> list[str]:
    """Write the lines of requirements.txt: the packages that these files import, in the versions here, and `given`.

    `modules` are modules that other code imports. Of these `onnxruntime` gets a line even if it is not installed here.
    """
    packages = metadata.packages_distributions()
    lines = {"onnxruntime": ONNXRUNTIME} if "onnxruntime" in modules else {}
    for name in sorted({*modules, *(name for file in files if file.suffix == ".py" for name in _imports(file))}):
        for package in packages.get(name, [])[:1]:
            lines[_package(package)] = f"{package}=={metadata.version(package)}"
    for line in given:
        lines[_package(line)] = line
    return [lines[name] for name in sorted(lines)]


def _package(line: str) -> str:
    """Return the name of the package in a line of requirements.txt, normalized (PEP 503); an address as it is."""
    named = _PACKAGE.match(line.strip())
    return re.sub("[-_.]+", "-", named["name"]).lower() if named else line


def _imports(file: Path) -> Iterator[str]:
    """Yield the top-level names of the modules that a file imports."""
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError):
        return
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.partition(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module.partition(".")[0]


def _beside(folder: Path, target: Path) -> Iterator[Path]:
    """Yield the files in the folder and below it, without hidden files, data, virtual environments and projects."""
    for path in sorted(folder.iterdir()):
        if path.name in _LEFT_OUT or path.name.startswith(".") or path == target or path.is_symlink():
            continue
        if path.is_dir():
            if not (path / "pyvenv.cfg").exists() and not (path / HASHES).exists():
                yield from _beside(path, target)
        elif path.is_file() and path.suffix != ".pyc":
            yield path


def _is_own(file: Path, root: Path, target: Path) -> bool:
    """Whether a file below `root` is the researcher's: not hidden, installed, in the project, or of Hippodrome."""
    parts = file.relative_to(root).parts
    hidden = any(part.startswith(".") or part == "site-packages" for part in parts)
    return not hidden and not file.is_relative_to(target) and not _of_hippodrome(file)


def _from_elsewhere(module: ModuleType, file: Path, root: Path, target: Path) -> str | None:
    """Return the path in the project for a module of another folder of PYTHONPATH; None for other modules."""
    parts = module.__name__.split(".")
    if file.name == "__init__.py":
        parts.append("__init__")
    if file.with_suffix("").parts[-len(parts) :] != tuple(parts):
        return None  # `__main__`, or loaded from a file by its path
    came_from = file.parents[len(parts) - 1]
    if came_from in (root, _HIPPODROME) or any(came_from.is_relative_to(folder) for folder in _installed()):
        return None
    if parts[0] in {*_TAKEN, *_OF_THE_MACHINE, *metadata.packages_distributions()}:
        return None
    if not _is_own(file, came_from, target):
        return None
    return file.relative_to(came_from).as_posix()


@functools.cache
def _installed() -> tuple[Path, ...]:
    """Return the folders of Python's own modules and of packages."""
    return tuple(_resolved(folder) for folder in (*_INSTALLED, *site.getsitepackages(), site.getusersitepackages()))


def _of_hippodrome(file: Path) -> bool:
    return any(file.is_relative_to(_HIPPODROME / name) for name in ("trial", "protocol"))


def _file(module: Any) -> Path | None:
    """Return the path of the module's source file; None if it has none."""
    name = getattr(module, "__file__", None)
    return _resolved(name) if isinstance(name, str) and name.endswith(".py") else None


@functools.cache  # each module's path is resolved several times
def _resolved(path: str) -> Path:
    return Path(path).resolve()
