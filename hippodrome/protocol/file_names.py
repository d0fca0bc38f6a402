"""Compares names of files as people read them.

macOS may write "Ü" as "U" and a mark (Unicode's form NFD), keyboards write one character (NFC). On Linux these are two
names, so a file from a Mac is not found by its name.
"""

from __future__ import annotations

from pathlib import Path
from unicodedata import normalize


def composed(name: str) -> str:
    """Return the name in the form NFC, in which two names that look alike are equal."""
    return name if name.isascii() else normalize("NFC", name)


def on_disk(folder: Path, name: str) -> Path:
    """Return the path of this relative name in a folder, as the disk spells it if there is such a file."""
    path = folder / name
    if name.isascii() or path.exists():
        return path
    for part in Path(name).parts:
        here = folder.iterdir() if folder.is_dir() else ()
        folder = next((person for person in here if composed(person.name) == composed(part)), folder / part)
    return folder
