"""Runs a real trial server as a process of this machine, for the groups that measure it."""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from bench.pictures import ROOT


@contextlib.contextmanager
def trial_server(
    agent_dir: Path,
    store: str,
    trial: Mapping[str, Any],
    *,
    inherited: Mapping[str, str] = os.environ,
    **variables: str,
) -> Iterator[tuple[int, subprocess.Popen[bytes]]]:
    """Run a trial server within the block; give its port and its process.

    `trial` is the section of config.yml, `store` the folder or address of its recordings. `variables` are added to its
    environment: `USER_ID` or `SESSION`, and new values for variables that are set here.
    """
    env = {
        **inherited,
        "PROJECT_ID": "bench",
        "SERVER": "bench",
        "TOKEN": "bench",
        "GAME_STEPS": "1",
        "STORE": store,
        "TRIAL": json.dumps(trial),
        "HOST": "127.0.0.1",
        "PORT": "0",
        "TLS": "off",
        "AGENT_DIR": str(agent_dir),
        "PYTHONPATH": str(ROOT),
        **variables,
    }
    with tempfile.TemporaryDirectory() as folder:
        process = subprocess.Popen(
            [sys.executable, "-m", "trial"], cwd=folder, env=env, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
        )
        try:
            assert process.stdout is not None
            yield json.loads(process.stdout.readline())["port"], process
        finally:
            process.terminate()
            process.wait(30)
