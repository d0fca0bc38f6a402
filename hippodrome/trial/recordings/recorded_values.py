"""Converts values of the researcher's code for JSON, without raising an error and in bounded time. Pure."""

from __future__ import annotations

import base64
import math
import sys
import zlib
from collections.abc import Iterable, Mapping, Sequence, Set, ValuesView
from enum import Enum
from typing import Any

import numpy as np

LISTED = 100
"""The most numbers of an array that the field `extra` has as a list. Larger arrays are packed."""
MAX_VALUES = 2_000_000
"""The most values that are converted in one value. Containers that hold one another may have an immense number."""
CUT_OFF = "<cut off>"
"""The text in a container that stands for the values that were left out."""
_NUMBERS = "biuf"  # NumPy's kinds of booleans and real numbers
_ARRAYS = ("__array__", "__array_interface__", "__dlpack__")  # what arrays of other packages have
_ADDRESS = " at 0x"  # in the text of an object whose class describes none
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
        self.only_text: str | None = None
        """The type of the first object of which only a text was kept that may not say all of its value."""

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
        if isinstance(value, Enum):
            return self.keep(value.value, depth)
        if isinstance(value, int):
            bits = value.bit_length()
            return int(value) if bits <= _INT_BITS else f"<int of {bits} bits>"
        if isinstance(value, float):
            return float(value) if math.isfinite(value) else None
        if isinstance(value, np.generic | np.ndarray):
            return self._array(value, depth)
        return self._object(value, depth)

    def _object(self, value: Any, depth: int) -> Any:
        try:
            simple = simpler(value)
        except Exception:  # noqa: BLE001 - as in `keep`; its text may still say what it is
            simple = None
        if simple is None:
            return self._described(value)
        if isinstance(simple, np.ndarray | bytes):
            return self._converted(simple, depth)
        return self._container(value, simple, depth)

    def _described(self, value: Any) -> str:
        text = text_of(value)
        module = type(value).__module__.partition(".")[0]
        if module not in sys.stdlib_module_names or _ADDRESS in text:
            self.only_text = self.only_text or type(value).__name__
        return text

    def _text(self, value: str | bytes) -> str:
        if len(value) > self._longest:
            self.left_out += len(value)
            return ""
        return value if isinstance(value, str) else base64.b64encode(value).decode("ascii")

    def _container(self, value: Any, simple: Mapping[Any, Any] | Iterable[Any], depth: int) -> Any:
        """`simple` holds what the container `value` holds."""
        if depth >= _DEPTH or id(value) in self._around:
            return f"<{type(value).__name__}>"
        self._around.add(id(value))
        try:
            return self._mapping(simple, depth) if isinstance(simple, Mapping) else self._list(simple, depth)
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

    def _array(self, value: Any, depth: int) -> Any:
        if value.size > self._longest and (self._listed is None or value.dtype.kind not in _NUMBERS):
            self.left_out += value.nbytes  # too large even if each element has one byte
            return None
        simple = simpler(value)
        if not isinstance(simple, np.generic | np.ndarray) or simple.dtype.kind not in _NUMBERS:
            return self.keep(simple, depth + 1)
        if self._listed is None or not isinstance(simple, np.ndarray) or simple.size <= self._listed:
            return _numbers(simple)
        if simple.nbytes > self._longest * _PACKED_BYTES:
            self.left_out += simple.nbytes
            return None
        array = np.ascontiguousarray(simple)
        packed = base64.b64encode(zlib.compress(array.tobytes(), 1)).decode("ascii")
        return {"dtype": str(array.dtype), "shape": list(simple.shape), "zlib": packed}


def simpler(value: Any) -> Any:
    """Return what an object holds as a type that is nearer to JSON's; None if it is of no kind that holds values.

    Another package's array becomes NumPy's. NumPy's numbers, and arrays of numbers, stay, in this machine's byte order;
    other arrays become lists, or a mapping of their named fields. Everything else becomes a mapping, an iterable or
    bytes. May raise any error of the object.
    """
    if isinstance(value, np.generic | np.ndarray):
        return _simpler_array(value)
    if isinstance(value, Mapping):
        return value
    if isinstance(value, bytearray | memoryview):
        return bytes(value)
    if isinstance(value, Sequence | Set | ValuesView):
        return value
    if isinstance(value, type):
        return None
    if any(hasattr(value, name) for name in _ARRAYS):
        return _as_array(value)
    fields = getattr(value, "__dataclass_fields__", None) or [a.name for a in getattr(value, "__attrs_attrs__", ())]
    return {name: getattr(value, name) for name in fields} if fields else None


def _simpler_array(value: Any) -> Any:
    if isinstance(value, np.ma.MaskedArray):
        return value.tolist() if np.ma.is_masked(value) else _simpler_array(value.data)
    kind = value.dtype.kind
    if value.dtype.names:
        return {name: value[name] for name in value.dtype.names}
    if kind == "V" and not issubclass(value.dtype.type, np.void):  # numbers of another package, such as bfloat16
        return value.astype(np.float32)
    if kind == "c":
        return value.astype(complex).tolist()
    if kind in "Mm":
        return value.astype(str).tolist()
    if kind not in _NUMBERS:
        return value.tolist()
    if kind == "f" and value.dtype.itemsize > np.dtype(float).itemsize:
        return value.astype(float)
    return value if value.dtype.isnative else value.astype(value.dtype.newbyteorder("="))


def _as_array(value: Any) -> Any:
    """Return the array of another package's array, such as JAX's or a tensor."""
    try:
        return np.from_dlpack(value) if not hasattr(value, "__array__") else np.asarray(value)
    except Exception:
        if not hasattr(value, "tolist"):
            raise
        return np.asarray(value.tolist())  # a tensor with gradients, or on a GPU


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
    finite = np.isfinite(value)
    if finite.all():
        return value.tolist()
    numbers = np.array(value, dtype=object)
    numbers[~finite] = None
    return numbers.tolist()
