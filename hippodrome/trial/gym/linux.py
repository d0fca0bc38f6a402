"""Calls of Linux by which a process and its descendants are watched, limited and ended. Elsewhere they do nothing."""

from __future__ import annotations

import contextlib
import ctypes
import os
import resource
import signal
import sys
from pathlib import Path

_LINUX = sys.platform == "linux"
_SET_PDEATHSIG, _SET_CHILD_SUBREAPER = 1, 36  # prctl(2), linux/prctl.h


def become_subreaper() -> None:
    """Let descendants of this process that lose their parent become its children (PR_SET_CHILD_SUBREAPER, prctl(2))."""
    _prctl(_SET_CHILD_SUBREAPER, 1)


def die_with(parent: int) -> None:
    """Let the system kill this process when its parent ends (PR_SET_PDEATHSIG, prctl(2))."""
    _prctl(_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(0)  # it has ended already


def limit_memory(megabytes: int) -> None:
    """Limit the private memory of this process, and of each of its children, to its present size plus `megabytes`.

    RLIMIT_DATA does so: since Linux 4.7 it counts private writable mappings (setrlimit(2)). It does not count memory
    that processes share.
    """
    if _LINUX:
        most = _kilobytes("/proc/self/status", "VmData:") * 2**10 + megabytes * 2**20
        _, hard = resource.getrlimit(resource.RLIMIT_DATA)
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(resource.RLIMIT_DATA, (most, most))


def children(pid: int) -> list[int]:
    """Return the children of a process (/proc/PID/task/TID/children, proc(5)); empty if the system has no such file."""
    pids: list[int] = []
    with contextlib.suppress(OSError):
        for thread in os.listdir(f"/proc/{pid}/task"):
            text = Path(f"/proc/{pid}/task/{thread}/children").read_text(encoding="ascii")
            pids += map(int, text.split())
    return pids


def descendants(pid: int) -> list[int]:
    """Return the children of a process, their children, and so on, without those that have ended."""
    pids: list[int] = []
    waiting = [pid]
    while waiting:
        below = [child for child in children(waiting.pop()) if runs(child)]
        pids += below
        waiting += below
    return pids


def runs(pid: int) -> bool:
    """Whether a process exists and is no zombie (by the state in /proc/PID/stat)."""
    with contextlib.suppress(OSError, IndexError):
        return Path(f"/proc/{pid}/stat").read_text(encoding="utf-8").rpartition(")")[2].split()[0] != "Z"
    return False


def used_megabytes(pid: int) -> float:
    """Return the memory of a process without pages of files; 0 if it has ended.

    Of memory that several processes share, each has its part (Pss in /proc/PID/smaps_rollup, proc(5)).
    """
    try:
        return _kilobytes(f"/proc/{pid}/smaps_rollup", "Pss_Anon:", "Pss_Shmem:") / 2**10
    except OSError:
        return 0.0


def _kilobytes(file: str, *fields: str) -> int:
    lines = Path(file).read_text(encoding="utf-8", errors="replace").splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(fields))


def _prctl(option: int, value: int) -> None:
    if _LINUX:
        with contextlib.suppress(OSError, AttributeError):
            ctypes.CDLL(None, use_errno=True).prctl(option, value, 0, 0, 0)
