"""The process that starts a worker for each connection, watches the workers, and kills processes that they leave.

It imports the modules for environments once. A worker is a fork of it, so it has them after milliseconds, in shared
memory. The spawner holds no connection and runs no environment. The server sends it sockets (`handover.py`).
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
from trial.gym.forms import ARRAYS, BY_NAME
from trial.gym.handover import Ended, NewConnection
from trial.gym.limits import Limits
from trial.gym.wakeup import Wakeup
from trial.gym.worker import WorkerState
from trial.gym.worker import main as work

TICK_SECONDS = 0.25
"""The time between two looks at how long the workers have been busy or idle."""
_GRACE_SECONDS = 2.0  # between the interruption of Python code and the end of the process
_ROUNDS = 1000  # the most attempts of `_reap` to collect the processes that it has killed
_USAGE_SECONDS = 1.0  # between two looks at memory and processes

_AWAY, _FAILED, _TRY_LATER = 1001, 1011, 1013  # close codes (RFC 6455, 7.4.1, and IANA's registry)


@dataclass(slots=True)
class _Watched:
    """A worker: the number of its connection, its slot in the shared memory, and what the spawner has done to it."""

    number: int
    slot: int
    state: WorkerState
    interrupted: bool = False
    verdict: tuple[int, str] | None = None
    """The close code and the sentence for its client if the spawner has killed it, else None."""


class Spawner:
    """Starts and watches workers until the server's end of `control` is closed."""

    def __init__(self, control: socket.socket, limits: Limits, *, output: bool, record: Path | None) -> None:
        self._control = control
        self._limits = limits
        self._output = output
        self._record = record
        self._memory = memoryview(mmap.mmap(-1, 8 * limits.workers)).cast("d")
        self._free = set(range(limits.workers))  # the free slots
        self._workers: dict[int, _Watched] = {}  # the living workers, by process id
        self._unsent = bytearray()  # messages for which the socket to the server has no room yet
        self._usage_checked = 0.0
        self._own_megabytes = 0.0

    def run(self) -> None:
        """Start and watch workers until the server has ended. Then kill all workers, and return."""
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the server, which ends this process
        signal.signal(signal.SIGCHLD, lambda *_: None)
        wakeup = Wakeup()
        linux.become_subreaper()
        gc.collect()
        gc.freeze()  # so that the collector does not write to pages that workers share
        self._own_megabytes = linux.used_megabytes(os.getpid())
        try:
            while self._once(wakeup):
                pass
        finally:
            for pid in list(self._workers):
                _kill(pid)
            self._reap()

    def _once(self, wakeup: Wakeup) -> bool:
        """Wait for the next event and handle it. Return False if the server has ended."""
        to_write = [self._control] if self._unsent else []
        wait = TICK_SECONDS if self._workers else None
        to_read: list[socket.socket | Wakeup] = [self._control, wakeup]
        readable, writable, _ = select.select(to_read, to_write, [], wait)
        if writable:
            self._send_unsent()
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
            self._reap()  # a worker may have ended meanwhile
        if not self._free:
            start.connection.close()
            self._tell(
                start.number, _TRY_LATER, f"{self._limits.workers} connections use environments already; try later."
            )
            return
        slot = min(self._free)
        state = WorkerState(self._memory, slot)
        try:
            pid = os.fork()
        except OSError as error:
            start.connection.close()
            self._tell(start.number, _TRY_LATER, f"No process can be started ({error.strerror}); try later.")
            return
        if pid == 0:
            self._become_worker(start, state, wakeup)
        start.connection.close()
        self._free.discard(slot)
        self._workers[pid] = _Watched(start.number, slot, state)

    def _become_worker(self, start: NewConnection, state: WorkerState, wakeup: Wakeup) -> None:
        """Serve the connection, in the new process. This call does not return."""
        status = 1
        try:
            wakeup.close()
            signal.set_wakeup_fd(-1)
            signal.signal(signal.SIGCHLD, signal.SIG_DFL)
            self._control.close()
            form = BY_NAME.get(start.form, ARRAYS)
            work(start.connection, start.received, form, self._limits, state, output=self._output, record=self._record)
            status = 0
        finally:
            os._exit(status)

    def _reap(self) -> None:
        """Collect processes that have ended, and kill the processes that these have left."""
        for _ in range(_ROUNDS):
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if pid:
                self._ended(pid, status)
                continue
            # A process whose worker has ended is a child of this process.
            strays = [child for child in linux.children(os.getpid()) if child not in self._workers]
            if not strays:
                return
            for stray in strays:
                _kill(stray)
            time.sleep(0.001)

    def _ended(self, pid: int, status: int) -> None:
        ended = self._workers.pop(pid, None)
        if ended is None:
            return
        with contextlib.suppress(OSError):  # kills its group; on Linux its other children become this process's
            os.killpg(pid, signal.SIGKILL)
        self._free.add(ended.slot)
        code, sentence = ended.verdict or (0, "")
        if ended.verdict is None and status != 0:
            code, sentence = _FAILED, f"The environment ended its process ({_how(status)})."
        self._tell(ended.number, code, sentence)

    def _watch(self, now: float) -> None:
        """Interrupt or kill workers that are beyond a limit."""
        check_usage = now - self._usage_checked >= _USAGE_SECONDS
        if check_usage:
            self._usage_checked = now
        limits = self._limits
        for pid, worker in self._workers.items():
            if worker.verdict is not None:
                continue
            busy = worker.state.busy(now)
            if busy > limits.seconds + _GRACE_SECONDS:
                sentence = f"The environment took longer than {limits.seconds:g} s; its process was ended."
                _kill_worker(pid, worker, _FAILED, sentence)
            elif busy > limits.seconds:
                if not worker.interrupted:
                    worker.interrupted = True
                    with contextlib.suppress(OSError):
                        os.kill(pid, signal.SIGALRM)
            else:
                worker.interrupted = False
                most = limits.silent_seconds if worker.state.silent else limits.idle_seconds
                if most and worker.state.idle(now) > most:
                    sentence = f"There was no request for {most:g} s."
                    _kill_worker(pid, worker, _AWAY, sentence)
                elif check_usage:
                    self._check_usage(pid, worker)

    def _check_usage(self, pid: int, worker: _Watched) -> None:
        """Kill a worker whose environments have too many processes, or use too much memory."""
        limits = self._limits
        started = [one for one in linux.descendants(pid) if linux.runs(one)]
        if len(started) > limits.processes:
            sentence = f"The environments started more than {limits.processes} processes; all were ended."
            _kill_worker(pid, worker, _FAILED, sentence)
            return
        # What a fork has of this process is not theirs; a program that they started has nothing of it.
        used = sum(max(0.0, linux.used_megabytes(one) - self._own_megabytes) for one in (pid, *started))
        if used > limits.megabytes:
            sentence = f"The environments used more than {limits.megabytes} MB; their process was ended."
            _kill_worker(pid, worker, _FAILED, sentence)

    def _tell(self, number: int, code: int, sentence: str) -> None:
        """Tell the server, without waiting for it: it may be waiting until this process takes a connection."""
        self._unsent += Ended(number, code, sentence).packed()
        self._send_unsent()

    def _send_unsent(self) -> None:
        try:
            del self._unsent[: self._control.send(self._unsent, socket.MSG_DONTWAIT)]
        except BlockingIOError:
            pass
        except OSError:  # the server has ended; `handover.receive` notices it
            self._unsent.clear()


def _kill_worker(pid: int, worker: _Watched, code: int, sentence: str) -> None:
    worker.verdict = (code, sentence)
    _kill(pid)


def _kill(pid: int) -> None:
    """Kill a process, and its group if it has one of its own."""
    for kill in (os.killpg, os.kill):
        with contextlib.suppress(OSError):
            kill(pid, signal.SIGKILL)


def _how(status: int) -> str:
    """Describe how a process has ended, by its wait status."""
    if os.WIFSIGNALED(status):
        return f"signal {signal.Signals(os.WTERMSIG(status)).name}"
    return f"exit status {os.WEXITSTATUS(status)}"


def main(control: socket.socket, limits: Limits, modules: Sequence[str], *, output: bool, record: Path | None) -> int:
    """Import `modules`, which register environments, and start workers until the server ends. Return the status."""
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
