"""The process that starts a worker for each connection, watches all workers, and leaves nothing of them behind.

It imports what environments need once, so that a worker begins with it: a fork costs milliseconds and shares memory.
It holds no connection and runs no environment. The server hands it sockets over a Unix socket (`handover.py`).
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import mmap
import os
import select
import signal
import socket
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from trial.gym import handover, linux
from trial.gym.forms import ARRAYS, NAMES
from trial.gym.handover import Ended, NewConnection
from trial.gym.limits import Limits
from trial.gym.wakeup import Wakeup
from trial.gym.worker import WorkerState
from trial.gym.worker import main as work

TICK_SECONDS = 0.25
_GRACE_SECONDS = 2.0  # between the interruption of Python code and the end of the process
_ROUNDS = 1000  # of waiting for killed processes, at a time
_LOOK_SECONDS = 1.0  # between two looks at memory and processes

_AWAY, _FAILED = 1001, 1011  # close codes


@dataclass(slots=True)
class _Watched:
    number: int
    slot: int
    state: WorkerState
    interrupted: bool = False
    verdict: tuple[int, str] | None = None


class Spawner:
    """Starts and watches workers until the server's end of `control` is closed."""

    def __init__(self, control: socket.socket, limits: Limits, *, output: bool, record: Path | None) -> None:
        self._control = control
        self._limits = limits
        self._output = output
        self._record = record
        self._memory = memoryview(mmap.mmap(-1, 8 * limits.workers)).cast("d")
        self._free = set(range(limits.workers))
        self._workers: dict[int, _Watched] = {}  # by process id
        self._untold = bytearray()  # what the server has not read yet
        self._looked = 0.0
        self._own_megabytes = 0.0

    def run(self) -> None:
        """Serve; returns when the server is gone, with all workers killed."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the server, which ends this process
        signal.signal(signal.SIGCHLD, lambda *_: None)
        wakeup = Wakeup()
        linux.become_subreaper()
        gc.collect()
        gc.freeze()  # so that the collector does not write to pages that workers share
        self._own_megabytes = linux.private_megabytes(os.getpid())
        try:
            while self._once(wakeup):
                pass
        finally:
            for pid in list(self._workers):
                _kill(pid)
            self._reap()

    def _once(self, wakeup: Wakeup) -> bool:
        to_tell = [self._control] if self._untold else []
        wait = TICK_SECONDS if self._workers else None
        awaited: list[socket.socket | Wakeup] = [self._control, wakeup]
        readable, writable, _ = select.select(awaited, to_tell, [], wait)
        if writable:
            self._send_untold()
        if wakeup in readable:
            wakeup.clear()
        if self._control in readable:
            start = handover.receive(self._control)
            if start is None:
                return False
            self._start(start, wakeup)
        self._reap()
        self._watch(time.monotonic())
        return True

    def _start(self, start: NewConnection, wakeup: Wakeup) -> None:
        if not self._free:
            self._reap()  # one may have ended since
        if not self._free:
            start.connection.close()
            self._tell(start.number, 1013, f"{self._limits.workers} connections use environments already; try later.")
            return
        slot = min(self._free)
        state = WorkerState(self._memory, slot)
        try:
            pid = os.fork()
        except OSError as error:
            start.connection.close()
            self._tell(start.number, 1013, f"No process can be started ({error.strerror}); try later.")
            return
        if pid == 0:
            self._become_worker(start, state, wakeup)
        start.connection.close()
        self._free.discard(slot)
        self._workers[pid] = _Watched(start.number, slot, state)

    def _become_worker(self, start: NewConnection, state: WorkerState, wakeup: Wakeup) -> None:
        """In the new process. Does not return."""
        status = 1
        try:
            wakeup.close()
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            self._control.close()
            form = NAMES.get(start.form, ARRAYS)
            work(start.connection, start.received, form, self._limits, state, output=self._output, record=self._record)
            status = 0
        finally:
            os._exit(status)

    def _reap(self) -> None:
        """Take note of the processes that have ended, and end what they have left."""
        for _ in range(_ROUNDS):
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid:
                self._ended(pid, status)
                continue
            strays = self._strays()
            if not strays:
                return
            for stray in strays:
                _kill(stray)
            time.sleep(0.001)

    def _ended(self, pid: int, status: int) -> None:
        ended = self._workers.pop(pid, None)
        if ended is None:
            return
        with contextlib.suppress(OSError):  # children in its group; on Linux the others become ours
            os.killpg(pid, signal.SIGKILL)
        self._free.add(ended.slot)
        code, words = ended.verdict or (0, "")
        if ended.verdict is None and status != 0:
            code, words = _FAILED, f"The environment ended its process ({_how(status)})."
        self._tell(ended.number, code, words)

    def _strays(self) -> list[int]:
        """Processes that have lost their worker."""
        children = linux.children(os.getpid())
        return [pid for pid in children if pid not in self._workers]

    def _watch(self, now: float) -> None:
        look = now - self._looked >= _LOOK_SECONDS
        if look:
            self._looked = now
        limits = self._limits
        for pid, worker in self._workers.items():
            if worker.verdict is not None:
                continue
            busy = worker.state.busy(now)
            if busy > limits.seconds + _GRACE_SECONDS:
                self._condemn(
                    pid,
                    worker,
                    _FAILED,
                    f"The environment took longer than {limits.seconds:g} s; its process was ended.",
                )
            elif busy > limits.seconds:
                if not worker.interrupted:
                    worker.interrupted = True
                    with contextlib.suppress(OSError):
                        os.kill(pid, signal.SIGALRM)
            else:
                worker.interrupted = False
                if limits.idle_seconds and worker.state.idle(now) > limits.idle_seconds:
                    self._condemn(pid, worker, _AWAY, f"There was no request for {limits.idle_seconds:g} s.")
                elif look:
                    self._look(pid, worker)

    def _look(self, pid: int, worker: _Watched) -> None:
        limits = self._limits
        started = [one for one in linux.descendants(pid) if linux.runs(one)]
        if len(started) > limits.processes:
            self._condemn(
                pid,
                worker,
                _FAILED,
                f"The environments started more than {limits.processes} processes; all were ended.",
            )
            return
        used = sum(linux.private_megabytes(one) - self._own_megabytes for one in (pid, *started))
        if used > limits.megabytes:
            self._condemn(
                pid, worker, _FAILED, f"The environments used more than {limits.megabytes} MB; their process was ended."
            )

    def _condemn(self, pid: int, worker: _Watched, code: int, words: str) -> None:
        worker.verdict = (code, words)
        _kill(pid)

    def _tell(self, number: int, code: int, words: str) -> None:
        """Tell the server without waiting for it: it may be waiting for this process to take its next connection."""
        self._untold += Ended(number, code, words).packed()
        self._send_untold()

    def _send_untold(self) -> None:
        try:
            del self._untold[: self._control.send(self._untold, socket.MSG_DONTWAIT)]
        except BlockingIOError:
            pass
        except OSError:  # the server is gone, as its end of the socket says
            self._untold.clear()


def _kill(pid: int) -> None:
    """Kill a process, and its group if it has one of its own."""
    for kill in (os.killpg, os.kill):
        with contextlib.suppress(OSError):
            kill(pid, signal.SIGKILL)


def _how(status: int) -> str:
    if os.WIFSIGNALED(status):
        return f"signal {signal.Signals(os.WTERMSIG(status)).name}"
    return f"exit status {os.WEXITSTATUS(status)}"


def main(control: socket.socket, limits: Limits, modules: Sequence[str], *, output: bool, record: Path | None) -> int:
    """Be the spawner; the exit status. `modules` are imported first: they register environments."""
    sys.path.insert(0, os.getcwd())
    try:
        for module in modules:
            importlib.import_module(module)
    except Exception as error:  # noqa: BLE001 - a researcher's module may raise anything
        print(f"{module} cannot be imported: {type(error).__name__}: {error}", file=sys.stderr)
        return 1
    control.sendall(Ended(0, 0, "ready").packed())
    Spawner(control, limits, output=output, record=record).run()
    return 0
