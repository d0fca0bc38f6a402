"""Runs tests against mutants, each in a process that is forked from one that has already imported the libraries.

Sources are changed in copies of the folder, one for each process at a time, never in the folder itself.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import importlib.util
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, settings

from tests.mutation.mutants import Mutant

LEFT_OUT = shutil.ignore_patterns(".*", "__pycache__", "data", "shots")
OPTIONS = ("-x", "-q", "--no-header", "--no-summary", "-p", "no:randomly", "-p", "no:cacheprovider", "-k", "not S3")
MEMORY = 8 * 2**30
EMPTY = int(pytest.ExitCode.NO_TESTS_COLLECTED)

# A test that fails has killed its mutant: there is no need to shrink the example.
settings.register_profile(
    "mutants",
    max_examples=25,
    derandomize=True,
    database=None,
    deadline=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)


@dataclass
class Run:
    """A process that runs tests against a mutant. `until` is the time at which it is killed."""

    process: int
    folder: Path
    mutant: Mutant
    until: float


class Fails(Exception):
    """The tests fail, or do not exist, without any mutation."""


class Runner:
    """Judges mutants of the files in `root`, `at_once` at a time.

    A mutant's tests may take `seconds` of CPU time. They end after `idle` seconds by the clock (by default three times
    as long) if they take none, or get none.
    """

    def __init__(self, root: Path, *, at_once: int = 2, seconds: float = 60, idle: float | None = None) -> None:
        self._root = root
        self._at_once = at_once
        self._seconds = seconds
        self._idle = 3 * seconds if idle is None else idle

    def warm(self, tests: Sequence[str]) -> None:
        """Run the tests unchanged, then import here all the libraries that they have imported. Raises Fails."""
        with tempfile.TemporaryDirectory(prefix="mutants-") as name:
            folder, loaded = self._copy(name), Path(name, "loaded")
            process = _fork(folder, tests, self._seconds * 10, loaded)
            if os.waitstatus_to_exitcode(os.waitpid(process, 0)[1]):
                raise Fails(f"without a mutation: {loaded.with_name('said').read_text()}")
            for library in loaded.read_text().split():
                with contextlib.suppress(ImportError):
                    importlib.import_module(library)
            gc.freeze()

    def judge(self, mutants: Sequence[Mutant], tests: Mapping[str, Sequence[str]]) -> Iterator[tuple[Mutant, bool]]:
        """Yield each mutant, and whether its module's tests have killed it.

        One that hangs or takes all memory counts as killed.

        Raises Fails if a module's tests kill the module as it is: they would kill each of its mutants.
        """
        for unchanged, code in self._run_each(self._unchanged(mutants, tests), tests):
            if code == EMPTY:
                raise Fails(f"there is no test of {unchanged.module}")
            if code:
                raise Fails(f"the tests of {unchanged.module} cannot judge it: without a mutation they end with {code}")
        for mutant, code in self._run_each(mutants, tests):
            yield mutant, code != 0

    def _unchanged(self, mutants: Sequence[Mutant], tests: Mapping[str, Sequence[str]]) -> Sequence[Mutant]:
        """Return an unchanged module for each selection of tests that these mutants need."""
        modules = {tuple(tests[mutant.module]): mutant.module for mutant in mutants}
        return [Mutant(module, 0, "", "", (self._root / module).read_text()) for module in modules.values()]

    def _run_each(self, mutants: Sequence[Mutant], tests: Mapping[str, Sequence[str]]) -> Iterator[tuple[Mutant, int]]:
        """Yield each mutant, and the exit code of its module's tests."""
        with tempfile.TemporaryDirectory(prefix="mutants-") as name:
            free = [self._copy(f"{name}/{number}") for number in range(self._at_once)]
            sources = {module: (free[0] / module).read_text() for module in tests}
            todo, runs = list(reversed(mutants)), dict[int, Run]()
            while todo or runs:
                while todo and free:
                    mutant, folder = todo.pop(), free.pop()
                    _write(folder / mutant.module, mutant.source)
                    process = _fork(folder, tests[mutant.module], self._seconds)
                    runs[process] = Run(process, folder, mutant, time.monotonic() + self._idle)
                time.sleep(0.01)
                for run in list(runs.values()):
                    if time.monotonic() > run.until:
                        os.kill(run.process, signal.SIGKILL)
                    process, status = os.waitpid(run.process, os.WNOHANG)
                    if process:
                        del runs[process]
                        with contextlib.suppress(ProcessLookupError):  # what the tests have left running
                            os.killpg(process, signal.SIGKILL)
                        _write(run.folder / run.mutant.module, sources[run.mutant.module])
                        free.append(run.folder)
                        yield run.mutant, os.waitstatus_to_exitcode(status)

    def _copy(self, folder: str) -> Path:
        return Path(shutil.copytree(self._root, Path(folder, "copy"), ignore=LEFT_OUT))


def _write(path: Path, source: str) -> None:
    """Write a source, and remove its cached bytecode, which Python could take for the new source's."""
    path.write_text(source)
    cache = Path(importlib.util.cache_from_source(str(path)))
    cache.unlink(missing_ok=True)


def _fork(folder: Path, tests: Sequence[str], seconds: float, loaded: Path | None = None) -> int:
    sys.stdout.flush()
    process = os.fork()
    if process:
        return process
    code = 1
    gc.freeze()  # to look for garbage in what the parent has would take seconds, and copy all of its memory
    try:
        os.setsid()
        resource.setrlimit(resource.RLIMIT_CPU, (int(seconds), int(seconds) + 1))
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        code = _run(folder, tests, loaded)
    finally:
        os._exit(code)


def _run(folder: Path, tests: Sequence[str], loaded: Path | None) -> int:
    """Run tests with the sources of `folder` in this process, and return the exit code.

    The names of the libraries that they have imported are written to `loaded`, if it is given.
    """
    os.chdir(folder)
    said = os.open(folder.parent / "said", os.O_RDWR | os.O_CREAT | os.O_TRUNC)
    for stream in (0, 1, 2):
        os.dup2(said, stream)
    ours = {path.stem for path in folder.iterdir()}
    for name in [name for name in sys.modules if name.partition(".")[0] in ours]:
        del sys.modules[name]
    sys.path[:] = [str(folder), *(path for path in sys.path if path not in ("", str(Path.cwd())))]
    before = set(sys.modules)
    options = [*OPTIONS, "--rootdir", str(folder), "--hypothesis-profile", "mutants"]
    # The first file of tests runs by itself: it kills most mutants before the other files are even collected.
    groups = [group for group in (tests[:1], tests[1:]) if group]
    code = next((code for group in groups if (code := int(pytest.main([*options, *group])))), 0)
    if loaded:
        # In the order of their imports: asyncio does not work if _asyncio is imported before it.
        new = [name for name in sys.modules if name not in before and name.partition(".")[0] not in ours]
        loaded.write_text("\n".join(new))
    return code
