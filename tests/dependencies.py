"""`python -m tests.dependencies`: write requirements/constraints.txt, from the versions that are installed.

The other files of `requirements/` pin what Hippodrome names itself. Those packages bring others along. Without a pin, each
of these would be installed in the version that is the newest on the day of the installation.
"""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

REQUIREMENTS = Path(__file__).resolve().parents[1] / "requirements"
CONSTRAINTS = REQUIREMENTS / "constraints.txt"
HEAD = (
    "# Packages that those of the other files bring along, in the versions with which the tests run.\n"
    "# Made from what is installed, by `python -m tests.dependencies`.\n"
)


def named(file: str = "dev.txt") -> Iterator[Requirement]:
    """Yield the requirements in this file, and in the files that it includes."""
    for line in (REQUIREMENTS / file).read_text(encoding="utf-8").splitlines():
        if line.startswith("-r "):
            yield from named(line[3:])
        elif line and not line.startswith("#"):
            yield Requirement(line)


def brought_along() -> dict[str, str]:
    """Return the installed version of each package that the requirements bring along and do not name, by its name."""
    direct = list(named())
    looked_up: set[tuple[str, str]] = set()
    to_look_up = [(canonicalize_name(each.name), extra) for each in direct for extra in ("", *each.extras)]
    while to_look_up:
        name, extra = to_look_up.pop()
        if (name, extra) in looked_up:
            continue
        looked_up.add((name, extra))
        for line in importlib.metadata.requires(name) or ():
            need = Requirement(line)
            if need.marker is None or need.marker.evaluate({"extra": extra}):
                to_look_up += [(canonicalize_name(need.name), each) for each in ("", *need.extras)]
    names = {name for name, _ in looked_up} - {canonicalize_name(each.name) for each in direct}
    return {name: importlib.metadata.version(name) for name in sorted(names)}


def constraints() -> dict[str, str]:
    """Return the pinned version of each package in requirements/constraints.txt, by its name."""
    lines = CONSTRAINTS.read_text(encoding="utf-8").splitlines()
    return dict(line.split("==") for line in lines if not line.startswith("#"))


if __name__ == "__main__":
    found = brought_along()
    CONSTRAINTS.write_text(HEAD + "".join(f"{name}=={version}\n" for name, version in found.items()), encoding="utf-8")
