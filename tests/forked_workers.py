"""Workers of pytest-xdist that are forked from a process that has collected the tests.

Each worker has to import all tests and what they import, which takes 6 workers 40 seconds of processor time. Here one process does
so; it forks for each worker, which then finds all modules imported. Where the system does not tell of the end of processes by files
(`os.pidfd_open`), as macOS, pytest-xdist starts its workers as it always does. A plugin of pytest.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

from testing import preloaded

TESTS = Path(__file__).resolve().parent
ROOT = TESTS.parent
CLIENT = Path(__file__).with_name("worker_client.py")


def _is_possible() -> bool:
    try:
        os.close(os.pidfd_open(os.getpid()))
    except (AttributeError, OSError):
        return False
    return True


POSSIBLE = _is_possible()
"""Whether this system tells of the end of processes by files."""


def pytest_xdist_setupnodes(config: Any, specs: Sequence[Any]) -> None:
    """Have workers started by the command that lets them be forked."""
    if POSSIBLE:
        opened = contextlib.ExitStack()
        config.add_cleanup(opened.close)
        command = opened.enter_context(_collected(config.args, config.rootpath))
        for spec in specs:
            spec.python = command


@contextlib.contextmanager
def _collected(args: Sequence[str], folder: Path) -> Iterator[str]:
    """Start the process that collects the tests of these arguments of pytest in `folder`. Yields the command of a worker."""
    place = Path(tempfile.mkdtemp(prefix="workers-"))
    with contextlib.ExitStack() as ends:
        ends.callback(shutil.rmtree, place)
        with socket.socket(socket.AF_UNIX) as asked:
            asked.bind(str(place / "socket"))
            asked.listen()
            process = subprocess.Popen(
                [sys.executable, "-u", "-m", "tests.forked_workers", str(asked.fileno()), *args],
                cwd=folder,
                env={**os.environ, "PYTHONPATH": str(ROOT)},
                stdin=subprocess.PIPE,
                pass_fds=[asked.fileno()],
            )
        ends.callback(process.wait)
        assert process.stdin is not None
        ends.callback(process.stdin.close)  # it ends with that
        yield shlex.join([sys.executable, "-IS", str(CLIENT), str(place / "socket")])


# -- in that process


def _collect(args: Sequence[str]) -> str:
    """Import what these tests need. Returns why workers cannot use that, or an empty string.

    A module may keep `sys.stdout`, so pytest must not put another one in its place.
    """
    import pytest

    with tempfile.TemporaryFile() as said:
        kept = [os.dup(number) for number in (1, 2)]
        for number in (1, 2):
            os.dup2(said.fileno(), number)
        code = pytest.main([*args, "-p", "xdist", "-n0", "--collect-only", "--capture=no"])
        for number, file in enumerate(kept, 1):
            os.dup2(file, number)
            os.close(file)
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
        return "the tests cannot be collected"  # what failed to be imported once is not tried again
    if threading.active_count() > 1:
        return f"importing the tests starts threads: {', '.join(each.name for each in threading.enumerate()[1:])}"
    return ""


def _load() -> None:
    """Load what most workers will load."""
    from testing import moto_world

    moto_world.load()


def _begin_again(asked: socket.socket, why: str) -> NoReturn:
    """Become a process that has imported nothing. Its workers do what they do without it, and report what is wrong."""
    print(f"Each worker imports the tests itself: {why}", file=sys.stderr)
    asked.set_inheritable(True)
    command = [sys.executable, "-u", "-m", "tests.forked_workers", str(asked.fileno())]
    os.execve(sys.executable, command, {**os.environ, "PYTHONPATH": str(ROOT)})


def _serve(asked: socket.socket) -> bool:
    """Fork for each client, and tell it the exit code. Returns True in a new worker, False when the tests are over."""
    new: list[socket.socket] = []  # clients that have not asked yet
    running: dict[int, tuple[int, socket.socket]] = {}  # process and client, by the file that tells of the end
    over: list[int] = [0]  # the file that tells that the tests are over
    while over or running:
        ready, _, _ = select.select([*over, asked, *new, *running], [], [])
        for each in ready:
            if each in over:
                over.remove(each)
            elif each is asked:
                new.append(asked.accept()[0])
            elif each in running:
                process, client = running.pop(each)
                os.close(each)
                code = os.waitstatus_to_exitcode(os.waitpid(process, 0)[1])
                with client, contextlib.suppress(OSError):
                    client.send(str(code % 256).encode())
            elif each in new:
                new.remove(each)
                _, fds, _, _ = socket.recv_fds(each, 100, 3)
                if not fds:  # the client was ended
                    each.close()
                    continue
                process = os.fork()
                if not process:
                    for open_socket in (asked, each, *new, *(client for _, client in running.values())):
                        open_socket.close()
                    for file in running:
                        os.close(file)
                    _become(fds)
                    return True
                for file in fds:
                    os.close(file)
                running[os.pidfd_open(process)] = process, each
    return False


def _become(fds: Sequence[int]) -> None:
    """Have the files and the signals of a worker."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    for number, file in enumerate(fds):
        os.dup2(file, number)
        os.close(file)
    sys.argv = ["-c"]


def _main() -> bool:
    with socket.socket(fileno=int(sys.argv[1])) as asked:
        args = sys.argv[2:]
        if args == [TESTS.name]:
            preloaded.start_all()  # several workers will need each
        if args and (why := _collect(args)):
            _begin_again(asked, why)
        if args == [TESTS.name]:
            _load()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the workers'
        # numpy's OpenBLAS and pyarrow's allocator have threads, and prepare for forks.
        warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
        gc.collect()
        gc.freeze()
        return _serve(asked)


if __name__ == "__main__" and _main():
    main = sys.modules["__main__"] = ModuleType("__main__")
    exec(eval(sys.stdin.readline()), vars(main))  # what execnet has a new Python do
