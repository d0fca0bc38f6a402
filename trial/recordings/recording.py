"""Recordings: gzip of JSON lines, one line per step, readable to the last flush whatever happens to the process.

Kinds of lines: `header` (first of each file), `reset` (an episode begins), `resume` (it goes on after a lost server's
steps), `step`, `callback` (what a callback of the agent recorded), `error` (the researcher's code raised), `end` (an
episode or the file ends) and `break` (the break after it ends). Nothing is pickled.

A `step` tells the choice of its action: `human` is the index of the action that the participant's keys asked for (null
if no key acted); `action` and `actionName` are the one that was taken; `by` is its origin: `agent` (the agent reports
it as its own, even if it is the human's), or one of `trial.core.actions.By`. Times are UTC:
2026-11-21T14:46:40.123456Z. docs/data.md says what else the lines hold, also where several players play.
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

from protocol import disk
from protocol.times import time_text
from trial.recordings.recorded_values import CUT_OFF, LISTED, Values, text_of

SCHEMA = 1
VERSION = "1.0"
"""Of the trial server; in the head of each recording."""
SYNC_SECONDS = 5.0
"""An open recording is synced to the disk this often: a power cut takes no more of it."""
MAX_EXTRA_BYTES = 1_000_000
"""Of what an agent's `step` returns beside Gymnasium's values, as JSON, in one line."""
MOST_TOO_LARGE = 100
"""Values of one line that are replaced by their sizes; those after them are left out."""
LONGEST_NAME = 1_000
"""Characters of the name of such a value, if it is too large itself."""


def line(kind: str, /, **fields: Any) -> bytes:
    """One line of a recording; values that are not JSON are made so. `time` may be a moment in UTC."""
    record = {"kind": kind, **fields}
    if isinstance(fields.get("time"), datetime):
        record["time"] = time_text(fields["time"])
    try:
        text = _JSON.encode(record)
    except Exception:  # noqa: BLE001 - NaN, keys that are no text, circles, what raises: rare, so not looked for first
        text = _JSON.encode(plain(record))
    return text.encode() + b"\n"


class LaterLine:
    """A line whose text is made when it is written. Nothing may change its values until then.

    Made together, the lines of half a second find everything in the processor's cache: a tick of two participants takes
    3 % less than with each line made in its step.
    """

    __slots__ = ("_fields", "_kind")

    def __init__(self, kind: str, fields: Mapping[str, Any]) -> None:
        self._kind = kind
        self._fields = fields

    def text(self) -> bytes:
        """The line."""
        return line(self._kind, **self._fields)


Line = bytes | LaterLine


def text_of_line(one: Line) -> bytes:
    """The line itself."""
    return one if isinstance(one, bytes) else one.text()


def plain(value: Any) -> Any:
    """The value as JSON can hold it: numpy as numbers and lists, NaN as null, what is left by its text."""
    return Values().keep(value)


_JSON = json.JSONEncoder(default=plain, separators=(",", ":"), allow_nan=False)


def observation(value: Any) -> Any:
    """An observation as a recording keeps it: arrays as base64 of zlib of their bytes, with dtype and shape."""
    return Values(listed=-1).keep(value)


def bounded_extra(values: Mapping[str, Any], left: int = MAX_EXTRA_BYTES) -> tuple[dict[str, Any], dict[str, int]]:
    """What an agent's `step` returned beside Gymnasium's values, as a recording keeps it, and what is too large.

    A value that does not fit into `left` bytes together with those before it is replaced by
    `{"tooLarge": bytes}`. The second result says which, and how large they are at least. After `MOST_TOO_LARGE` such
    values the rest is left out, and `"<cut off>"` is how many these are.
    """
    kept: dict[str, Any] = {}
    too_large: dict[str, int] = {}
    for index, (key, value) in enumerate(values.items()):
        if len(too_large) == MOST_TOO_LARGE:
            kept[CUT_OFF] = len(values) - index
            break
        name = text_of(key)
        if len(name) > left:
            name = name[:LONGEST_NAME]
        reader = Values(listed=LISTED, most=MAX_EXTRA_BYTES // 2, longest=MAX_EXTRA_BYTES)
        fit = reader.keep(value)
        size = size_of(fit) + reader.left_out
        if size > left or reader.exhausted:
            too_large[name] = size
            fit = {"tooLarge": size}
        else:
            left -= size
        kept[name] = fit
    return kept, too_large


def is_settled(info: Any) -> bool:
    """Whether an `info` holds a few small values that nothing can change."""
    return type(info) is dict and len(info) <= _FEW and all(map(_is_short, info)) and all(map(_is_short, info.values()))


def _is_short(value: Any) -> bool:
    kind = type(value)
    if kind is str:
        return len(value) <= _SHORT
    return kind in _FIXED or (kind is int and -_LARGEST <= value <= _LARGEST)


_FEW, _SHORT, _LARGEST = 100, 1_000, 2**63
_FIXED = frozenset({float, bool, type(None)})


def is_too_large(info: Mapping[str, Any]) -> bool:
    """Whether an `info` has more than `MAX_EXTRA_BYTES` as JSON. A value that is too large alone is not read."""
    reader = Values(most=MAX_EXTRA_BYTES // 2, longest=MAX_EXTRA_BYTES)
    kept = reader.keep(info)
    return reader.exhausted or size_of(kept) > MAX_EXTRA_BYTES


def size_of(kept: Any) -> int:
    """Bytes of a value that is plain already, as JSON."""
    return len(json.dumps(kept, separators=(",", ":")))


def read_observation(kept: Any) -> Any:
    """Undo `observation` for one array."""
    pixels = zlib.decompress(base64.b64decode(kept["zlib"]))
    return np.frombuffer(pixels, dtype=np.dtype(kept["dtype"])).reshape(kept["shape"])


OF_SEVERAL = ("pettingzoo", "onnxruntime")
"""Packages that may change how a game of several players plays."""


REQUIRED = Path(__file__).resolve().parents[2] / "requirements/project.txt"
"""In the servers' image, the lines of the project's requirements.txt."""
_PACKAGE = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]*")
_MOST_PACKAGES = 100


@functools.cache
def packages(agent_dir: Path) -> tuple[str, ...]:
    """The packages that the project's requirements.txt names: its games are among them."""
    names: dict[str, None] = {}
    for file in (agent_dir / "requirements.txt", REQUIRED):
        with contextlib.suppress(OSError, UnicodeDecodeError):
            found = map(_PACKAGE.match, map(str.strip, file.read_text(encoding="utf-8-sig").splitlines()))
            names |= dict.fromkeys(each[0] for each in found if each)
    return tuple(names)[:_MOST_PACKAGES]


def versions(more: Iterable[str] = ()) -> dict[str, str]:
    """Versions of what may change how a game plays; of these packages, too, as far as they are installed."""
    return dict(_versions(tuple(more)))


@functools.cache
def _versions(more: tuple[str, ...]) -> Mapping[str, str]:
    found = {"trial": VERSION, "python": platform.python_version()}
    for name in dict.fromkeys(("gymnasium", "ale-py", "numpy", "websockets", *more)):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found


class Recording:
    """One file being written. `add` only remembers; `flush` writes, and may be called from another thread."""

    def __init__(self, path: Path, key: str) -> None:
        self.path = path
        self.key = key
        """Where the finished file belongs in the store."""
        disk.make_folder(path.parent)
        self._file = path.open("xb", buffering=0)
        self._synced = time.monotonic()
        self._named = False  # whether the file's name is on the disk
        self._gzip = zlib.compressobj(6, zlib.DEFLATED, 31)
        self._lines: list[Line] = []
        self._packed = b""
        self._finished = False
        self._lock = threading.Lock()
        self.closed = False

    @property
    def dirty(self) -> bool:
        """There is something that `flush` would write."""
        return bool(self._lines or self._packed)

    def add(self, one: Line) -> None:
        """Remember one line."""
        self._lines.append(one)

    def flush(self) -> None:
        """Bring all lines to the file, so that they can be read even if the process is killed. Raises OSError.

        Every few seconds (`SYNC_SECONDS`) they are also brought to the disk, where a power cut does not harm them.
        """
        with self._lock:
            self._write(zlib.Z_SYNC_FLUSH)
            if not self.closed and time.monotonic() >= self._synced + SYNC_SECONDS:
                self._sync()

    def close(self) -> None:
        """Write what is left and the end of the gzip stream, all of it to the disk.

        Raises OSError; may then be called again.
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
        if not self._named:
            disk.sync_folder(self.path.parent)
            self._named = True
        self._synced = time.monotonic()

    def _write(self, how: int) -> None:
        if self.closed:
            return
        lines, self._lines = self._lines, []
        if not self._finished and (lines or how == zlib.Z_FINISH):
            self._packed += self._gzip.compress(b"".join(map(text_of_line, lines))) + self._gzip.flush(how)
            self._finished = how == zlib.Z_FINISH
        while self._packed:  # kept until it is written, so that a full disk loses nothing
            self._packed = self._packed[self._file.write(self._packed) :]


def read(data: bytes) -> list[dict[str, Any]]:
    """The lines of a recording, also of one cut off in the middle."""
    text = zlib.decompressobj(31).decompress(data)
    return [json.loads(part) for part in text.split(b"\n")[: text.count(b"\n")]]
