"""Installs what a study's agent imports, by its `requirements.txt`.

`hippodrome run`, `try` and `check` begin with it. It installs once for each content of the file. If the servers'
image has one of the packages too, the image's version is installed, as on AWS.
"""

from __future__ import annotations

import hashlib
import shlex
import subprocess
import sys
from importlib import metadata
from pathlib import Path

from packaging.requirements import InvalidRequirement, Requirement

from hippodrome import places
from hippodrome.control.config import ConfigErrors, layout

OF_THE_IMAGE = places.ROOT / "requirements" / "trial.txt"
STAMPS = Path(sys.prefix) / "studies"


def wanted(folder: Path) -> Path | None:
    """Return the project's `requirements.txt`; None if there is none, or if the project is a clone of HIPPO Gym.

    The clone's file names versions for Python 3.7, which cannot be installed (docs/hippo.md).
    """
    try:
        agent_folder = layout.find(folder)
    except ConfigErrors:
        return None  # the command that runs next reports the mistake
    return None if agent_folder.requirements is None or agent_folder.of_hippo else agent_folder.requirements


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
    pip = [sys.executable, "-P", "-m", "pip", "install", "--quiet", "--disable-pip-version-check"]
    status = subprocess.run([*pip, "-r", file, "-c", constraints], check=False).returncode  # noqa: S603 - the study's own
    if status:
        return (
            f"Not everything that {file} names could be installed: see above. If agent.py needs what is missing, its "
            "error at the start names it."
        )
    stamps.mkdir(parents=True, exist_ok=True)
    stamp.touch()
    return ""


def prepare(folder: Path, constraints: Path | None = None, stamps: Path = STAMPS) -> None:
    """Install what the study in this folder needs, once. Print a sentence if that fails, or is left to the researcher.

    `constraints` has the versions of the servers' image; `stamps` is the folder that notes what has been installed.
    """
    file = wanted(folder)
    if file is None:
        return
    if sys.prefix == sys.base_prefix:  # a Python of the whole machine, which is not ours to change
        missing = ", ".join(not_installed(file))
        failure = missing and (
            f"This Python lacks {missing}, which {file} names, and is no virtual environment, so nothing was "
            f"installed. Install it with: {shlex.join([sys.executable, '-m', 'pip', 'install', '-r', str(file)])}"
        )
    else:
        failure = install(file, constraints or _constraints(), stamps)
    if failure:
        sys.stdout.write(f"{failure}\n")
        sys.stdout.flush()


def not_installed(file: Path) -> list[str]:
    """Return the requirements in the file that this Python does not meet. Options and addresses are left out."""
    missing = []
    for line in file.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            requirement = Requirement(line.partition(" #")[0].strip())
        except InvalidRequirement:
            continue
        if requirement.marker is not None and not requirement.marker.evaluate():
            continue
        try:
            version = metadata.version(requirement.name)
        except metadata.PackageNotFoundError:
            missing.append(str(requirement))
        else:
            if not requirement.specifier.contains(version, prereleases=True):
                missing.append(str(requirement))
    return missing


def _constraints() -> Path:
    """The versions of the servers' image; on Intel Macs those that make has written, for which there are wheels."""
    of_make = Path(sys.prefix) / "requirements" / OF_THE_IMAGE.name
    return of_make if of_make.is_file() else OF_THE_IMAGE
