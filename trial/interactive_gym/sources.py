"""The files of an experiment: which module its config stands in, and what of the researcher's code belongs to it."""

from __future__ import annotations

import ast
import functools
import site
import sys
import sysconfig
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from types import ModuleType
from typing import Any

from protocol.players import ONNXRUNTIME
from trial.interactive_gym.playing import Unplayable

MOST_BYTES = 50 * 2**20
"""Of one file that lies beside the experiment's; larger ones are left out."""
MOST_BYTES_IN_ALL = 500 * 2**20
MADE = ".made-by-interactive-gym.json"
"""In a project's folder: what was made there, and the hash of each file."""
_HIPPODROME = Path(__file__).resolve().parents[2]
_SERVER_FOLDERS = ("", "server", "interactive_gym/server")  # Interactive Gym's assets lie below its server's folder
_LEFT_OUT = {"__pycache__", "data", "node_modules"}
_INSTALLED = tuple({sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")})
_TAKEN = {"agent", "trial", "protocol"}
_OF_THE_MACHINE = {"sitecustomize", "usercustomize"}
"""Python imports these itself as it starts; Debian's and Ubuntu's stand outside its folders (`/etc/python3.11`)."""


@dataclass(frozen=True, slots=True)
class ConfigModule:
    """The module in which a config stands."""

    module: str
    variable: str
    file: Path
    root: Path
    """The folder from which its modules are imported."""
    names: Mapping[str, Any]


def find(*configs: Any) -> ConfigModule:
    """Where one of these stands. Raises Unplayable unless it is a variable of a module of the researcher's.

    What stands below `if __name__ == "__main__"` is a variable too, but not on a server, so the last one counts most.
    """
    found = [source for source in map(_find, (each for each in reversed(configs) if each is not None)) if source]
    if found:
        return found[0]
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
        if variable is None or file is None or file.is_relative_to(_HIPPODROME / "trial"):
            continue
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


def locate(source: ConfigModule) -> Any:
    """A function that finds a file that an option names: from here, or from the experiment's file upwards."""
    here = [Path.cwd(), source.file.parent, *list(source.file.parents)[1:5]]

    def find_file(name: Any) -> Path | None:
        if not str(name):
            return None
        for folder in here:
            for below in _SERVER_FOLDERS:
                path = folder / below / str(name)
                if path.exists():
                    return path
        return None

    return find_file


def belonging(source: ConfigModule, target: Path) -> tuple[dict[str, Path], list[str]]:
    """The files that go into the project, by their paths there, and sentences about those that do not.

    They are the modules that the experiment has imported from folders of the researcher's, and all that lies beside its
    file.
    """
    found: dict[str, Path] = {}
    said = []
    for module in list(sys.modules.values()):
        file = _file(module)
        if file is not None and file.is_relative_to(source.root) and _ours(file, source.root, target):
            found[file.relative_to(source.root).as_posix()] = file
        if file is not None and (name := _from_elsewhere(module, file, source.root, target)):
            found[name] = file
    for file in _beside(source.file.parent, target):
        found.setdefault(file.relative_to(source.root).as_posix(), file)
    total = 0
    for name, file in sorted(found.items()):
        size = file.stat().st_size
        total += size
        if size > MOST_BYTES:
            del found[name]
            said.append(f"{name} is left out: it has {size / 2**20:.0f} MB, and {MOST_BYTES / 2**20:.0f} are the most")
    if total > MOST_BYTES_IN_ALL:
        raise Unplayable(
            f"{source.file.parent} holds {total / 2**20:.0f} MB: put the experiment into a folder of its own"
        )
    found[source.file.relative_to(source.root).as_posix()] = source.file
    return found, said


def requirements(files: Iterable[Path], given: Iterable[str], modules: Collection[str] = ()) -> list[str]:
    """The lines of requirements.txt: packages that these files import, with the versions here, and those given.

    `modules` are imported by other code; `onnxruntime` is named even if it is not installed here.
    """
    packages = metadata.packages_distributions()
    found = {"onnxruntime": ONNXRUNTIME} if "onnxruntime" in modules else {}
    for name in sorted({*modules, *(name for file in files if file.suffix == ".py" for name in _imports(file))}):
        for package in packages.get(name, [])[:1]:
            found[package.lower()] = f"{package}=={metadata.version(package)}"
    for line in given:
        found[line.partition("=")[0].partition("<")[0].partition(">")[0].strip().lower()] = line
    return [found[name] for name in sorted(found)]


def _imports(file: Path) -> Iterator[str]:
    """The top-level names of what a file imports."""
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
    for path in sorted(folder.iterdir()):
        if path.name in _LEFT_OUT or path.name.startswith(".") or path == target or path.is_symlink():
            continue
        if path.is_dir():
            if not (path / "pyvenv.cfg").exists() and not (path / MADE).exists():
                yield from _beside(path, target)
        elif path.is_file() and path.suffix != ".pyc":
            yield path


def _ours(file: Path, root: Path, target: Path) -> bool:
    parts = file.relative_to(root).parts
    hidden = any(part.startswith(".") or part == "site-packages" for part in parts)
    return not hidden and not file.is_relative_to(target) and not _of_hippodrome(file)


def _from_elsewhere(module: ModuleType, file: Path, root: Path, target: Path) -> str | None:
    """Where in the project a module belongs that comes from another folder of PYTHONPATH; None if it is no such one."""
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
    if not _ours(file, came_from, target):
        return None
    return file.relative_to(came_from).as_posix()


@functools.cache
def _installed() -> tuple[Path, ...]:
    """The folders of Python's own modules and of packages."""
    return tuple(_resolved(folder) for folder in (*_INSTALLED, *site.getsitepackages(), site.getusersitepackages()))


def _of_hippodrome(file: Path) -> bool:
    return any(file.is_relative_to(_HIPPODROME / name) for name in ("trial", "protocol"))


def _file(module: Any) -> Path | None:
    name = getattr(module, "__file__", None)
    return _resolved(name) if isinstance(name, str) and name.endswith(".py") else None


@functools.cache  # each module is looked at several times
def _resolved(path: str) -> Path:
    return Path(path).resolve()
