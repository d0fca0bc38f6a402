"""Starts `python -m MODULE` as a process, as the tests want it: in UTF-8 text, without input, and open to SIGINT."""

from __future__ import annotations

import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Any

ROOT = Path(__file__).resolve().parents[1]


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
    stderr: IO[Any] | int | None = None,
    start_new_session: bool = False,
) -> subprocess.Popen[str]:
    """Run `python -m MODULE ARGUMENTS`. The other arguments are Popen's."""
    return subprocess.Popen(
        [sys.executable, "-m", module, *arguments],
        cwd=cwd,
        env=env,
        stdin=subprocess.DEVNULL,
        stdout=stdout,
        stderr=stderr,
        text=True,
        start_new_session=start_new_session,
        preexec_fn=interruptible,  # noqa: PLW1509 - it sets a signal and no more
    )
