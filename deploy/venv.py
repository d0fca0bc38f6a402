"""If this Python lacks the packages, run the same command with `.venv`'s Python. Standard library only."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import NoReturn

ROOT = Path(__file__).resolve().parents[1]


def go_on(root: Path = ROOT) -> NoReturn:
    """Run the same command with the Python in `.venv`. If there is none, print what to do and exit with 1."""
    made = root / ".venv"
    if (made / "deploy").exists() and Path(sys.prefix).resolve() != made.resolve():
        python = str(made / "bin" / "python")
        os.execv(python, [python, "-m", "deploy", *sys.argv[1:]])  # noqa: S606 - no shell is wanted
    sys.stderr.write(
        "✗ The packages that this command needs are not installed.\n"
        "→ Run a command with make first, such as `make data` or `make doctor`: it installs them into .venv/.\n"
    )
    sys.exit(1)
