"""Faults of one machine at single system calls for files, processes, threads and sockets.

Faults are injected *below* `hippodrome/local/`, in the functions of Python's library that make the system call. A call is
identified by its operation and its kind of file (`OsCall`) and by its number among those: threads make calls in an
order that changes from run to run, but the n-th call of one kind is nearly always the same.

* `OsReach.ONCE`: this call fails.
* `OsReach.SPELL`: this call fails, and for `SPELL_SECONDS` each call that can fail with the same errno, as on a full
  disk.
* `OsReach.EVER`: the data folder and the state folder are on different file systems, so no hard link can be made
  between them.
* `OsReach.BEFORE`, `OsReach.AFTER`: the process is killed (`kill -9`) just before the call, or just after it. None of
  its threads makes another call.
"""

from __future__ import annotations

import builtins
import contextlib
import errno
import fcntl
import io
import os
import re
import socket
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

SPELL_SECONDS = 0.4


class OsReach(StrEnum):
    """The effect of a fault: one call, several calls, or the process. The module's docstring explains the values."""

    ONCE = "once"
    SPELL = "for a while"
    EVER = "another file system"
    BEFORE = "killed before"
    AFTER = "killed after"


KILLS = (OsReach.BEFORE, OsReach.AFTER)


class OsCall(NamedTuple):
    """A kind of call: its operation, and the kind of file that it is made for (`OsFaultInjector.place`)."""

    operation: str
    place: str


class OsFault(NamedTuple):
    """A fault of the `number`-th call of this kind, counted from 1, with this `errno`; a kill has none."""

    call: OsCall
    number: int
    reach: OsReach
    errno: int = 0

    def __str__(self) -> str:
        name = errno.errorcode.get(self.errno, "")
        return f"{self.call.operation} {self.call.place} #{self.number} {self.reach} {name}".rstrip()


class Killed(BaseException):
    """Raised in each thread of a process that was killed, at its next call."""


# By operation, the errors that Linux may report (man-pages 6, section 2: open, write, fsync, link, rename, unlink,
# mkdir, stat, flock, fork).
ERRORS: dict[str, tuple[int, ...]] = {
    "create": (errno.ENOSPC, errno.EMFILE, errno.EACCES, errno.EROFS),
    "open": (errno.EMFILE, errno.EIO, errno.ENOMEM),
    "write": (errno.ENOSPC, errno.EIO),
    "read": (errno.EIO,),
    "fsync": (errno.EIO, errno.ENOSPC),
    "link": (errno.EXDEV, errno.ENOSPC, errno.EIO),
    "rename": (errno.ENOSPC, errno.EIO),
    "unlink": (errno.EIO, errno.EROFS),
    "mkdir": (errno.ENOSPC, errno.EACCES),
    "list": (errno.EMFILE, errno.EIO),
    "stat": (errno.EACCES, errno.EIO),
    "lock": (errno.ENOLCK,),
    "spawn": (errno.EAGAIN, errno.ENOMEM),
    "thread": (errno.EAGAIN,),
    "connect": (errno.EMFILE, errno.ENOMEM),
    "process": (errno.EMFILE,),  # psutil reads /proc
}
_KINDS = (
    (re.compile(r"s[a-z0-9]{20}-\d+"), "SERVER"),
    (re.compile(r"s[a-z0-9]{20}"), "LABEL"),
    (re.compile(r"[0-9a-f]{8}-[0-9a-f-]{27}\.\d"), "MESSAGE"),
    (re.compile(r"\.[0-9a-f]{16}\.new"), "NEW"),
    (re.compile(r"(?<=locks/)\d+"), "KEY"),
    (re.compile(r"(?<=slots/)\d+"), "SHARD"),
)


class _Off(threading.local):
    """The number of `unharmed` blocks in which this thread is."""

    deep = 0


class OsFaultInjector:
    """Counts the calls for files below `root` (and for /proc, processes, threads, connections), and injects `fault`.

    Calls for which `only` returns False are neither counted nor changed.
    """

    def __init__(self, root: Path, fault: OsFault | None = None, *, only: Callable[[], bool] = lambda: True) -> None:
        self.root = os.path.realpath(root)
        self.fault = fault
        self.calls: Counter[OsCall] = Counter()
        self.struck = 0  # calls that the fault has changed
        self.dead = threading.Event()  # set from a kill until the next process begins
        self.off = _Off()
        self._only = only
        self._generation = 0
        self._spell = 0.0
        self._lock = threading.Lock()

    def begin_process(self) -> None:
        """Begin another process: every thread of the last one gets `Killed` at its next call."""
        with self._lock:
            self._generation += 1
            self.dead.clear()
        threading.current_thread().generation = self._generation  # type: ignore[attr-defined]

    @contextlib.contextmanager
    def unharmed(self) -> Iterator[None]:
        """Leave this thread's calls within the block alone: they are the test's own."""
        self.off.deep += 1
        try:
            yield
        finally:
            self.off.deep -= 1

    def heal(self) -> None:
        """Inject nothing from now on."""
        self.fault, self._spell = None, 0.0

    # Calls

    def place(self, path: Any) -> str | None:
        """Return the kind of file: its path below `root` with words in the place of ids; None for a file elsewhere."""
        try:
            text = os.path.abspath(os.fsdecode(path))
        except (TypeError, ValueError):
            return None
        if text == "/proc" or text.startswith("/proc/"):
            return "proc"
        if not text.startswith(f"{self.root}/"):
            return None
        text = text[len(self.root) + 1 :]
        for pattern, name in _KINDS:
            text = pattern.sub(name, text)
        return text

    def _alive(self) -> None:
        mine = getattr(threading.current_thread(), "generation", 0)
        if mine != self._generation or self.dead.is_set():
            raise Killed

    def _call(self, operation: str, place: str | None, act: Callable[[], Any]) -> Any:
        if place is None or self.off.deep or not self._only():
            return act()
        self._alive()
        call = OsCall("process" if place == "proc" else operation, place)
        error = self._error(call)
        if error is OsReach.BEFORE:
            self.dead.set()
            raise Killed
        if isinstance(error, int):
            raise OSError(error, os.strerror(error))
        result = act()
        if error is OsReach.AFTER:
            self.dead.set()
            raise Killed
        return result

    def _error(self, call: OsCall) -> int | OsReach | None:
        """Count this call.

        Return the errno with which it fails, or how it is killed; None if the call is to be made.
        """
        with self._lock:
            self.calls[call] += 1
            fault = self.fault
            if fault is None:
                return None
            if time.monotonic() < self._spell and fault.errno in ERRORS[call.operation]:
                return fault.errno
            here = fault.call == call and fault.number == self.calls[call]
            if not here or fault.reach is OsReach.EVER:
                return None
            self.struck += 1
            if fault.reach in KILLS:
                return fault.reach
            if fault.reach is OsReach.SPELL:
                self._spell = time.monotonic() + SPELL_SECONDS
            return fault.errno

    # The functions of Python's library

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Replace the functions of Python's library within the block."""
        with contextlib.ExitStack() as stack:

            def put(owner: Any, name: str, made: Any) -> None:
                stack.enter_context(mock.patch.object(owner, name, made))

            for operation, names in (
                ("unlink", ("unlink", "remove")),
                ("mkdir", ("mkdir",)),
                ("list", ("listdir", "scandir")),
                ("stat", ("stat",)),
            ):
                for name in names:
                    put(os, name, partial(self._by_path, operation, getattr(os, name)))
            for name in ("rename", "replace"):
                put(os, name, partial(self._rename, getattr(os, name)))
            put(os, "link", partial(self._link, os.link))
            put(os, "open", partial(self._os_open, os.open))
            put(os, "fsync", partial(self._by_handle, "fsync", os.fsync))
            put(fcntl, "flock", partial(self._by_handle, "lock", fcntl.flock))
            opened = partial(self._open, io.open)
            put(io, "open", opened)
            put(builtins, "open", opened)
            put(subprocess, "_fork_exec", partial(self._always, "spawn", subprocess._fork_exec))  # type: ignore[attr-defined]
            put(socket, "create_connection", partial(self._always, "connect", socket.create_connection))
            put(os, "kill", partial(self._living, os.kill))
            put(os, "killpg", partial(self._living, os.killpg))
            start, injector = threading.Thread.start, self

            def started(thread: threading.Thread) -> None:
                thread.generation = getattr(threading.current_thread(), "generation", 0)  # type: ignore[attr-defined]
                try:
                    injector._call("thread", thread.name.split(" ")[0].split("-")[0], partial(start, thread))
                except OSError as error:
                    raise RuntimeError("can't start new thread") from error

            put(threading.Thread, "start", started)
            report = threading.excepthook
            put(threading, "excepthook", lambda args: None if args.exc_type is Killed else report(args))
            threading.current_thread().generation = self._generation  # type: ignore[attr-defined]
            yield

    def _by_path(self, operation: str, do: Any, path: Any = ".", *args: Any, **options: Any) -> Any:
        return self._call(operation, self.place(path), lambda: do(path, *args, **options))

    def _rename(self, do: Any, source: Any, target: Any, **options: Any) -> None:
        self._call("rename", self.place(target), lambda: do(source, target, **options))

    def _link(self, do: Any, source: Any, target: Any, **options: Any) -> Any:
        here, there = self.place(source), self.place(target)
        between = bool(here and there and here.startswith("data/") != there.startswith("data/"))
        if between and self.fault and self.fault.reach is OsReach.EVER and not self.off.deep:
            self.struck += 1
            raise OSError(errno.EXDEV, os.strerror(errno.EXDEV))
        return self._call("link", there, lambda: do(source, target, **options))

    def _by_handle(self, operation: str, do: Any, handle: Any, *args: Any) -> Any:
        number = handle if isinstance(handle, int) else handle.fileno()
        try:
            path = os.readlink(f"/proc/self/fd/{number}")
        except OSError:
            path = ""
        return self._call(operation, self.place(path), lambda: do(handle, *args))

    def _os_open(self, do: Any, path: Any, flags: int, *args: Any, **options: Any) -> Any:
        operation = "create" if flags & os.O_CREAT else "open"
        return self._call(operation, self.place(path), lambda: do(path, flags, *args, **options))

    def _open(self, do: Any, path: Any, mode: str = "r", buffering: int = -1, *args: Any, **options: Any) -> Any:
        place = None if isinstance(path, int) else self.place(path)
        if place is None or self.off.deep:
            return do(path, mode, buffering, *args, **options)
        writes = bool(set(mode) & set("wxa+"))
        if place == "proc" or "b" not in mode or buffering == 0:
            return self._call(
                "create" if writes else "open", place, lambda: do(path, mode, buffering, *args, **options)
            )
        raw = self._call("create" if writes else "open", place, lambda: io.FileIO(path, mode.replace("b", "")))
        made: Any = _Writer(raw) if writes else _Reader(raw)
        made.call = partial(self._call, "write" if writes else "read", place)
        return made

    def _always(self, operation: str, do: Any, *args: Any, **options: Any) -> Any:
        return self._call(operation, operation, lambda: do(*args, **options))

    def _living(self, do: Any, *args: Any) -> Any:
        if not self.off.deep:
            self._alive()
        return do(*args)


class _Writer(io.BufferedWriter):
    call: Callable[[Callable[[], Any]], Any]

    def write(self, data: Any, /) -> int:
        def all_of_it() -> int:
            return super(_Writer, self).write(data)

        try:
            return int(self.call(all_of_it))
        except (OSError, Killed):
            super().write(bytes(data)[: len(data) // 2])  # a part was written before the fault
            super().flush()
            raise


class _Reader(io.BufferedReader):
    call: Callable[[Callable[[], Any]], Any]

    def read(self, size: int | None = -1, /) -> bytes:
        return bytes(self.call(lambda: super(_Reader, self).read(size)))
