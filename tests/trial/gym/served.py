"""A real server of environments in a process of its own."""

from __future__ import annotations

import contextlib
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).parents[3]


@contextlib.contextmanager
def serving(*arguments: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Run `python -m trial.gym` with the environments of `remote_environments.py`; yield its address and its process."""
    command = [sys.executable, "-W", "ignore", "-m", "trial.gym", "--port", "0"]
    imported = ["--import", "tests.trial.gym.remote_environments", *arguments]
    with subprocess.Popen(
        [*command, *imported], cwd=ROOT, env=os.environ | {"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            found = re.search(r"ws://\S+:\d+", process.stdout.readline())
            assert found is not None, "the server has not started"
            yield found[0] + "/", process
        finally:
            process.terminate()
