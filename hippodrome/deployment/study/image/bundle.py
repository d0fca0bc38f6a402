"""The build context of a project's image: its files, their hash, and the context as a folder."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hippodrome import places
from hippodrome.console.problem import Problem
from hippodrome.control.config import agent_imports, layout
from hippodrome.control.config.layout import REQUIREMENTS
from hippodrome.deployment.study.image.files import project_files
from hippodrome.deployment.study.image.layers import hash_of, mode

_ELSEWHERE = re.compile(
    r"-[rcef]\b|--(?:requirement|constraint|editable|find-links)\b|\.{0,2}/|[A-Za-z]:\\|(?:.*@\s*)?file:"
)
_PASSWORD = re.compile(r"://[^/\s@]+@")
_IMAGE = re.compile(r"[a-z0-9][A-Za-z0-9._:@/-]{0,254}")
_BASE = re.compile(r"(?m)^ARG BASE=(.*)$")
_COMMENT = re.compile(r"(^|\s+)#.*$")


@dataclass(frozen=True)
class Bundle:
    """The files of an image's build context: by the name there, a file of this machine, or bytes."""

    entries: Mapping[str, Path | bytes]

    @property
    def hash(self) -> str:
        """Twelve hex digits that depend only on the files' names, permissions and bytes."""
        return hash_of(self.entries)[:12]

    @property
    def size(self) -> int:
        """The size of all files, in bytes."""
        return sum(len(entry) if isinstance(entry, bytes) else entry.stat().st_size for entry in self.entries.values())

    def write_folder(self, folder: Path) -> None:
        """Write the context into an empty folder."""
        for name, entry in self.entries.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            if isinstance(entry, bytes):
                path.write_bytes(entry)
            else:
                shutil.copyfile(entry, path)
            path.chmod(mode(entry))
        (folder / "project").mkdir(exist_ok=True)  # the Dockerfile copies it, even if the project has no files

    @property
    def base(self) -> str:
        """The name of the base image, as docker pull takes it."""
        dockerfile = self.entries["Dockerfile"]
        assert isinstance(dockerfile, bytes)
        match = _BASE.search(dockerfile.decode())
        assert match
        return match[1]

    @property
    def requirements(self) -> str:
        """The study's requirements.txt; "" without one."""
        text = self.entries["requirements/project.txt"]
        assert isinstance(text, bytes)
        return text.decode()

    def below(self, folder: str) -> dict[str, Path | bytes]:
        """Return the files below a folder of the context, by their paths in the context."""
        return {name: entry for name, entry in self.entries.items() if name.startswith(f"{folder}/")}


def make_bundle(folder: Path, base: str = "", trial: Mapping[str, Any] | None = None) -> Bundle:
    """Make the build context for the project in `folder`. Raises `Problem` if a part of it cannot go into an image.

    `base` is the base image, instead of the Dockerfile's own. `trial` is that section of config.yml. While the image is
    built, the agent is tried with its keys `game`, `options` and `scene`; if it has `players`, also with that and
    `actionSpace` (hippodrome/trial/check.py). Its other keys do not change the image.
    """
    entries: dict[str, Path | bytes] = {
        "Dockerfile": _dockerfile(base),
        "check.json": _check_json(trial or {}),
        "requirements/trial.txt": places.ROOT / "requirements/trial.txt",
        "requirements/project.txt": _requirements(folder),
    }
    package = places.PACKAGES / "hippodrome"
    files = (package / "__init__.py", package / "llm.py")  # agent.py may import hippodrome.llm
    code = (*files, *(package / "protocol").rglob("*.py"), *(package / "trial").rglob("*.py"))
    entries |= {path.relative_to(places.PACKAGES).as_posix(): path for path in sorted(code)}
    entries |= {f"project/{name}": path for name, path in project_files(folder).items()}
    return Bundle(entries)


def _dockerfile(base: str) -> bytes:
    text = (places.ROOT / "infra/Dockerfile").read_text(encoding="utf-8")
    if base and not _IMAGE.fullmatch(base):
        raise Problem(f"{base!r} is no name of an image.", "Write it as docker pull takes it: place/name:tag.")
    return _BASE.sub(f"ARG BASE={base}", text).encode() if base else text.encode()


def _check_json(trial: Mapping[str, Any]) -> bytes:
    """Write the keys of `trial` with which hippodrome/trial/check.py tries the agent, as JSON."""
    keys = ("game", "options", "scene", *(("players", "actionSpace") if trial.get("players") else ()))
    return json.dumps({key: trial[key] for key in keys if trial.get(key)}, sort_keys=True).encode()


def _requirements(folder: Path) -> bytes:
    """Read the project's requirements.txt; b"" if there is none.

    Raises `Problem` on a line that cannot be installed.
    """
    file = layout.requirements_file(folder)
    if file is None:
        return b""
    try:
        text, _ = agent_imports.project_requirements(folder, file.read_text(encoding="utf-8-sig"))
    except (OSError, UnicodeDecodeError):
        raise Problem(f"{REQUIREMENTS} cannot be read.", "Save it as UTF-8 text.") from None
    for number, line in enumerate(text.splitlines(), 1):
        requirement = _COMMENT.sub("", line).strip()
        where = f"{REQUIREMENTS}:{number}"
        if _PASSWORD.search(requirement):
            raise Problem(
                f"{where}: an address with a password in it.", "Everyone who has the image could read it. Take it out."
            )
        if "git+" in requirement:
            raise Problem(
                f"{where}: the image has no git to fetch this with.",
                "Give the address of an archive of that commit, such as name @ https://…/archive/COMMIT.zip.",
            )
        if _ELSEWHERE.match(requirement):
            raise Problem(
                f"{where}: this leads to another file, which is not there when the image is built.",
                f"Write what is needed into {REQUIREMENTS} itself; modules of your own can lie beside agent.py.",
            )
    return text.encode()
