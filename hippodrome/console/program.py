"""How a person types the command `hippodrome` here: advice that is printed must be what they can copy."""

from __future__ import annotations

import re
import shlex
import shutil
import sys
from pathlib import Path

COMMANDS = (
    *("new", "check", "run", "try", "gym", "data", "erase", "links", "deploy", "register"),
    *("secret", "certificate", "doctor", "status", "cost", "logs", "stop", "destroy"),
)
"""The names of all commands (hippodrome/cli.py)."""
_SHOWN = re.compile(rf"(?<![\w/.-])hippodrome (?=(?:{'|'.join(COMMANDS)})\b)")


def as_typed(text: str) -> str:
    """Return the text with commands as they can be typed here: `.venv/bin/hippodrome run`, if not on PATH."""
    return _SHOWN.sub(f"{_program()} ".replace("\\", r"\\"), text) if "hippodrome " in text else text


def _program() -> str:
    """`hippodrome`, or where it lies if it is beside this Python and not on PATH."""
    ours = Path(sys.executable).with_name("hippodrome")
    if shutil.which("hippodrome") is not None or not ours.exists():
        return "hippodrome"
    try:
        return shlex.quote(str(ours.relative_to(Path.cwd())))
    except ValueError:
        return shlex.quote(str(ours))
