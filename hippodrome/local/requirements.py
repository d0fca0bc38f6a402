"""`python -m hippodrome.local.requirements FOLDER`: install what a study's agent imports, by its `requirements.txt`.

`make run`, `make try` and `make check` begin with it. It installs once for each content of the file. If the servers'
image has one of the packages too, the image's version is installed, as on AWS.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from hippodrome import places
from hippodrome.control.config import ConfigErrors, layout

OF_THE_IMAGE = places.ROOT / "requirements" / "trial.txt"


def wanted(folder: Path) -> Path | None:
    """Return the project's `requirements.txt`; None if there is none, or if the project is a clone of HIPPO Gym.

    The clone's file names versions for Python 3.7, which cannot be installed (docs/hippo.md).
    """
    try:
        found = layout.find(folder)
    except ConfigErrors:
        return None  # the command that runs next reports the mistake
    return None if found.requirements is None or found.of_hippo else found.requirements


def stamp_of(file: Path, constraints: Path, stamps: Path) -> Path:
    """Return the path of the empty file that exists once the packages of these two files have been installed."""
    content = hashlib.sha256(file.read_bytes() + b"\0" + constraints.read_bytes())
    return stamps / content.hexdigest()[:32]


def install(file: Path, constraints: Path, stamps: Path) -> str:
    """Install the file's packages, unless that has been done. Return a sentence if it failed, otherwise ""."""
    stamp = stamp_of(file, constraints, stamps)
    if stamp.exists():
        return ""
    sys.stdout.write(f"Installing what {file} names (once) …\n")
    sys.stdout.flush()
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    status = subprocess.run([*pip, "-r", file, "-c", constraints], check=False).returncode  # noqa: S603 - the study's own
    if status:
        return (
            f"Not everything that {file} names could be installed: see above. If agent.py needs what is missing, its "
            "error at the start names it."
        )
    stamps.mkdir(parents=True, exist_ok=True)
    stamp.touch()
    return ""


def main(
    folder: Annotated[Path, typer.Argument(help="The project folder.")] = Path(),
    *,
    constraints: Annotated[Path, typer.Option(help="The versions of the servers' image.")] = OF_THE_IMAGE,
    stamps: Annotated[Path, typer.Option(help="The folder that notes what has been installed.")] = Path(sys.prefix)
    / "studies",
) -> None:
    """Install the packages of the study in FOLDER, once. The exit status is 0 even if that fails."""
    file = wanted(folder)
    failure = install(file, constraints, stamps) if file else ""
    if failure:
        sys.stdout.write(f"{failure}\n")


if __name__ == "__main__":
    typer.run(main)
