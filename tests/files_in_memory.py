"""Keeps the temporary files of a whole run of the tests in memory.

The tests write thousands of small files and have many of them synced, as the product promises. On a disk that takes a tenth
of their time. So a run with several workers has its temporary files in Linux's /dev/shm, and deletes them at its end.
A run without workers has them in the system's usual folder, and keeps them: run one test so to look at its files.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

MEMORY = Path("/dev/shm")
ROOM = 4 << 30  # bytes; a run has at most half a gigabyte at a time
_PREFIX = "hippodrome-tests-"


def use(memory: Path = MEMORY) -> Path | None:
    """Let this process, and those that it starts, make their temporary files in a new folder there, and return the folder.

    Returns None, and changes nothing, if there is not enough room, or if programs cannot run there.
    """
    if not memory.is_dir() or min(_free(memory), _available()) < ROOM:
        return None
    _remove_abandoned(memory)
    folder = Path(tempfile.mkdtemp(prefix=f"{_PREFIX}{os.getpid()}-", dir=memory))
    if not _runs_programs(folder):
        shutil.rmtree(folder)
        return None
    os.environ["TMPDIR"] = str(folder)
    tempfile.tempdir = None  # it is read again
    return folder


def _free(folder: Path) -> int:
    size = os.statvfs(folder)
    return size.f_bavail * size.f_frsize


def _available() -> int:
    """Return how many bytes of memory processes can still get. /dev/shm does not know: its size is no more than a limit."""
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) << 10 for line in lines if line.startswith("MemAvailable:")), 0)


def _runs_programs(folder: Path) -> bool:
    """Return whether programs there can run: containers often forbid it in /dev/shm."""
    program = folder / "program"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o700)
    try:
        return subprocess.run([program], check=False).returncode == 0
    except OSError:
        return False
    finally:
        program.unlink()


def _remove_abandoned(memory: Path) -> None:
    """Remove the folders of runs that were killed."""
    for folder in memory.glob(f"{_PREFIX}*-*"):
        process = folder.name.removeprefix(_PREFIX).split("-")[0]
        if process.isdigit() and not Path("/proc", process).exists():
            shutil.rmtree(folder, ignore_errors=True)
