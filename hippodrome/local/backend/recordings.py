"""Moves recordings that a killed server left in the spool to the data folder.

They are cut off, but all lines before that place can be read.
"""

from __future__ import annotations

import filecmp
from collections.abc import Sequence
from itertools import count
from pathlib import Path

from hippodrome.local.backend import files
from hippodrome.local.backend.task_record import TaskRecord
from hippodrome.protocol import disk
from hippodrome.protocol.keys import with_number


def unfinished(spool: Path, task: TaskRecord) -> Sequence[Path]:
    """Return the task's recordings in the spool that belong in the data folder. Raises OSError."""
    if not (task.kept and task.folder):
        return []
    folder = spool / f"{task.folder}/trials/{task.server or task.name}"
    return [folder / name for name in files.names(folder, ".part")] if files.exists(folder) else []


def move_to_data(spool: Path, data: Path, task: TaskRecord) -> None:
    """Move the task's unfinished recordings to the data folder; delete those in which nothing was written.

    Raises OSError; it may then be called again.
    """
    for recording in unfinished(spool, task):
        if recording.stat().st_size == 0:  # the disk was full, or the server was killed in the first half second
            recording.unlink()
            continue
        place = data / recording.relative_to(spool)
        _move(recording, place.with_name(place.name.removesuffix(".part")))


def _move(file: Path, place: Path) -> None:
    """Move a recording without overwriting a file, even to another file system. Can be called again if interrupted."""
    disk.make_folder(place.parent)
    for number in count(1):
        numbered = place.with_name(with_number(place.name, number))
        try:
            disk.move(file, numbered)
        except FileExistsError:
            if not filecmp.cmp(file, numbered, shallow=False):
                continue  # another recording has that name
        break
    file.unlink(missing_ok=True)
