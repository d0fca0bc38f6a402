"""Bytecode for the zips: on Lambda /var/task is read-only, so without it each cold start compiles every module again.

The function's own version of Python compiles it, if this machine has that version; otherwise the zips hold none. The
bytecode has unchecked hashes (PEP 552), so that Python does not compare it with the source or the source's time.
"""

from __future__ import annotations

import functools
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

WHERE = "/var/task"  # where Lambda unpacks a zip; tracebacks name this path
_COMPILE = """
import compileall, py_compile, sys
folder, where = sys.argv[1:]
unchecked = py_compile.PycInvalidationMode.UNCHECKED_HASH
compileall.compile_dir(folder, quiet=2, stripdir=folder, prependdir=where, invalidation_mode=unchecked)
"""


@functools.cache
def compiler(version: str) -> str | None:
    """Find a Python of that version ("3.13") on this machine. Return its path, or None."""
    if version == f"{sys.version_info.major}.{sys.version_info.minor}":
        return sys.executable
    managed = Path(os.environ.get("PYENV_ROOT") or Path.home() / ".pyenv") / "versions"
    places = [shutil.which(f"python{version}"), *map(str, managed.glob(f"{version}.*/bin/python{version}"))]
    return next((place for place in places if place and _is_cpython(place, version)), None)


def _is_cpython(place: str, version: str) -> bool:
    """Whether the program is CPython of that version, and not the placeholder of a version manager."""
    command = [place, "-c", "import sys; print('%d.%d %s' % (*sys.version_info[:2], sys.implementation.name))"]
    answer = subprocess.run(command, capture_output=True, text=True, check=False)  # noqa: S603 - found above
    return answer.stdout.strip() == f"{version} cpython"


_Key = tuple[str, str, str, bytes]
_made: dict[_Key, dict[str, bytes]] = {}  # by compiler, place, name and content: functions share most files


def compiled(sources: Mapping[str, bytes], python: str, where: str = WHERE) -> dict[str, bytes]:
    """Compile these modules; return the bytecode files by their names in the zip: `a/__pycache__/b.cpython-313.pyc`.

    `python` is the path of the compiler, `where` the folder in which the modules will run. Modules that do not compile
    are left out: some packages hold modules in the syntax of other versions, which they do not import.
    """
    if new := {name: body for name, body in sources.items() if (python, where, name, body) not in _made}:
        bytecode = _compile(new, python, where)
        _made.update({(python, where, name, body): bytecode.get(name, {}) for name, body in new.items()})
    return {path: code for name, body in sources.items() for path, code in _made[python, where, name, body].items()}


def _compile(sources: Mapping[str, bytes], python: str, where: str) -> dict[str, dict[str, bytes]]:
    """Compile each module. Return, by the modules' names, the bytecode file of each."""
    with tempfile.TemporaryDirectory(prefix="hippodrome-") as folder:
        root = Path(folder)
        for name, body in sources.items():
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(body)
        compile_folder(root, where, python)
        compiled_files = {path.relative_to(root): path.read_bytes() for path in root.rglob("*.pyc")}
    return {_source(path): {path.as_posix(): code} for path, code in compiled_files.items()}


def compile_folder(folder: Path, where: str, python: str) -> None:
    """Put bytecode beside each module below the folder. `where` is the folder's path where the modules will run."""
    subprocess.run([python, "-I", "-c", _COMPILE, str(folder), where], capture_output=True, check=False)  # noqa: S603


def _source(bytecode: Path) -> str:
    """Return the source file of a bytecode file: `a/b.py` for `a/__pycache__/b.cpython-313.pyc`."""
    return bytecode.parent.parent.joinpath(bytecode.name.rsplit(".", 2)[0] + ".py").as_posix()
