"""Writes `manifest.json`, the list of the folder's files with sizes and hashes, and compares the folder with it."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from hippodrome.console.problem import Problem

NAME = "manifest.json"
SCHEMA = 1


class ExportedFile(NamedTuple):
    """A file in the export folder: its path in the folder, its size in bytes, its SHA-256."""

    path: str
    bytes: int
    sha256: str


def entry(folder: Path, path: Path) -> ExportedFile:
    """Return the manifest's entry for a file in the folder."""
    return ExportedFile(path.relative_to(folder).as_posix(), path.stat().st_size, _sha256(path))


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def difference(folder: Path, file: ExportedFile) -> str:
    """Return how a file in the folder differs from its entry, such as "is missing"; "" if it does not."""
    path = folder / file.path
    try:
        if not path.is_file():
            return "is missing"
        if path.stat().st_size != file.bytes:
            return "has another size"
        return "" if _sha256(path) == file.sha256 else "has another content"
    except OSError as error:
        return f"cannot be read ({error.strerror})"


def write(target: Path, about: Mapping[str, Any], files: Iterable[ExportedFile]) -> None:
    """Write the manifest `target`: the fields of `about`, then a line for each of the `files`, in their order."""
    part = target.with_name(f"{target.name}.part")
    with part.open("w", encoding="utf-8") as out:
        head = json.dumps({"schema": SCHEMA, **about}, indent=1, ensure_ascii=False)
        out.write(head.removesuffix("\n}") + ',\n "files": [')
        comma = "\n  "
        for file in files:
            out.write(comma + json.dumps(file._asdict()))
            comma = ",\n  "
        out.write("\n ]\n}\n")
    os.replace(part, target)


def read(folder: Path) -> dict[str, Any] | None:
    """Return the folder's manifest, with ExportedFile in `files`; None if there is none. Raises `Problem` if it is
    damaged."""
    try:
        about = json.loads((folder / NAME).read_text(encoding="utf-8"))
        files = [ExportedFile(str(line["path"]), int(line["bytes"]), str(line["sha256"])) for line in about["files"]]
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):
        raise Problem(
            f"{folder / NAME} is damaged.", "Run the command without --check: it writes the manifest anew."
        ) from None
    return {**about, "files": files}


def check(folder: Path) -> list[str]:
    """Return a sentence for each file that differs from the folder's manifest, or from that of `private/`. Reads no
    source, and changes nothing. Raises `Problem` without a manifest, or if it is damaged."""
    about, private = read(folder), read(folder / "private")
    if about is None:
        raise Problem(f"There is no {NAME} in {folder}.", "Name the folder that `data` has filled.")
    return [*_damaged(folder, about["files"]), *_damaged(folder, private["files"] if private else [])]


def foreign(folder: Path) -> list[str]:
    """Return the paths of files outside of `private/` that the folder's manifest does not list. Raises `Problem` if it
    is damaged."""
    about = read(folder) or {"files": []}
    known = {NAME, *(file.path for file in about["files"])}
    return sorted(path for path in _shared(folder) if path not in known)


def _damaged(folder: Path, files: Iterable[ExportedFile]) -> list[str]:
    def compare(file: ExportedFile) -> str:
        return difference(folder, file) and f"{file.path} {difference(folder, file)}"

    with ThreadPoolExecutor(4) as pool:
        return [sentence for sentence in pool.map(compare, files) if sentence]


def _shared(folder: Path) -> Iterator[str]:
    """The paths of the files in the folder, without those in `private/`."""
    for top, folders, names in os.walk(folder):
        if Path(top) == folder and "private" in folders:
            folders.remove("private")
        yield from (Path(top, name).relative_to(folder).as_posix() for name in names)
