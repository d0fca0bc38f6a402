"""Measures the peak memory of a command in the command's own process.

`ru_maxrss` of a child is at least the memory that its parent held at the fork. `VmHWM` in /proc/self/status begins anew
with exec (proc_pid_status(5)), so the command's process reads `VmHWM` at its end.

`python -m bench.memory FILE MODULE ARGUMENTS` runs `python -m MODULE ARGUMENTS` and writes its peak memory in MB to
FILE.
"""

from __future__ import annotations

import runpy
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO


def run(
    module: str, arguments: Sequence[str], *, env: Mapping[str, str], cwd: Path, out: IO[bytes], err: IO[bytes]
) -> tuple[int, float]:
    """Run a module in a process of its own; return its exit status and its peak memory in MB.

    Raises FileNotFoundError if the process could not tell its memory, since something killed it.
    """
    file = cwd / "memory.txt"
    line = [sys.executable, "-m", "bench.memory", str(file), module, *arguments]
    done = subprocess.run(line, env=env, cwd=cwd, stdin=subprocess.DEVNULL, stdout=out, stderr=err, check=False)
    return done.returncode, float(file.read_text())


def peak() -> float:
    """Return the peak memory of this process so far, in MB."""
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmHWM:"))


def main(file: str, module: str, *arguments: str) -> None:
    """Run the module, and write its peak memory to the file, however it ends."""
    sys.argv = [module, *arguments]
    try:
        runpy.run_module(module, run_name="__main__", alter_sys=True)
    finally:
        Path(file).write_text(f"{peak()}", encoding="ascii")


if __name__ == "__main__":
    main(*sys.argv[1:])
