"""Simulates a disk that loses power: each change that was not synced may be lost or not, in any combination.

Calls are made on a real folder and recorded. `Disk.after_cut` then makes the folder as it may be after a power cut at
one moment of that record. By POSIX (fsync(2)), only this is certain: a file has the bytes of its last sync, and a
folder has the names of its last sync. Each other change of a name may be lost by itself. The record has the bytes of a
file only at its syncs: so a file that was never synced is empty after the cut, and a sync that the cut interrupts may
have written its bytes or not.
"""

from __future__ import annotations

import builtins
import contextlib
import io
import os
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

Chance = Callable[[], bool]


class DiskChange(NamedTuple):
    """One change of a file or folder in the record of a `Disk`."""

    kind: str  # "name", "bytes", "sync"
    thing: int  # the number of what changes: for "name" the folder that holds the name, otherwise the file or folder
    name: str = ""
    to: int | None = None  # for "name": the number of what has the name from now on; None if nothing has
    body: bytes = b""


class Disk:
    """Records the changes of one folder, and makes the folder as it may be after a power cut."""

    def __init__(self, root: Path) -> None:
        self.root = Path(os.path.realpath(root))
        self.record: list[DiskChange] = []
        self._things = {self.root: 0}  # the file or folder that has each path now
        self._count = 0

    @contextlib.contextmanager
    def recording(self) -> Iterator[None]:
        """Record the changes within the block."""
        opened = partial(self._open, io.open)
        with contextlib.ExitStack() as stack:
            for owner, name, made in (
                (os, "open", partial(self._os_open, os.open)),
                (os, "mkdir", partial(self._mkdir, os.mkdir)),
                (os, "link", partial(self._link, os.link)),
                (os, "rename", partial(self._rename, os.rename)),
                (os, "replace", partial(self._rename, os.replace)),
                (os, "unlink", partial(self._unlink, os.unlink)),
                (os, "fsync", partial(self._fsync, os.fsync)),
                (io, "open", opened),
                (builtins, "open", opened),
            ):
                stack.enter_context(mock.patch.object(owner, name, made))
            yield

    def after_cut(self, moment: int, chance: Chance, place: Path) -> None:
        """Make in `place` the folder as it may be if power fails after the first `moment` changes.

        `chance` says of each uncertain change whether it reached the disk.
        """
        record = self.record[:moment]
        synced = {change.thing: number for number, change in enumerate(record) if change.kind == "sync"}
        names: dict[int, dict[str, int]] = {}
        bodies: dict[int, bytes] = {}
        for number, change in enumerate(record):
            certain = number < synced.get(change.thing, -1)
            if change.kind == "sync" or not (certain or chance()):
                continue
            if change.kind == "bytes":
                bodies[change.thing] = change.body
            elif change.to is None:
                names.setdefault(change.thing, {}).pop(change.name, None)
            else:
                names.setdefault(change.thing, {})[change.name] = change.to
        folders = {0, *(change.thing for change in self.record if change.kind == "name")}
        self._make(place, 0, names, bodies, folders)

    def _make(
        self, place: Path, thing: int, names: dict[int, dict[str, int]], bodies: dict[int, bytes], folders: set[int]
    ) -> None:
        if thing not in folders and not self._is_folder(thing):
            place.write_bytes(bodies.get(thing, b""))
            return
        place.mkdir(exist_ok=True)
        for name, inner in names.get(thing, {}).items():
            self._make(place / name, inner, names, bodies, folders)

    def _is_folder(self, thing: int) -> bool:
        return any(known == thing and path.is_dir() for path, known in self._things.items())

    # The functions of Python's library

    def _path(self, path: Any) -> Path | None:
        """Return the path if it is below the root, else None."""
        try:
            found = Path(os.path.abspath(os.fsdecode(path)))
        except TypeError:  # a handle
            return None
        return found if found.is_relative_to(self.root) else None

    def _new(self, path: Path) -> None:
        self._count += 1
        self._things[path] = self._count
        self._name(path, self._count)

    def _name(self, path: Path, thing: int | None) -> None:
        self.record.append(DiskChange("name", self._things[path.parent], path.name, thing))

    def _open(self, do: Any, path: Any, mode: str = "r", *args: Any, **options: Any) -> Any:
        found = self._path(path)
        new = found is not None and found not in self._things and bool(set(mode) & set("wxa"))
        made = do(path, mode, *args, **options)
        if new and found:
            self._new(found)
        return made

    def _os_open(self, do: Any, path: Any, flags: int, *args: Any, **options: Any) -> Any:
        made = do(path, flags, *args, **options)
        found = self._path(path)
        if found and found not in self._things and flags & os.O_CREAT:
            self._new(found)
        return made

    def _mkdir(self, do: Any, path: Any, *args: Any, **options: Any) -> None:
        do(path, *args, **options)
        if found := self._path(path):
            self._new(found)

    def _link(self, do: Any, source: Any, target: Any, **options: Any) -> None:
        do(source, target, **options)
        here, there = self._path(source), self._path(target)
        if here and there:
            self._things[there] = self._things[here]
            self._name(there, self._things[here])

    def _rename(self, do: Any, source: Any, target: Any, **options: Any) -> None:
        do(source, target, **options)
        here, there = self._path(source), self._path(target)
        if here and there:
            self._things[there] = self._things.pop(here)
            self._name(there, self._things[there])
            self._name(here, None)

    def _unlink(self, do: Any, path: Any, **options: Any) -> None:
        do(path, **options)
        if found := self._path(path):
            del self._things[found]
            self._name(found, None)

    def _fsync(self, do: Any, handle: int) -> None:
        """Record the sync, but do not sync: `after_cut` needs only the record.

        Raises OSError if the file is not open.
        """
        os.fstat(handle)
        found = self._path(os.readlink(f"/proc/self/fd/{handle}"))
        if found is None:
            return
        thing = self._things[found]
        if not found.is_dir():
            self.record.append(DiskChange("bytes", thing, body=found.read_bytes()))
        self.record.append(DiskChange("sync", thing))
