"""Starts processes of `python -m MODULE` or `python SCRIPT` whose imports are already done.

A trial server takes longer to import numpy and gymnasium than most tests take with it. So one process makes the imports
once, and forks for each test (it is called the forker here). A forked process has its own memory, files, time, signals and
session, and the system shows them as its own; only its command line is the forker's, and it ends without freeing its
modules. Tests of the first moments of a process start it as users do.
"""

from __future__ import annotations

import atexit
import contextlib
import functools
import gc
import hashlib
import importlib
import io
import json
import os
import runpy
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import IO, Any

ROOT = Path(__file__).resolve().parents[1]
LOADED = ("trial.__main__", "gymnasium", "local.__main__", "local.check.__main__", "local.rehearsal.__main__")
AGENT = "local.check.agent_process"
EXPERIMENT = "experiment.py"
_COMMANDS = (
    *("operate.doctor", "operate.status", "operate.logs", "operate.stop", "operate.data", "cost.cost"),
    *("lifecycle.up", "lifecycle.destroy"),  # and with `up` all that it does: plan, apply, certificate, register
)
_SIZE = ("COLUMNS", "TERM")  # variables that consoles read when they are made
OTHERS: dict[str, tuple[tuple[str, ...], dict[str, str]]] = {
    AGENT: ((AGENT,), {"PYTHONDONTWRITEBYTECODE": "1"}),  # nothing else: it reports what an agent has loaded
    "deploy": (
        ("deploy.__main__", *(f"deploy.{name}" for name in _COMMANDS)),
        {"PYTHONUTF8": "1", "COLUMNS": "160", "TERM": "dumb"},  # its consoles are made when it is loaded
    ),
    # Only what every experiment of Interactive Gym imports itself: what it has loaded becomes part of its project.
    EXPERIMENT: (("trial.interactive_gym.server_app", "gymnasium", "yaml"), {"PYTHONDONTWRITEBYTECODE": "1"}),
}
"""The modules and scripts with a forker of their own: the modules that this forker has loaded, and its variables."""

_ASKS = "ASKS_FOR_PROCESSES"  # the variable with the file descriptor at which a process asks its forker for others
_asks_at = os.environ.pop(_ASKS, "")
_ROOM = "ROOM"  # a long variable and a long argument: room for those that `forked_servers.py` lets the system show


class Forked:
    """A process that a forker has made, with the methods of `subprocess.Popen` that tests use."""

    def __init__(self, told: socket.socket, stdout: IO[str] | None) -> None:
        self._told = told
        self.stdout = stdout
        self.pid = int(told.recv(100))
        self.returncode: int | None = None

    def poll(self) -> int | None:
        """Return the exit code; None while the process runs."""
        with contextlib.suppress(BlockingIOError):
            self._look(0)
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Wait until the process has ended, and return its exit code. Raises TimeoutExpired after `timeout` seconds."""
        try:
            self._look(timeout)
        except TimeoutError:
            raise subprocess.TimeoutExpired(str(self.pid), timeout or 0) from None
        assert self.returncode is not None
        return self.returncode

    def communicate(self, timeout: float) -> tuple[str, None]:
        """Wait until the process has ended, and return the rest of its output, and None. Raises TimeoutExpired."""
        assert self.stdout is not None
        until, read = time.monotonic() + timeout, [b""]
        while select.select([self.stdout], [], [], max(0.0, until - time.monotonic()))[0]:
            read.append(os.read(self.stdout.fileno(), 1 << 16))
            if not read[-1]:
                self.wait(max(0.0, until - time.monotonic()))
                return b"".join(read).decode(), None
        raise subprocess.TimeoutExpired(str(self.pid), timeout)

    def _look(self, seconds: float | None) -> None:
        if self.returncode is None:
            self._told.settimeout(seconds)
            self.returncode = int(self._told.recv(100))
            self._told.close()

    def send_signal(self, number: int) -> None:
        """Send a signal to the process, unless it has ended."""
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):  # it has ended since
                os.kill(self.pid, number)

    def kill(self) -> None:
        """End the process at once."""
        self.send_signal(9)


def interruptible() -> None:
    """Let SIGINT end this process. A shell lets its background processes ignore it, and their children, too."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


def start(
    module: str,
    arguments: Sequence[str] = (),
    *,
    cwd: Path,
    env: Mapping[str, str],
    stdout: IO[Any] | int,
    stderr: IO[Any] | int,
    start_new_session: bool = False,
    safe_path: bool = False,
    starts: bool = False,
    copied: bool = False,
) -> Forked | subprocess.Popen[str]:
    """Run `python -m MODULE ARGUMENTS` in a forked process. The other arguments are Popen's; `safe_path` is Python's -P.

    A `module` that ends with `.py` is a script in `cwd`: `python SCRIPT ARGUMENTS` runs. `stdout` may be PIPE, `stderr`
    STDOUT. `starts`: the process itself calls `start`; its forker then forks for it, too. `copied`: the project in `cwd`
    is a copy, whose own modules are loaded, and loaded again after each change of its code.

    Popen starts the process if the system has no pidfd_open, or, unless it is `copied`, if variables in `env` change how
    Python starts.
    """
    kind = module if module in OTHERS else ""
    if not hasattr(os, "pidfd_open") or not (copied or _of_python(env) == _of_python(_environment(kind))):
        return subprocess.Popen(
            [
                sys.executable,
                *(["-P"] if safe_path else []),
                *([] if _is_script(module) else ["-m"]),
                module,
                *arguments,
            ],
            cwd=cwd,
            env=env,
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            text=True,
            start_new_session=start_new_session,
            preexec_fn=interruptible,  # noqa: PLW1509 - it sets a signal and no more
        )
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    reading = None
    with contextlib.ExitStack() as opened:
        opened.enter_context(theirs)
        if stdout == subprocess.PIPE:
            read, write = os.pipe()
            reading = open(read, encoding="utf-8")  # noqa: SIM115 - the caller's
            out: Any = opened.enter_context(open(write, "wb"))
        else:
            out = stdout
        fds = [
            each if isinstance(each, int) else each.fileno()
            for each in (out, out if stderr == subprocess.STDOUT else stderr)
        ]
        request = {
            "module": module,
            "arguments": [*arguments],
            "cwd": str(cwd),
            "env": dict(env),
            "session": start_new_session,
            "safe_path": safe_path,
            "starts": starts,
        }
        forker = _forker_of_copy(kind, cwd, env) if copied else _forker(kind)
        socket.send_fds(forker, [json.dumps(request).encode()], [theirs.fileno(), *fds])
    return Forked(ours, reading)


def popen(command: Sequence[str], **options: Any) -> Forked | subprocess.Popen[str] | subprocess.Popen[bytes]:
    """Call `subprocess.Popen`, except for the process in which `make check` tries an agent: that one is forked."""
    tries_agent = [sys.executable, "-P", "-m", AGENT]
    if command[: len(tries_agent)] != tries_agent:
        return subprocess.Popen(command, **options)
    assert options.pop("stdin") == subprocess.DEVNULL  # every caller passes it
    return start(AGENT, command[len(tries_agent) :], safe_path=True, **options)


def _is_script(module: str) -> bool:
    return module.endswith(".py")


def _of_python(env: Mapping[str, str]) -> dict[str, str]:
    """Return the variables that Python reads when it starts, except PYTHONUNBUFFERED, which `_text` obeys."""
    return {name: value for name, value in env.items() if name.startswith("PYTHON") and value} | {
        "PYTHONUNBUFFERED": ""
    }


def _environment(kind: str) -> dict[str, str]:
    return {**os.environ, "PYTHONPATH": str(ROOT), **(OTHERS[kind][1] if kind else {})}


@functools.cache
def _forker(kind: str) -> socket.socket:
    """Return a socket to the forker of this kind (a key of `OTHERS`, or empty), which ends with the tests."""
    if _asks_at and not kind:
        return socket.socket(fileno=int(_asks_at))
    return new_forker(_modules(kind), ROOT, _environment(kind))


def _modules(kind: str) -> Sequence[str]:
    return OTHERS[kind][0] if kind else LOADED


def start_all() -> None:
    """Start all forkers. Processes that are forked from this one use the same forkers."""
    for kind in ("", *OTHERS):
        _forker(kind)


def _forker_of_copy(kind: str, root: Path, env: Mapping[str, str]) -> socket.socket:
    """Return a socket to the forker that has loaded the present code of the copy of the project in `root`."""
    read = _of_python(env) | {name: env[name] for name in _SIZE if name in env}
    return _forker_of_code(kind, root, tuple(sorted(read.items())), _state_of_code(root))


@functools.cache
def _forker_of_code(kind: str, root: Path, read: tuple[tuple[str, str], ...], _code: str) -> socket.socket:
    others = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON") and name not in _SIZE}
    return new_forker(_modules(kind), root, {**others, **dict(read)})


def _state_of_code(root: Path) -> str:
    """Return a text that changes whenever a module below `root` does."""
    files = ((str(path), path.stat()) for path in sorted(root.rglob("*.py")))
    return hashlib.sha256(repr([(path, s.st_mtime_ns, s.st_size) for path, s in files]).encode()).hexdigest()


def new_forker(modules: Sequence[str], root: Path, env: Mapping[str, str]) -> socket.socket:
    """Start a forker that has loaded these modules, those of the project from `root`. It ends when the socket is closed."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1 << 20)
    with theirs:
        subprocess.Popen(
            [
                *(sys.executable, "-m", "testing.preloaded", str(theirs.fileno()), str(root)),
                *modules,
                " " * 2000,
            ],
            cwd=ROOT,
            env={**env, _ROOM: " " * 8000},
            stdin=subprocess.DEVNULL,
            pass_fds=[theirs.fileno()],
        )
    return ours


# -- in the forker


def _serve(requests: socket.socket, told_by_imports: Mapping[str, str]) -> dict[str, Any] | None:
    """Fork for each request, and send the exit code of each process that has ended.

    It returns twice: in a new process its request, and in the forker, at the end, None.
    """
    running: dict[int, tuple[socket.socket, int]] = {}  # by the file that tells of the end
    asking = {requests.fileno(): requests}  # the tests, and processes that start others
    while True:
        ready, _, _ = select.select([*asking, *running], [], [])
        for each in ready:
            if each in running:
                told, pid = running.pop(each)
                os.close(each)
                code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                with told, contextlib.suppress(OSError):  # the process that started it may have ended
                    told.send(str(code).encode())
                continue
            body, fds, _, _ = socket.recv_fds(asking[each], 1 << 20, 3)
            if not body and each == requests.fileno():
                return None
            if not body:
                asking.pop(each).close()
                continue
            wanted: dict[str, Any] = json.loads(body)
            asks, asked = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET) if wanted["starts"] else (None, None)
            told, pid = socket.socket(fileno=fds[0]), os.fork()
            if pid == 0:
                for open_socket in filter(None, (told, asked, *asking.values(), *(one for one, _ in running.values()))):
                    open_socket.detach()  # `_become` closes their files
                wanted["env"].update(told_by_imports)
                _become(wanted, fds[1], fds[2], asks.detach() if asks else None)
                return wanted
            for file in fds[1:]:
                os.close(file)
            if asks and asked:
                asks.close()
                asking[asked.fileno()] = asked
            with contextlib.suppress(OSError):  # the process that asked may have been killed
                told.send(str(pid).encode())
            running[os.pidfd_open(pid)] = told, pid


def _become(request: dict[str, Any], stdout: int, stderr: int, asks: int | None) -> None:
    """Give this process the files, folder, variables and arguments of a new one."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if request["session"]:
        os.setsid()
    os.dup2(stdout, 1)
    os.dup2(stderr, 2)
    if asks is not None:
        os.dup2(asks, 3, inheritable=False)
        request["env"][_ASKS] = "3"
    os.closerange(3 if asks is None else 4, 1 + max(map(int, os.listdir("/proc/self/fd"))))
    os.chdir(request["cwd"])
    os.environ.clear()
    os.environ.update(request["env"])
    sys.stdin = sys.__stdin__ = open(0, encoding="utf-8", closefd=False)  # type: ignore[misc] # noqa: SIM115
    sys.stdout = sys.__stdout__ = _text(1, "strict")  # type: ignore[misc]
    sys.stderr = sys.__stderr__ = _text(2, "backslashreplace")  # type: ignore[misc]
    sys.argv = [request["module"], *request["arguments"]]
    sys.path[:1] = [] if request["safe_path"] else [request["cwd"]]


def _run_script(path: Path) -> None:
    """Run a script as `python SCRIPT` does. `runpy.run_path` would change sys.argv."""
    main = sys.modules["__main__"] = ModuleType("__main__")
    main.__file__ = str(path)
    exec(compile(path.read_bytes(), path, "exec"), vars(main))


def _text(number: int, errors: str) -> io.TextIOWrapper:
    unbuffered = bool(os.environ.get("PYTHONUNBUFFERED"))
    file: Any = open(number, "wb", buffering=0 if unbuffered else -1, closefd=False)  # noqa: SIM115
    return io.TextIOWrapper(file, "utf-8", errors, line_buffering=number == 2, write_through=unbuffered)


def _main() -> dict[str, Any] | None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the tests'; they end this process
    del os.environ[_ROOM]
    before = dict(os.environ)
    sys.path[0] = sys.argv[2]
    with socket.socket(fileno=int(sys.argv[1])) as requests:
        for name in sys.argv[3:-1]:
            importlib.import_module(name)
            if name == AGENT or name.endswith(".__main__"):
                del sys.modules[name]  # it runs as the main module
        gc.collect()
        gc.freeze()
        return _serve(requests, dict(os.environ.items() - before.items()))  # gymnasium sets one for pygame


def _run(wanted: Mapping[str, Any]) -> int:
    """Run the module or script. Returns the exit code."""
    try:
        if _is_script(wanted["module"]):
            _run_script(Path(wanted["module"]).absolute())
        else:
            runpy.run_module(wanted["module"], run_name="__main__", alter_sys=True)
    except SystemExit as ended:
        if not isinstance(ended.code, int | None):
            raise
        return ended.code or 0
    return 0


def _end(code: int) -> None:
    """End this process as Python does, except that the modules are not freed: that takes longer than most processes run."""
    threading._shutdown()  # type: ignore[attr-defined]
    atexit._run_exitfuncs()
    with contextlib.suppress(OSError, ValueError):  # Python reports it at its own end, which follows
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code & 0xFF)


if __name__ == "__main__":
    if wanted := _main():
        code = _run(wanted)
        _end(code)
        sys.exit(code)
