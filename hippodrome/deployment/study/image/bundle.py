"""The build context of a project's image: its files, their hash, and the context as a folder or a zip."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import stat
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hippodrome import places
from hippodrome.console.problem import Problem
from hippodrome.control.config import agent_imports, layout
from hippodrome.control.config.layout import REQUIREMENTS
from hippodrome.deployment.study.image.files import project_files

_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest time in a zip, for all files: the same files make the same bytes
_CHUNK = 1024 * 1024

_ELSEWHERE = re.compile(
    r"-[rcef]\b|--(?:requirement|constraint|editable|find-links)\b|\.{0,2}/|[A-Za-z]:\\|(?:.*@\s*)?file:"
)
_PASSWORD = re.compile(r"://[^/\s@]+@")
_IMAGE = re.compile(r"[a-z0-9][A-Za-z0-9._:@/-]{0,254}")
_COMMENT = re.compile(r"(^|\s+)#.*$")


@dataclass(frozen=True)
class Bundle:
    """The files of an image's build context: by the name there, a file of this machine, or bytes."""

    entries: Mapping[str, Path | bytes]

    @property
    def hash(self) -> str:
        """Twelve hex digits that depend only on the files' names, permissions and bytes."""
        digest = hashlib.sha256()
        for name, entry in sorted(self.entries.items()):
            inner = hashlib.sha256()
            for chunk in _chunks(entry):
                inner.update(chunk)
            digest.update(f"{name}\0{_mode(entry):o}\0{inner.hexdigest()}\n".encode("utf-8", "surrogateescape"))
        return digest.hexdigest()[:12]

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
            path.chmod(_mode(entry))
        (folder / "project").mkdir(exist_ok=True)  # the Dockerfile copies it, even if the project has no files

    def write_zip(self, file: Path) -> None:
        """Write the context as a zip. The same content makes the same bytes."""
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(_info("project/", stat.S_IFDIR | 0o755), b"")
            for name, entry in sorted(self.entries.items()):
                with archive.open(_info(name, stat.S_IFREG | _mode(entry)), "w", force_zip64=True) as out:
                    for chunk in _chunks(entry):
                        out.write(chunk)


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
    code = (package / "__init__.py", *(package / "protocol").rglob("*.py"), *(package / "trial").rglob("*.py"))
    entries |= {path.relative_to(places.PACKAGES).as_posix(): path for path in sorted(code)}
    entries |= {f"project/{name}": path for name, path in project_files(folder).items()}
    return Bundle(entries)


def _dockerfile(base: str) -> bytes:
    text = (places.ROOT / "infra/Dockerfile").read_text(encoding="utf-8")
    if base and not _IMAGE.fullmatch(base):
        raise Problem(f"{base!r} is no name of an image.", "Write it as docker pull takes it: place/name:tag.")
    return re.sub(r"(?m)^ARG BASE=.*$", f"ARG BASE={base}", text).encode() if base else text.encode()


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
        wanted = _COMMENT.sub("", line).strip()
        where = f"{REQUIREMENTS}:{number}"
        if _PASSWORD.search(wanted):
            raise Problem(
                f"{where}: an address with a password in it.", "Everyone who has the image could read it. Take it out."
            )
        if "git+" in wanted:
            raise Problem(
                f"{where}: the image has no git to fetch this with.",
                "Give the address of an archive of that commit, such as name @ https://…/archive/COMMIT.zip.",
            )
        if _ELSEWHERE.match(wanted):
            raise Problem(
                f"{where}: this leads to another file, which is not there when the image is built.",
                f"Write what is needed into {REQUIREMENTS} itself; modules of your own can lie beside agent.py.",
            )
    return text.encode()


def _mode(entry: Path | bytes) -> int:
    """Return a file's mode in the image: readable for all, because the trial's user does not own the files."""
    return 0o755 if isinstance(entry, Path) and entry.stat().st_mode & stat.S_IXUSR else 0o644


def _info(name: str, mode: int) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, _EPOCH)
    info.create_system = 3  # Unix, on every system, so that the mode is used
    info.external_attr = mode << 16
    info.compress_type = zipfile.ZIP_DEFLATED
    return info


def _chunks(entry: Path | bytes) -> Iterator[bytes]:
    if isinstance(entry, bytes):
        yield entry
        return
    with entry.open("rb") as stream:
        while chunk := stream.read(_CHUNK):
            yield chunk
