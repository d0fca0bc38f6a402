"""The walks of docs/architecture.md lead through files, functions and constants that exist."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
_FILE = re.compile(r"`(?P<file>[\w/.-]+\.(?:py|js))`(?: \((?P<names>`\w+`(?:, `\w+`)*)\))?")


def rows() -> Iterator[tuple[str, str]]:
    """Each row of the walks: what happens or is asked, and what to read."""
    walks = (ROOT / "docs/architecture.md").read_text().partition("### One walk")[2].partition("\n## ")[0]
    for line in walks.splitlines():
        if line.startswith("| ") and not line.endswith(" | read |"):
            happens, _, read = line.strip("| ").partition(" | ")
            yield happens, read


def named() -> Iterator[tuple[str, Path | None, list[str]]]:
    """What each row names: the file, and functions, classes or constants in it.

    A file stands with its whole path, or in the folder of the one before it, or in one around that.
    """
    folder = ROOT
    for happens, read in rows():
        for found in _FILE.finditer(read):
            around = [folder, *folder.parents]
            places = [each / found["file"] for each in around if each.is_relative_to(ROOT)]
            file = next((place for place in places if place.is_file()), None)
            folder = folder if file is None else file.parent
            yield f"{happens}: {found['file']}", file, re.findall(r"\w+", found["names"] or "")


@pytest.mark.parametrize(("what", "file", "names"), list(named()))
def test_a_walk_leads_to_what_exists(what: str, file: Path | None, names: list[str]) -> None:
    assert file is not None, what
    code = file.read_text()
    missing = [
        name
        for name in names
        if not re.search(rf"^(?: *(?:async )?(?:def|class) {name}\b|{name}(?:: \S+)? = )", code, re.M)
    ]
    assert missing == []


def in_folders() -> Iterator[tuple[Path, str]]:
    """Each folder and file that the lists of folders name, with the folder of its item."""
    listed = (ROOT / "docs/architecture.md").read_text().partition("\n## Folders\n")[2].partition("\n## ")[0]
    folder = ROOT
    for item in listed.splitlines():
        if found := re.match(r"\* `([\w/]+/)`", item):
            folder = ROOT / found[1]
            yield folder, "."
        if re.match(r" *\* `", item):
            for named in re.findall(r"`([\w/]+(?:\.py|\.js|/))`", item):
                yield folder, named


@pytest.mark.parametrize(("folder", "named"), list(in_folders()))
def test_every_file_in_the_lists_of_folders_exists(folder: Path, named: str) -> None:
    assert (folder / named).exists() or (ROOT / named).exists()


def test_each_folder_of_the_large_packages_has_its_row() -> None:
    rows = {folder for folder, named in in_folders() if named == "."}
    folders = {
        file.parent for package in ("hippodrome", "trial", "deploy") for file in ROOT.glob(f"{package}/*/__init__.py")
    }
    assert folders - rows == set()
