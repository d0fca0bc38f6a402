"""Writes `manifest.json`, the list of the folder's files with sizes and hashes, and compares the folder with it."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any

from hippodrome.console.problem import Problem
from hippodrome.export.fetch import sha256
from hippodrome.export.state import ExportedFile

NAME = "manifest.json"
SCHEMA = 1
_AT_ONCE = 256  # files that are compared in a batch


def entry(folder: Path, path: Path) -> ExportedFile:
    """Return the manifest's entry for a file in the folder."""
    return ExportedFile(path.relative_to(folder).as_posix(), path.stat().st_size, sha256(path))


def write(target: Path, about: Mapping[str, Any], files: Iterable[ExportedFile]) -> None:
    """Write the manifest `target`: the fields of `about`, then a line for each of the `files`, in their order."""
    part = target.with_name(f"{target.name}.part")
    with part.open("w", encoding="utf-8") as out:
        head = json.dumps({"schema": SCHEMA, **about}, indent=1, ensure_ascii=False)
        out.write(head.removesuffix("\n}") + ',\n "files": [')
        comma = "\n  "
        for file in files:
            out.write(comma + json.dumps({"path": file.path, "bytes": file.bytes, "sha256": file.sha256}))
            comma = ",\n  "
        out.write("\n ]\n}\n")
    os.replace(part, target)


def read(folder: Path) -> dict[str, Any] | None:
    """Return the folder's manifest, with ExportedFile in `files`; None if there is none. Raises `Problem` if it is
    damaged."""
    try:
        found = json.loads((folder / NAME).read_text(encoding="utf-8"))
        files = [ExportedFile(str(line["path"]), int(line["bytes"]), str(line["sha256"])) for line in found["files"]]
    except FileNotFoundError:
        return None
    except (ValueError, KeyError, TypeError):
        raise Problem(
            f"{folder / NAME} is damaged.", "Run the command without --check: it writes the manifest anew."
        ) from None
    return {**found, "files": files}


def damaged(folder: Path, files: Iterable[ExportedFile]) -> Iterator[tuple[str, str]]:
    """Yield the path of each file that differs from its entry, and the difference, such as "is missing"."""

    def compare(file: ExportedFile) -> str:
        path = folder / file.path
        try:
            if not path.is_file():
                return "is missing"
            if path.stat().st_size != file.bytes:
                return "has another size"
            return "" if sha256(path) == file.sha256 else "has another content"
        except OSError as error:
            return f"cannot be read ({error.strerror})"

    rest = iter(files)
    with ThreadPoolExecutor(4) as pool:
        while batch := [*islice(rest, _AT_ONCE)]:
            for file, difference in zip(batch, pool.map(compare, batch), strict=True):
                if difference:
                    yield file.path, difference


def unlisted(folder: Path, files: Iterable[ExportedFile]) -> Iterator[str]:
    """Yield the paths of the files in the folder that are not in `files`, without those in `private/`."""
    known = {file.path for file in files} | {NAME}
    for top, folders, names in os.walk(folder):
        if Path(top) == folder and "private" in folders:
            folders.remove("private")
        for name in names:
            path = Path(top, name).relative_to(folder).as_posix()
            if path not in known:
                yield path
