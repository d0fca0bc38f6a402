"""Converts values of the researcher's code for JSON, without raising an error and in bounded time. Pure."""

from __future__ import annotations

import base64
import math
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

LISTED = 100
"""The most numbers of an array that the field `extra` has as a list. Larger arrays are packed."""
MAX_VALUES = 2_000_000
"""The most values that are converted in one value. Containers that hold one another may have an immense number."""
CUT_OFF = "<cut off>"
"""The text in a container that stands for the values that were left out."""
_DEPTH = 20  # the most levels of nesting
_TEXT = 1000  # the most characters of an object that is converted to its text
_INT_BITS = 10_000  # Python converts no longer integers to text (sys.set_int_max_str_digits)
_PACKED_BYTES = 64  # arrays up to this multiple of `longest` are packed, since their bytes may be compressible


class Values:
    """Converts values for JSON. Packs arrays with more than `listed` numbers, with dtype and shape; None: packs none.

    At most `most` values are converted. Texts and bytes that are longer than `longest` are left out.
    """

    def __init__(self, *, listed: int | None = None, most: int = MAX_VALUES, longest: float = math.inf) -> None:
        self._listed = listed
        self._left = most
        self._longest = longest
        self._around: set[int] = set()  # the ids of the containers around the present value
        self.left_out = 0
        """The bytes of the texts and arrays that were too long."""

    @property
    def exhausted(self) -> bool:
        """Whether values were left out, because there are too many or they are too long."""
        return self._left < 0 or self.left_out > 0

    def keep(self, value: Any, depth: int = 0) -> Any:
        """Convert a value. One that is nested too deep, contains itself or raises an error becomes its type in `<>`."""
        try:
            return self._converted(value, depth)
        except Exception:  # noqa: BLE001 - the researcher's objects may raise anything, and the game goes on
            return f"<{type(value).__name__}>"

    def _converted(self, value: Any, depth: int) -> Any:
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
        converted: dict[str, Any] = {}
        for key, item in value.items():
            self._left -= 1
            if self._left < 0:
                converted[CUT_OFF] = True
                break
            converted[text_of(key)] = self.keep(item, depth + 1)
        return converted

    def _list(self, value: Iterable[Any], depth: int) -> list[Any]:
        converted: list[Any] = []
        for item in value:
            self._left -= 1
            if self._left < 0:
                converted.append(CUT_OFF)
                break
            converted.append(self.keep(item, depth + 1))
        return converted

    def _array(self, value: Any) -> Any:
        if value.dtype.kind not in "biuf":
            return text_of(value)
        if self._listed is None and value.size > self._longest:  # too large even if each number has one byte
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
    """Return a text unchanged; of another value its text, `_TEXT` characters at most, or its type if it has none."""
    if isinstance(value, str):
        return value
    try:
        return str(value)[:_TEXT]
    except Exception:  # noqa: BLE001 - the researcher's objects may raise anything
        return f"<{type(value).__name__}>"


def _numbers(value: Any) -> Any:
    """Convert an array to lists, or a NumPy number to a number, with None for NaN and infinities."""
    if value.dtype.kind != "f":
        return value.tolist()
    if value.dtype.itemsize > np.dtype(float).itemsize:
        value = value.astype(float)
    finite = np.isfinite(value)
    if finite.all():
        return value.tolist()
    numbers = np.array(value, dtype=object)
    numbers[~finite] = None
    return numbers.tolist()
