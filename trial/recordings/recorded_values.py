"""Values of the researcher's code as JSON can hold them: none of them raises, or takes for ever. Pure."""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

LISTED = 100
"""Numbers of an array that `extra` has as a list."""
MOST_VALUES = 2_000_000
"""Values that are read of one value. Objects that lead to each other in many ways would have no end."""
CUT_OFF = "<cut off>"
_DEPTH = 20
_TEXT = 1000  # characters of what has no other form than its text
_INT_BITS = 10_000  # Python writes no longer ones as text (sys.set_int_max_str_digits)
_PACKED_BYTES = 64  # an array is packed if it has not more bytes than so many times what may be kept


class Values:
    """Makes values plain. `listed`: arrays with more numbers are packed with their dtype and shape; None packs none.

    At most `most` values are read. Texts and bytes longer than `longest` are left out.
    """

    def __init__(self, *, listed: int | None = None, most: int = MOST_VALUES, longest: float = math.inf) -> None:
        self._listed = listed
        self._left = most
        self._longest = longest
        self._around: set[int] = set()  # the containers that the value is in
        self.left_out = 0
        """The size in bytes of what was too long."""

    @property
    def exhausted(self) -> bool:
        """There were more values, or longer ones, than are kept."""
        return self._left < 0 or self.left_out > 0

    def keep(self, value: Any, depth: int = 0) -> Any:
        """The value as JSON can hold it; its type in `<>` where it is nested too deep, or within itself, or raises."""
        try:
            return self._kept(value, depth)
        except Exception:  # noqa: BLE001 - the researcher's objects may raise anything, and the game goes on
            return f"<{type(value).__name__}>"

    def _kept(self, value: Any, depth: int) -> Any:
        if value is None or isinstance(value, bool):
            return value
        if isinstance(value, str | bytes):
            return self._text(value)
        if isinstance(value, int) and not isinstance(value, np.generic):
            bits = value.bit_length()
            return int(value) if bits <= _INT_BITS else f"<int of {bits} bits>"
        if isinstance(value, float):
            return float(value) if math.isfinite(value) else None
        if isinstance(value, Mapping | list | tuple | set | frozenset):
            return self._container(value, depth)
        if isinstance(value, np.generic | np.ndarray):
            return self._array(value)
        return text_of(value)

    def _text(self, value: str | bytes) -> str:
        if len(value) > self._longest:
            self.left_out += len(value)
            return ""
        return value if isinstance(value, str) else base64.b64encode(value).decode("ascii")

    def _container(self, value: Any, depth: int) -> Any:
        if depth >= _DEPTH or id(value) in self._around:
            return f"<{type(value).__name__}>"
        self._around.add(id(value))
        try:
            if isinstance(value, Mapping):
                return self._mapping(value, depth)
            return self._list(value, depth)
        finally:
            self._around.discard(id(value))

    def _mapping(self, value: Mapping[Any, Any], depth: int) -> dict[str, Any]:
        kept: dict[str, Any] = {}
        for key, item in value.items():
            self._left -= 1
            if self._left < 0:
                kept[CUT_OFF] = True
                break
            kept[text_of(key)] = self.keep(item, depth + 1)
        return kept

    def _list(self, value: Iterable[Any], depth: int) -> list[Any]:
        kept: list[Any] = []
        for item in value:
            self._left -= 1
            if self._left < 0:
                kept.append(CUT_OFF)
                break
            kept.append(self.keep(item, depth + 1))
        return kept

    def _array(self, value: Any) -> Any:
        if value.dtype.kind not in "biuf":
            return text_of(value)
        if self._listed is None and value.size > self._longest:  # each number has a byte or more
            self.left_out += value.nbytes
            return None
        if self._listed is None or not isinstance(value, np.ndarray) or value.size <= self._listed:
            return _numbers(value)
        if value.nbytes > self._longest * _PACKED_BYTES:
            self.left_out += value.nbytes
            return None
        array = np.ascontiguousarray(value)
        packed = base64.b64encode(zlib.compress(array.tobytes(), 1)).decode("ascii")
        return {"dtype": str(array.dtype), "shape": list(value.shape), "zlib": packed}


def text_of(value: Any) -> str:
    """A text as it is; another value's text, cut off, or its type if it has none."""
    if isinstance(value, str):
        return value
    try:
        return str(value)[:_TEXT]
    except Exception:  # noqa: BLE001 - the researcher's objects may raise anything
        return f"<{type(value).__name__}>"


def _numbers(value: Any) -> Any:
    """An array as lists, or a number; null where it is not finite."""
    if value.dtype.kind != "f":
        return value.tolist()
    if value.dtype.itemsize > np.dtype(float).itemsize:
        value = value.astype(float)
    finite = np.isfinite(value)
    if finite.all():
        return value.tolist()
    kept = np.array(value, dtype=object)
    kept[~finite] = None
    return kept.tolist()
