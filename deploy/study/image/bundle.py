"""The build context of a project's image: which bytes go in, what hash they have, and the context as folder or zip."""

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

from console.problem import Problem
from deploy.study.image.files import project_files
from hippodrome.config import agent_imports, layout
from hippodrome.config.layout import REQUIREMENTS

HERE = Path(__file__).resolve().parents[3]
_EPOCH = (1980, 1, 1, 0, 0, 0)  # the earliest a zip can say: the same files make the same bytes
_CHUNK = 1024 * 1024

_ELSEWHERE = re.compile(
    r"-[rcef]\b|--(?:requirement|constraint|editable|find-links)\b|\.{0,2}/|[A-Za-z]:\\|(?:.*@\s*)?file:"
)
_PASSWORD = re.compile(r"://[^/\s@]+@")
_IMAGE = re.compile(r"[a-z0-9][A-Za-z0-9._:@/-]{0,254}")
_COMMENT = re.compile(r"(^|\s+)#.*$")


@dataclass(frozen=True)
class Bundle:
    """The files of an image's build context: by name there, a file or bytes."""

    entries: Mapping[str, Path | bytes]

    @property
    def hash(self) -> str:
        """Twelve hex digits that depend on the content alone."""
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
        for empty in ("project",):  # the Dockerfile copies it, also where a project brings no files of its own
            (folder / empty).mkdir(exist_ok=True)

    def write_zip(self, file: Path) -> None:
        """Write the context as a zip; the same content is the same bytes."""
        with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr(_info("project/", stat.S_IFDIR | 0o755), b"")
            for name, entry in sorted(self.entries.items()):
                with archive.open(_info(name, stat.S_IFREG | _mode(entry)), "w", force_zip64=True) as out:
                    for chunk in _chunks(entry):
                        out.write(chunk)


def make_bundle(folder: Path, base: str = "", trial: Mapping[str, Any] | None = None) -> Bundle:
    """The build context for the project in `folder`. Raises `Problem` if something in it cannot go into an image.

    `base` is the image to build on instead of the Dockerfile's own. `trial` is the section of config.yml: its game and
    options are what the agent is tried with while the image is built (trial/check.py). Where it says who plays whom, or
    that objects are drawn, that and the names of the actions count too, and nothing else.
    """
    entries: dict[str, Path | bytes] = {
        "Dockerfile": _dockerfile(base),
        "check.json": _tried_with(trial or {}),
        "requirements/trial.txt": HERE / "requirements/trial.txt",
        "requirements/project.txt": _requirements(folder),
    }
    for ours in ("protocol", "trial"):
        entries |= {path.relative_to(HERE).as_posix(): path for path in sorted((HERE / ours).rglob("*.py"))}
    entries |= {f"project/{name}": path for name, path in project_files(folder).items()}
    return Bundle(entries)


def _dockerfile(base: str) -> bytes:
    text = (HERE / "infra/Dockerfile").read_text(encoding="utf-8")
    if base and not _IMAGE.fullmatch(base):
        raise Problem(f"{base!r} is no name of an image.", "Write it as docker pull takes it: place/name:tag.")
    return re.sub(r"(?m)^ARG BASE=.*$", f"ARG BASE={base}", text).encode() if base else text.encode()


def _tried_with(trial: Mapping[str, Any]) -> bytes:
    keys = ("game", "options", "scene", *(("players", "actionSpace") if trial.get("players") else ()))
    return json.dumps({key: trial[key] for key in keys if trial.get(key)}, sort_keys=True).encode()


def _requirements(folder: Path) -> bytes:
    """The project's requirements.txt, or nothing. Only what it says itself is there when it is installed."""
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
    """Readable for all users, because the trial's user does not own the files."""
    return 0o755 if isinstance(entry, Path) and entry.stat().st_mode & stat.S_IXUSR else 0o644


def _info(name: str, mode: int) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, _EPOCH)
    info.create_system = 3  # Unix, on every system, so that the mode counts
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
