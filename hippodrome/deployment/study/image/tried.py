"""Tries the agent on this machine with the packages of its image, before the image is pushed.

So `register` reports what is missing, and not each participant's server. Packages for the servers run only on Linux on
x86-64, with the servers' Python; elsewhere `register` says that the agent was not tried. System libraries are this
machine's, and not the base's.
"""

# ruff: noqa: S603 - programs that were found here, with arguments as a list

from __future__ import annotations

import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from hippodrome.console import screen
from hippodrome.deployment.code import bytecode
from hippodrome.deployment.study.image.bundle import Bundle
from hippodrome.deployment.study.image.follow import BuildLog
from hippodrome.deployment.study.image.packages import PYTHON
from hippodrome.protocol import environment

SECONDS = 60
_NOT_TRIED = "The agent was not tried with the image's packages: that needs Python {python} on Linux on x86-64."


def agent(bundle: Bundle, site_packages: Sequence[Path]) -> None:
    """Try the agent: it is loaded, begins an episode and takes a step. Raises `Problem` if the image lacks something.

    It runs in a virtual environment that has only these folders of packages, in a copy of the study.
    """
    python = bytecode.compiler(PYTHON)
    if python is None or sys.platform != "linux" or platform.machine() not in {"x86_64", "AMD64"}:
        screen.warning(_NOT_TRIED.format(python=PYTHON))
        return
    with tempfile.TemporaryDirectory(prefix="hippodrome-", ignore_cleanup_errors=True) as temporary:
        folder = Path(temporary)
        for name in ("context", "scratch"):
            (folder / name).mkdir()
        bundle.write_folder(folder / "context")
        venv = folder / "venv"
        ran = subprocess.run(
            [python, "-I", "-m", "venv", "--without-pip", "--symlinks", venv], capture_output=True, check=False
        )
        if ran.returncode:  # such as Debian's Python without its package for that
            screen.warning(_NOT_TRIED.format(python=f"{PYTHON} with its module venv"))
            return
        lines = [f"import site; site.addsitedir({str(place)!r})\n" for place in site_packages]
        (venv / f"lib/python{PYTHON}/site-packages/image.pth").write_text("".join(lines))
        log = BuildLog()
        done = subprocess.run(
            [venv / "bin/python", "-m", "hippodrome.trial.check", "check.json", str(SECONDS)],
            cwd=folder / "context",
            env={
                "PATH": os.defpath,
                "PYTHONPATH": str(folder / "context"),
                "PYTHONDONTWRITEBYTECODE": "1",
                "PYTHONSAFEPATH": "1",
                environment.AGENT_DIR: str(folder / "context/project"),
                "HOME": str(folder / "scratch"),
                "TMPDIR": str(folder / "scratch"),
            },
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            errors="replace",
            check=False,
        )
        log.add(done.stdout)
        if done.returncode:
            raise log.failure("The image would lack something.")
