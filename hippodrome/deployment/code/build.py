"""The functions' zips: the same input gives the same bytes, and each zip holds only what its function imports.

Imports are followed from the function's module in `lambdas/` through this project's modules to the distributions that
it needs, which `hippodrome.deployment.code.packages` provides. All imports count, also those inside functions; only
those for type checkers do not. A zip is named by the hash of its files, not of its bytes: another machine's zlib makes
no new version.
"""

from __future__ import annotations

import ast
import hashlib
import io
import sys
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path

from hippodrome import places
from hippodrome.console.problem import Problem
from hippodrome.deployment.code import bytecode
from hippodrome.deployment.code.packages import Target, Wheel, WheelCache, ZipMember

OURS = ("lambdas", "hippodrome")
DATA = {  # module → folders that it reads at run time, as paths below the project's root
    "hippodrome.control.config.step_files": ("hippodrome/control/config/pages",),
    "hippodrome.control.participants.frame": ("hippodrome/web",),
}

# Distribution → modules at which following imports ends. Of these distributions a zip holds only the modules that
# imports reach. That is safe if no module that we use is imported by a computed name
# (tests/deployment/code/test_build.py runs the zips). Powertools' Logger imports its HTTP resolvers in one place, for
# pydantic models, which we do not log.
PRUNED = {"aws-lambda-powertools": ("aws_lambda_powertools.event_handler",)}

# The modules of the distributions that `IN_RUNTIME` of hippodrome.deployment.code.packages names.
_RUNTIME = {"boto3", "botocore", "dateutil", "jmespath", "s3transfer", "six", "urllib3"}
_DATE = (1980, 1, 1, 0, 0, 0)  # the earliest time that a zip can hold


@dataclass(frozen=True)
class Function:
    """A Lambda function, ready to be packed: its files in the order of their names."""

    name: str
    members: tuple[ZipMember, ...]
    distributions: tuple[str, ...]
    python: str | None = None  # the version that runs it ("3.13"); None: no bytecode

    @cached_property
    def digest(self) -> str:
        """The sha256 of the names and contents of its files, in hexadecimal."""
        lines = "".join(f"{member.name}\0{member.sha256}\n" for member in self.members)
        return hashlib.sha256(lines.encode()).hexdigest()

    @property
    def key(self) -> str:
        """The key of its zip in the code bucket."""
        return f"{self.name}-{self.digest[:16]}.zip"

    def pack(self) -> bytes:
        """Make the zip of its files, with their bytecode if this machine has the Python that will run them.

        The bytecode follows from the files, so it is no part of the digest.
        """
        files = {member.name: member.read() for member in self.members}
        python = bytecode.compiler(self.python) if self.python else None
        if python:
            files |= bytecode.compiled({name: body for name, body in files.items() if name.endswith(".py")}, python)
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for name, body in sorted(files.items()):
                entry = zipfile.ZipInfo(name, _DATE)
                entry.compress_type = zipfile.ZIP_DEFLATED
                entry.create_system = 3  # Unix, whatever system builds the zip
                entry.external_attr = 0o100644 << 16
                archive.writestr(entry, body)
        return packed.getvalue()


def functions(target: Target, root: Path = places.ROOT) -> list[Function]:
    """Find the functions in `lambdas/` (each file is one), and collect their files for this target.

    Raises `Problem` if an imported package is not pinned or cannot be downloaded.
    """
    tree, wheels = _Tree(root), WheelCache(target)
    return [_function(name, tree, wheels, target.python) for name in tree.handlers()]


def _function(name: str, tree: _Tree, wheels: WheelCache, python: str) -> Function:
    modules = _closure([f"lambdas.{name}"], tree.sources, OURS)
    third_party = {name for name in modules.outside if name.partition(".")[0] not in _RUNTIME | sys.stdlib_module_names}
    tops = {name.partition(".")[0] for name in third_party}
    if unknown := tops - set(wheels.owners):
        raise Problem(
            f"lambdas/{name}.py needs {', '.join(sorted(unknown))}, which is in no package that is pinned.",
            "Add it to requirements/lambdas.txt, and run `python -m hippodrome.deployment.code.packages`.",
        )
    distributions = wheels.closure({wheels.owners[top] for top in tops})
    members = {member.name: member for module in modules.inside for member in tree.files(module)}
    for owner, wheel in wheels.wheels(distributions).items():
        pruned = _pruned(wheel, third_party, PRUNED[owner]) if owner in PRUNED else wheel.members
        if twice := set(pruned) & set(members):
            raise Problem(
                f"The zip of lambdas/{name}.py would have two files {min(twice)}; one of them is of {owner}.",
                "Rename a module of this project, or leave one of the two packages out of requirements/lambdas.txt.",
            )
        members |= pruned
    return Function(name, tuple(members[key] for key in sorted(members)), tuple(sorted(distributions)), python)


def _pruned(wheel: Wheel, packages: Iterable[str], ends: tuple[str, ...]) -> dict[str, ZipMember]:
    """Return the wheel's Python files that imports of `packages` reach without the modules `ends` and their imports."""
    paths = {_module(path): path for path in wheel.members if path.endswith(".py")}

    def source(module: str) -> SourceModule | None:
        path = None if f"{module}.".startswith(tuple(f"{end}." for end in ends)) else paths.get(module)
        return SourceModule(wheel.members[path].read().decode(), path.endswith("__init__.py")) if path else None

    starts = [name for name in packages if name.partition(".")[0] in wheel.modules]
    reached = _closure(starts, source, tuple(wheel.modules))
    return {paths[module]: wheel.members[paths[module]] for module in reached.inside if module in paths}


# -- this project's files -------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SourceModule:
    """A module's text, and whether it is a package's `__init__`."""

    text: str
    package: bool


class _Tree:
    """The modules of this project below `root`."""

    def __init__(self, root: Path) -> None:
        self._root = root
        self._read: dict[Path, bytes] = {}
        self._sources: dict[str, SourceModule | None] = {}  # functions share most modules

    def handlers(self) -> list[str]:
        """The functions' names: those of the files of `lambdas/`."""
        return sorted(path.stem for path in (self._root / "lambdas").glob("*.py") if path.stem != "__init__")

    def sources(self, module: str) -> SourceModule | None:
        if module not in self._sources:
            path = self._path(module)
            source = SourceModule(self._body(path).decode(), path.name == "__init__.py") if path else None
            self._sources[module] = source
        return self._sources[module]

    def files(self, module: str) -> Iterator[ZipMember]:
        """Yield the module's own file, and the files that it reads at run time."""
        path = self._path(module)
        if path:
            yield self._member(path)
        for folder in DATA.get(module, ()):
            for file in sorted((self._base("hippodrome") / folder).rglob("*")):
                if file.is_file() and not any(part.startswith((".", "__")) for part in file.parts[-2:]):
                    yield self._member(file)

    def _member(self, path: Path) -> ZipMember:
        body = self._body(path)
        base = next(base for base in (self._root / "lambdas", self._base("hippodrome")) if path.is_relative_to(base))
        name = path.relative_to(base.parent if base.name == "lambdas" else base).as_posix()
        return ZipMember(name, hashlib.sha256(body).hexdigest(), lambda: body)

    def _base(self, top: str) -> Path:
        """The folder that has this package of ours. In a wheel, `lambdas` does not lie beside `hippodrome`."""
        return self._root if (self._root / top).is_dir() else places.PACKAGES

    def _path(self, module: str) -> Path | None:
        if module.partition(".")[0] not in OURS:
            return None
        path = self._base(module.partition(".")[0]).joinpath(*module.split("."))
        return next(
            (candidate for candidate in (path / "__init__.py", path.with_suffix(".py")) if candidate.is_file()), None
        )

    def _body(self, path: Path) -> bytes:
        if path not in self._read:
            self._read[path] = path.read_bytes().replace(b"\r\n", b"\n")  # a checkout on Windows is the same input
        return self._read[path]


# -- imports --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Closure:
    """All modules that some modules import, directly or not. Those `inside` have a source here, whose imports count."""

    inside: frozenset[str]
    outside: frozenset[str]


def _closure(starts: Iterable[str], find: Callable[[str], SourceModule | None], tops: tuple[str, ...]) -> Closure:
    inside: set[str] = set()
    outside: set[str] = set()
    waiting = list(starts)
    while waiting:
        name = waiting.pop()
        if name.partition(".")[0] not in tops:
            outside.add(name)
            continue
        for module in _with_parents(name):
            source = find(module) if module not in inside else None
            if source:
                inside.add(module)
                waiting.extend(imported(source, module))
    return Closure(frozenset(inside), frozenset(outside))


def _with_parents(name: str) -> Iterator[str]:
    parts = name.split(".")
    for length in range(1, len(parts) + 1):
        yield ".".join(parts[:length])


@cache
def imported(source: SourceModule, module: str) -> set[str]:
    """Return every name that the module imports, anywhere in it.

    `from a import b` gives `a` and `a.b`: b may be a module.
    """
    modules: set[str] = set()
    for node in _statements(_parse(source.text, module)):
        if isinstance(node, ast.Import):
            modules |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = _base(node, module, source.package)
            modules |= {base} | {f"{base}.{alias.name}" for alias in node.names if alias.name != "*"}
    return modules


def _base(node: ast.ImportFrom, module: str, package: bool) -> str:
    if not node.level:
        return node.module or ""
    parts = module.split(".")
    above = parts[: len(parts) - node.level + (1 if package else 0)]
    return ".".join([*above, *([node.module] if node.module else [])])


def _statements(node: ast.AST) -> Iterator[ast.AST]:
    """Yield all statements of the tree, except those in `if TYPE_CHECKING:`.

    Expressions, which hold none, are skipped.
    """
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.expr):
            continue
        if isinstance(child, ast.If) and _only_for_checkers(child.test):
            for other in child.orelse:
                yield other
                yield from _statements(other)
        else:
            yield child
            yield from _statements(child)


def _only_for_checkers(test: ast.expr) -> bool:
    name = test.attr if isinstance(test, ast.Attribute) else test.id if isinstance(test, ast.Name) else ""
    return name == "TYPE_CHECKING"


def _parse(text: str, where: str) -> ast.Module:
    try:
        return ast.parse(text)
    except SyntaxError as error:
        raise Problem(
            f"{where} is not Python: line {error.lineno}: {error.msg}.", "Correct it, and run the same command again."
        ) from None


def _module(path: str) -> str:
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")
