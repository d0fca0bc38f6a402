"""The process that listens. It forks a process for each connection (`connection.py`), and ends those beyond a limit.

It has one thread, runs no environment and reads nothing from clients, so neither of them can hold it up. It keeps a
descriptor of each connection: if a connection's process did not end by itself, another one tells the client why.
"""

from __future__ import annotations

import contextlib
import gc
import os
import select
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, NoReturn

from hippodrome.trial.gym import linux
from hippodrome.trial.gym.forms import described
from hippodrome.trial.gym.settings import PATH, Limits, Settings

REFUSING = 16
"""The connections beyond the limit that get a process, which refuses them with a sentence."""
_TICK_SECONDS = 0.25  # between two looks at which processes have ended
_USAGE_SECONDS = 1.0  # between two looks at memory and processes
_END_SECONDS = 3.0  # for clients to be told that the server ends
_AWAY, _FAILED = 1001, 1011  # close codes (RFC 6455, 7.4.1)


def start(host: str = "127.0.0.1", port: int = 5000, **options: Any) -> None:
    """Serve environments at ws://host:port/gym until Ctrl-C or SIGTERM, with the functions of `override`.

    It prints the address once it listens. Without a `host` it listens at this machine alone, unlike Gymie. If the
    address cannot be used, it prints a sentence and returns, as Gymie does. `options` are those of `serve`, such as
    `limits`. Raises RuntimeError outside of the main thread, where signals cannot be received.
    """
    if threading.current_thread() is not threading.main_thread():
        raise RuntimeError("The server must be started in the main thread of the program: signals end it.")
    try:
        serve(host, port, **options)
    except (OSError, UnicodeError) as error:
        print(f"Address ws://{host}:{port} cannot be used: {unusable(error)}", file=sys.stderr)


def serve(
    host: str,
    port: int,
    limits: Limits | None = None,
    *,
    modules: Sequence[str] = (),
    origins: Sequence[str] = (),
    output: bool = False,
    record: Path | None = None,
) -> int:
    """Serve environments until SIGINT or SIGTERM. Return the exit status. The options are those of `Settings`.

    Raises OSError or UnicodeError if the address cannot be used.
    """
    settings = Settings(limits or Limits(), modules, origins, output, record)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family, backlog=512) as listener:
        server = _Server(listener, settings)
        before = signal.signal(signal.SIGTERM, _interrupt)
        try:
            if not server.can_import_modules():
                return 1
            address = f"{f'[{host}]' if ':' in host else host}:{listener.getsockname()[1]}"
            print(f"Environments are served at ws://{address}{PATH}. Ctrl-C ends it.", flush=True)
            server.run()
        except KeyboardInterrupt:
            return 0
        finally:
            signal.signal(signal.SIGTERM, before)


@dataclass(slots=True)
class _Child:
    """The process of a connection."""

    connection: socket.socket
    close: tuple[int, str] | None = None
    """The close code and the sentence for its client, if the server has killed the process."""
    refuses: bool = False
    """Whether the process only refuses a client, or tells it why its connection ends."""
    gone_since: float | None = None
    """When it was first seen that the client has gone."""


class _Server:
    def __init__(self, listener: socket.socket, settings: Settings) -> None:
        self._listener = listener
        self._settings = settings
        self._limits = settings.limits
        self._work = _imported_without_threads()
        self._children: dict[int, _Child] = {}
        self._others = set(linux.children(os.getpid()))  # processes that the program has started before
        self._usage_checked = 0.0

    def can_import_modules(self) -> bool:
        """Import the modules in another process, which prints why it cannot, so that this one gets no threads."""
        pid = os.fork()
        if pid:
            return os.waitpid(pid, 0)[1] == 0
        status = 1
        try:
            self._work.import_modules(self._settings.modules)
            status = 0
        except Exception as error:  # noqa: BLE001 - a researcher's module may raise anything
            print(f"{', '.join(self._settings.modules)} cannot be imported: {described(error)}", file=sys.stderr)
        finally:
            _exit(status)

    def run(self) -> NoReturn:
        """Serve until a signal raises KeyboardInterrupt, which passes on when all processes have ended."""
        linux.become_subreaper()
        gc.collect()
        gc.freeze()  # so that the collector does not write to pages that the processes share
        self._listener.setblocking(False)
        try:
            while True:
                if select.select([self._listener], [], [], _TICK_SECONDS)[0]:
                    self._accept()
                self._reap()
                self._check_usage()
        finally:
            self._close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError:  # no file can be opened; without a pause, the loop would try this all the time
            time.sleep(_TICK_SECONDS)
            return
        connection.setblocking(True)
        most = self._limits.connections
        if len(self._children) >= most + REFUSING:
            connection.close()
            return
        full = sum(not child.refuses for child in self._children.values()) >= most
        work = partial(self._work.serve_client, connection, self._settings, full=full)
        self._fork(_Child(connection, refuses=full), work)

    def _fork(self, child: _Child, work: Callable[[], None]) -> None:
        """Let a new process do this work with a connection, or close the connection if no process can be started."""
        parent = os.getpid()
        sys.stdout.flush()
        sys.stderr.flush()
        try:
            pid = os.fork()
        except OSError:
            child.connection.close()
            return
        if pid:
            self._children[pid] = child
            return
        status = 1
        try:
            os.setsid()
            linux.become_subreaper()
            linux.die_with(parent)
            for number in (signal.SIGINT, signal.SIGTERM, signal.SIGALRM):
                signal.signal(number, signal.SIG_DFL)
            self._listener.close()
            for other in self._children.values():
                other.connection.close()
            work()
            status = 0
        except BaseException:  # noqa: BLE001 - it must not return into the loop of its parent
            traceback.print_exc()
        finally:
            _exit(status)

    def _check_usage(self) -> None:
        """End connections whose environments have too many processes, use too much memory, or outlast their client."""
        now, limits = time.monotonic(), self._limits
        if now - self._usage_checked < _USAGE_SECONDS:
            return
        self._usage_checked = now
        for pid, child in self._children.items():
            if _has_gone(child.connection):
                child.gone_since = child.gone_since or now
            started = linux.descendants(pid)
            if child.gone_since is not None and now - child.gone_since > limits.seconds:
                self._end(pid, "The client has gone.")  # the environment hangs, and has taken SIGALRM for itself
            elif len(started) > limits.processes:
                self._end(pid, f"The environments started more than {limits.processes} processes; all were ended.")
            elif sum(map(linux.used_megabytes, (pid, *started))) > limits.megabytes:
                self._end(pid, f"The environments used more than {limits.megabytes} MB; their process was ended.")

    def _end(self, pid: int, sentence: str, code: int = _FAILED) -> None:
        self._children[pid].close = self._children[pid].close or (code, sentence)
        _kill(pid)

    def _reap(self) -> None:
        """Collect processes that have ended, and kill the processes that these have left."""
        for pid in list(self._children):
            status = _ended(pid)
            if status is None:
                continue
            child = self._children.pop(pid)
            # Its group ends here. On Linux its other descendants become this process's children.
            with contextlib.suppress(OSError):
                os.killpg(pid, signal.SIGKILL)
            close = child.close
            if close is None and status != 0:
                close = (_FAILED, self._how(status))
            if close is None or child.refuses:
                child.connection.close()
            else:
                goodbye = partial(self._work.say_goodbye, child.connection, *close)
                self._fork(_Child(child.connection, refuses=True), goodbye)
        for stray in linux.children(os.getpid()):
            if stray not in self._children and stray not in self._others:
                _kill(stray)
                _ended(stray)

    def _how(self, status: int) -> str:
        """Say how a process has ended, by its wait status."""
        if not os.WIFSIGNALED(status):
            return f"The environment ended its process (exit status {os.WEXITSTATUS(status)})."
        if os.WTERMSIG(status) == signal.SIGALRM:
            return f"The environment took longer than {self._limits.seconds:g} s; its process was ended."
        return f"The environment ended its process (signal {signal.Signals(os.WTERMSIG(status)).name})."

    def _close(self) -> None:
        """End all processes, and tell their clients that the server ends."""
        self._listener.close()
        until = time.monotonic() + _END_SECONDS
        try:
            for pid in self._children:
                self._end(pid, "The server ends.", _AWAY)
            while self._children and time.monotonic() < until:
                self._reap()
                time.sleep(0.01)
        finally:
            for pid in self._children:
                _kill(pid)
            self._reap()


def _imported_without_threads() -> ModuleType:
    """Import what a connection's process needs, so that it has it at once: importing takes half a second.

    A fork has only one of its parent's threads. So OpenBLAS, which numpy brings, must start none: if a program has
    imported numpy before, OpenBLAS itself takes care of that.
    """
    name = "OPENBLAS_NUM_THREADS"
    before = os.environ.get(name)
    os.environ[name] = "1"
    try:
        from hippodrome.trial.gym import connection  # noqa: PLC0415
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
    return connection


def _has_gone(connection: socket.socket) -> bool:
    """Whether the client has ended the connection. Reads nothing, which is its process's part."""
    poll = select.poll()
    poll.register(connection, getattr(select, "POLLRDHUP", select.POLLHUP))
    return bool(poll.poll(0))


def _ended(pid: int) -> int | None:
    """Return the status of a process that has ended; None if it runs."""
    try:
        ended, status = os.waitpid(pid, os.WNOHANG)
    except ChildProcessError:
        return 0
    return status if ended else None


def _kill(pid: int) -> None:
    """Kill a process, and its group if it has one of its own."""
    for kill in (os.killpg, os.kill):
        with contextlib.suppress(OSError):
            kill(pid, signal.SIGKILL)


def _exit(status: int) -> NoReturn:
    """End a forked process, which must not run what its parent does at its end."""
    with contextlib.suppress(OSError, ValueError):
        sys.stdout.flush()
        sys.stderr.flush()
    os._exit(status)


def unusable(error: OSError | UnicodeError) -> str:
    """Return why a server cannot listen at an address."""
    number = error.errno or 0 if isinstance(error, OSError) else 0
    return os.strerror(number) if number > 0 else "there is no such host"  # getaddrinfo's numbers are negative


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt
