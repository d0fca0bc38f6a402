"""`python -m local.requirements FOLDER`: install what a study's agent imports, by its `requirements.txt`.

`make run`, `try` and `check` begin with it. It does something once for each content of the file. Versions are those of
the servers' image where both name a package, as on AWS.
"""

from __future__ import annotations

import hashlib
import subprocess
import sys
from pathlib import Path
from typing import Annotated

import typer

from hippodrome.config import ConfigErrors, layout

ROOT = Path(__file__).resolve().parent.parent
OF_THE_IMAGE = ROOT / "requirements" / "trial.txt"


def wanted(folder: Path) -> Path | None:
    """The file to install; None if there is none, or if it is that of a clone of HIPPO Gym.

    Those name versions for Python 3.7, which cannot be installed (docs/hippo.md).
    """
    try:
        found = layout.find(folder)
    except ConfigErrors:
        return None  # the command that follows says what is wrong
    return None if found.requirements is None or found.of_hippo else found.requirements


def stamp_of(file: Path, constraints: Path, stamps: Path) -> Path:
    """The empty file that says that this content has been installed."""
    content = hashlib.sha256(file.read_bytes() + b"\0" + constraints.read_bytes())
    return stamps / content.hexdigest()[:32]


def install(file: Path, constraints: Path, stamps: Path) -> str:
    """Install the file's packages, unless that has been done. Returns what to say: nothing, if all is there."""
    stamp = stamp_of(file, constraints, stamps)
    if stamp.exists():
        return ""
    sys.stdout.write(f"Installing what {file} names (once) …\n")
    sys.stdout.flush()
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    status = subprocess.run([*pip, "-r", file, "-c", constraints], check=False).returncode  # noqa: S603 - the study's own
    if status:
        return (
            f"Not everything that {file} names could be installed: see above. What the agent misses, it says itself "
            "when it starts."
        )
    stamps.mkdir(parents=True, exist_ok=True)
    stamp.touch()
    return ""


def main(
    folder: Annotated[Path, typer.Argument(help="The project folder.")] = Path(),
    *,
    constraints: Annotated[Path, typer.Option(help="The versions of the servers' image.")] = OF_THE_IMAGE,
    stamps: Annotated[Path, typer.Option(help="Where it is kept what has been installed.")] = Path(sys.prefix)
    / "studies",
) -> None:
    """Install what the study in FOLDER needs, once. It ends well also if that cannot be installed."""
    file = wanted(folder)
    said = install(file, constraints, stamps) if file else ""
    if said:
        sys.stdout.write(f"{said}\n")


if __name__ == "__main__":
    typer.run(main)
