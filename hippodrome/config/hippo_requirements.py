"""The requirements.txt of a HIPPO Gym project, as the image of its servers can install it. Pure.

HIPPO's images have Python 3.7, and its requirements.txt pins what its own programs need: versions that do not exist for
the Python of Hippodrome's image, of packages that the image has (requirements/trial.txt) or has no use for.
"""

from __future__ import annotations

import re
from collections.abc import Iterable

from hippodrome.config.diagnostics import Diagnostic

_NAME = re.compile(r"\s*(?P<name>[A-Za-z0-9][A-Za-z0-9._-]*)\s*(\[[^\]]*\])?\s*(?P<version>[<>=!~;@].*|)(#.*)?")
_REPLACED = {
    "gym": "Gymnasium stands in for it",
    "atari-py": "ale-py stands in for it",
    "asyncio": "it is a part of Python",
    "sklearn": "its name is scikit-learn",
}
"""Packages that the image does without."""


def adapt(text: str, label: str, present: Iterable[str]) -> tuple[str, list[Diagnostic]]:
    """The file without the lines that no image needs, and what to say of them.

    `present` are the names of the packages in requirements/trial.txt: the image has them, in a version of its own. Line
    numbers stay, since a line that is left out becomes an empty one.
    """
    here = {canonical(name) for name in present}
    kept, replaced, known = [], [], []
    for line in text.splitlines():
        found = _NAME.fullmatch(line)
        name = canonical(found["name"]) if found else ""
        kept.append("" if name in _REPLACED or name in here else line)
        if name in _REPLACED:
            replaced.append(f"{name} ({_REPLACED[name]})")
        elif name in here:
            known.append(name)
    said = [
        ("left out", replaced),
        ("left out, since the servers' image has them in versions of its own", known),
    ]
    remarks = [
        Diagnostic(label, None, "", f"{what}: {', '.join(dict.fromkeys(names))}", remark=True)
        for what, names in said
        if names
    ]
    return "".join(f"{line}\n" for line in kept), remarks


def canonical(name: str) -> str:
    """The normalized name of a package (PEP 503), by which names are compared."""
    return re.sub(r"[-_.]+", "-", name).lower()
