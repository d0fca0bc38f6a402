"""Recordings: gzip of JSON lines, one line per step. All lines up to the last flush can be read after any crash.

Kinds of lines: `header` (the first of each file), `reset` (an episode begins), `resume` (it goes on after the steps of
a lost server), `step`, `callback` (values that a callback of the agent recorded), `error` (the researcher's code
failed), `end` (an episode ends, or the server must end), `break` (a break ends), and in a session `presence` and
`ping`. Nothing is pickled.

A `step` says how its action was chosen. `human` is the number of the action that the participant's keys chose (null if
no key acted). `action` and `actionName` are the action taken. `by` is who chose it: `agent` (the agent reports the
action as its own, even if it is the human's), or one of `hippodrome.trial.core.players.By`. Times are UTC:
2026-11-21T14:46:40.123456Z. docs/data.md describes all fields.
"""

from __future__ import annotations

import base64
import contextlib
import functools
import json
import os
import platform
import re
import threading
import time
import zlib
from collections.abc import Iterable, Mapping
from datetime import datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from hippodrome.protocol import disk
from hippodrome.protocol.times import time_text
from hippodrome.trial.recordings.recorded_values import CUT_OFF, LISTED, Values, text_of

SCHEMA = 1
"""The version of the lines' format."""
VERSION = "1.0"
"""The version of the trial server, in the header of each recording."""
SYNC_SECONDS = 5.0
"""The time between two syncs of an open recording to the disk: a power cut loses at most the lines of this time."""
MAX_EXTRA_BYTES = 1_000_000
"""The most bytes of JSON in one line for the values that an agent's `step` returns beside Gymnasium's."""
MAX_TOO_LARGE = 100
"""The most values of one line that are replaced by their sizes; the values after them are left out."""
MAX_NAME = 1_000
"""The most characters of a value's name, if there is no room for the whole name."""


def line(kind: str, /, **fields: Any) -> bytes:
    """Build a line of a recording. `plain` converts values that JSON cannot hold. `time` may be a datetime in UTC."""
    record = {"kind": kind, **fields}
    if isinstance(fields.get("time"), datetime):
        record["time"] = time_text(fields["time"])
    try:
        text = _JSON.encode(record)
    except Exception:  # noqa: BLE001 - NaN, keys that are not text, cycles, errors: too rare to look for them first
        text = _JSON.encode(plain(record))
    return text.encode() + b"\n"


def plain(value: Any) -> Any:
    """Convert a value for JSON: NumPy's numbers and arrays to numbers and lists, NaN to null, other objects to text."""
    return Values().keep(value)


def succeeded(info: Mapping[str, Any]) -> bool:
    """Return whether an info has a true `success`, as environments report it (Gymnasium, Meta-World, ManiSkill)."""
    return bool(plain(info.get("success")))


_JSON = json.JSONEncoder(default=plain, separators=(",", ":"), allow_nan=False)


def observation(value: Any) -> Any:
    """Convert an observation for a recording: arrays to base64 of zlib of their bytes, with dtype and shape."""
    return Values(listed=-1).keep(value)


def bounded_extra(values: Mapping[str, Any], left: int = MAX_EXTRA_BYTES) -> tuple[dict[str, Any], dict[str, int]]:
    """Convert the values that an agent's `step` returned beside Gymnasium's for a recording, `left` bytes at most.

    A value for which the values before it leave no room is replaced by `{"tooLarge": bytes}`. The second result has the
    sizes of these values by name; a value that was not converted whole is at least so large. After `MAX_TOO_LARGE` of
    them the rest is left out, and `"<cut off>"` is the number of values left out.
    """
    recorded: dict[str, Any] = {}
    too_large: dict[str, int] = {}
    for index, (key, value) in enumerate(values.items()):
        if len(too_large) == MAX_TOO_LARGE:
            recorded[CUT_OFF] = len(values) - index
            break
        name = text_of(key)
        if len(name) > left:
            name = name[:MAX_NAME]
        reader = Values(listed=LISTED, most=MAX_EXTRA_BYTES // 2, longest=MAX_EXTRA_BYTES)
        converted = reader.keep(value)
        size = size_of(converted) + reader.left_out
        if size > left or reader.exhausted:
            too_large[name] = size
            converted = {"tooLarge": size}
        else:
            left -= size
        recorded[name] = converted
    return recorded, too_large


def is_too_large(info: Mapping[str, Any]) -> bool:
    """Whether an `info` has more than `MAX_EXTRA_BYTES` as JSON. A text or array that is too large is not converted."""
    reader = Values(most=MAX_EXTRA_BYTES // 2, longest=MAX_EXTRA_BYTES)
    converted = reader.keep(info)
    return reader.exhausted or size_of(converted) > MAX_EXTRA_BYTES


def size_of(converted: Any) -> int:
    """Return the bytes of a converted value as JSON."""
    return len(json.dumps(converted, separators=(",", ":")))


def read_observation(recorded: Any) -> Any:
    """Return the array that `observation` has converted."""
    data = zlib.decompress(base64.b64decode(recorded["zlib"]))
    return np.frombuffer(data, dtype=np.dtype(recorded["dtype"])).reshape(recorded["shape"])


OF_SEVERAL = ("pettingzoo", "onnxruntime")
"""Further packages whose versions a recording names if several players play."""


_PACKAGE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_MAX_PACKAGES = 100


@functools.cache
def packages(agent_dir: Path) -> tuple[str, ...]:
    """Return the packages that the project's requirements.txt names, such as the packages of its games."""
    names: dict[str, None] = {}
    with contextlib.suppress(OSError, UnicodeDecodeError):
        text = (agent_dir / "requirements.txt").read_text(encoding="utf-8-sig")
        matches = map(_PACKAGE.match, map(str.strip, text.splitlines()))
        names = dict.fromkeys(match[0] for match in matches if match)
    return tuple(names)[:_MAX_PACKAGES]


def versions(more: Iterable[str] = ()) -> dict[str, str]:
    """Return the versions of Python, this server, and the packages that may change how a game plays, if installed.

    `more` are the names of further packages.
    """
    return dict(_versions(tuple(more)))


@functools.cache
def _versions(more: tuple[str, ...]) -> Mapping[str, str]:
    installed = {"trial": VERSION, "python": platform.python_version()}
    for name in dict.fromkeys(("gymnasium", "ale-py", "numpy", "websockets", *more)):
        try:
            installed[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return installed


class Recording:
    """A recording's file that is being written. `add` collects lines; `flush` and `close` write them, on any thread.

    Raises OSError if the file cannot be created, FileExistsError if it exists.
    """

    def __init__(self, path: Path, key: str) -> None:
        """`path` is where it is written, `key` the document in the store that it becomes."""
        self.path = path
        self.key = key
        disk.make_folder(path.parent)
        self._file = path.open("xb", buffering=0)
        self._synced = time.monotonic()
        self._folder_synced = False  # until it is synced, a power cut may lose the file's name
        self._gzip = zlib.compressobj(6, zlib.DEFLATED, 31)
        self._lines: list[bytes] = []
        self._packed = b""
        self._finished = False
        self._lock = threading.Lock()
        self.closed = False

    @property
    def dirty(self) -> bool:
        """Whether there are lines to write."""
        return bool(self._lines or self._packed)

    def add(self, line: bytes) -> None:
        """Collect a line."""
        self._lines.append(line)

    def flush(self) -> None:
        """Write all lines to the file, from which they can be read even if the process is killed. Raises OSError.

        Every `SYNC_SECONDS` also sync the file to the disk, so that a power cut does not lose them.
        """
        with self._lock:
            self._write(zlib.Z_SYNC_FLUSH)
            if not self.closed and time.monotonic() >= self._synced + SYNC_SECONDS:
                self._sync()

    def close(self) -> None:
        """Write the last lines and the end of the gzip stream, and sync the file to the disk.

        Raises OSError; then it may be called again.
        """
        with self._lock:
            if self.closed:
                return
            self._write(zlib.Z_FINISH)
            self._sync()
            self._file.close()
            self.closed = True

    def _sync(self) -> None:
        os.fsync(self._file.fileno())
        if not self._folder_synced:
            disk.sync_folder(self.path.parent)
            self._folder_synced = True
        self._synced = time.monotonic()

    def _write(self, flush_mode: int) -> None:
        if self.closed:
            return
        lines, self._lines = self._lines, []
        if not self._finished and (lines or flush_mode == zlib.Z_FINISH):
            self._packed += self._gzip.compress(b"".join(lines)) + self._gzip.flush(flush_mode)
            self._finished = flush_mode == zlib.Z_FINISH
        while self._packed:  # the bytes stay there until they are written, so a full disk loses nothing
            self._packed = self._packed[self._file.write(self._packed) :]


def read(data: bytes) -> list[dict[str, Any]]:
    """Return the complete lines of a recording, even if its end is missing."""
    text = zlib.decompressobj(31).decompress(data)
    return [json.loads(part) for part in text.split(b"\n")[: text.count(b"\n")]]
