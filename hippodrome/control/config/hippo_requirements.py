"""Removes from a HIPPO Gym project's requirements.txt the lines that Hippodrome's image cannot install. Pure.

HIPPO's images have Python 3.7, and its requirements.txt pins the packages of HIPPO's own programs, in versions that do
not exist for the Python of Hippodrome's image. This image has the packages (requirements/trial.txt) or does not need
them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from packaging.utils import canonicalize_name

from hippodrome.control.config.diagnostics import Diagnostic

_NAME = re.compile(r"\s*(?P<name>[A-Za-z0-9][A-Za-z0-9._-]*)\s*(\[[^\]]*\])?\s*(?P<version>[<>=!~;@].*|)(#.*)?")
_REPLACED = {
    "gym": "Gymnasium stands in for it",
    "atari-py": "ale-py stands in for it",
    "asyncio": "it is a part of Python",
    "sklearn": "its name is scikit-learn",
}
"""Packages that the image does not need, and why."""


def adapt(text: str, label: str, present: Iterable[str]) -> tuple[str, list[Diagnostic]]:
    """Return the text without the lines that the image does not need, and remarks on these lines.

    `present` are the names of the packages in requirements/trial.txt, which the image has in its own versions. `label`
    is the file's name in the remarks. An empty line takes the place of each removed one, so line numbers stay.
    """
    in_image = {canonicalize_name(name) for name in present}
    lines, replaced, already_there = [], [], []
    for line in text.splitlines():
        match = _NAME.fullmatch(line)
        name = canonicalize_name(match["name"]) if match else ""
        lines.append("" if name in _REPLACED or name in in_image else line)
        if name in _REPLACED:
            replaced.append(f"{name} ({_REPLACED[name]})")
        elif name in in_image:
            already_there.append(name)
    removed = [
        ("left out", replaced),
        ("left out, since the servers' image has them in versions of its own", already_there),
    ]
    remarks = [
        Diagnostic(label, None, "", f"{message}: {', '.join(dict.fromkeys(names))}", remark=True)
        for message, names in removed
        if names
    ]
    return "".join(f"{line}\n" for line in lines), remarks
