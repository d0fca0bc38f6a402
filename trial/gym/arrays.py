"""Writes and reads the messages of the subprotocol `hippodrome.gym.1`: a header and raw arrays (docs/gym.md). Pure.

An `ArrayLayout` is made once for each space. Values are sent in batches, which have Gymnasium's form
(`gymnasium.vector.utils.concatenate`): one array for all values of a Box, a dict of batches for a Dict. So a batch of
64 values takes one call of numpy for each part of the space, and not one for each value.
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from trial.gym import exact, values
from trial.gym.spaces import CodecError, Space

STEP, STEP_MANY, RESET = 1, 2, 3
"""Kinds of messages. A reply has the kind of its request."""

MAX_STEPS = 65_536
"""The most steps of one message."""

_REQUEST = struct.Struct("<BxHI")  # kind, handle, number of steps
_REPLY = struct.Struct("<BxHIII")  # kind, handle, rows, bytes of columns, bytes of infos
_LENGTH = struct.Struct("<I")
_DOUBLE = 8  # bytes of a reward

Infos = list[tuple[int, dict[str, Any]]]
"""Pairs of a step's number, from 0 on, and its info, for steps that have an info. A reset's info has the number 0."""


class ArrayRequest(NamedTuple):
    """A message of the client. `steps` is the number of steps that it asks for, 0 for RESET."""

    kind: int
    handle: int
    steps: int
    body: memoryview


class StepRows(NamedTuple):
    """The results of steps, with a row for each step. A vector has a row for each environment, the first step's first.

    `observations` is a batch. The other arrays have one axis. An info of a vector is as `VectorEnv.step` of Gymnasium
    returns it.
    """

    observations: Any
    rewards: np.ndarray[Any, np.dtype[np.float64]]
    terminated: np.ndarray[Any, np.dtype[np.bool_]]
    truncated: np.ndarray[Any, np.dtype[np.bool_]]
    infos: Infos


class ArrayLayout:
    """Writes and reads batches of values of one space."""

    def empty(self, count: int) -> Any:
        """Make a batch of `count` values, which `put` fills."""
        raise NotImplementedError

    def put(self, batch: Any, row: int, value: Any) -> None:
        """Set one value of a batch. Raises CodecError if the value lacks the space's shape or kind of numbers."""
        raise NotImplementedError

    def put_batch(self, batch: Any, row: int, part: Any, count: int) -> None:
        """Copy the `count` values of the batch `part` into a batch, from `row` on."""
        for at, value in enumerate(self.rows(part, count)):
            self.put(batch, row + at, value)

    def pack(self, batch: Any, count: int, into: list[bytes]) -> None:
        """Append the bytes of the first `count` values of a batch to `into`."""
        raise NotImplementedError

    def unpack(self, data: memoryview, at: int, count: int) -> tuple[Any, int]:
        """Read the batch of `count` values that begins at `at`. Return it and its end in `data`. Raises CodecError."""
        raise NotImplementedError

    def rows(self, batch: Any, count: int) -> Sequence[Any]:
        """Return the `count` values of a batch as a sequence."""
        raise NotImplementedError


def layout(space: Space, *, action: bool = False) -> ArrayLayout:
    """Make the layout of `space`. With `action`, `unpack` refuses the same actions as `values.decoder`.

    Raises CodecError for a class of space that Gymnasium does not have.
    """
    if isinstance(space, spaces.Discrete):
        return _Discrete(space, action)
    if isinstance(space, spaces.Box | spaces.MultiBinary | spaces.MultiDiscrete):
        return _Numbers(space, action)
    if isinstance(space, spaces.Dict):
        return _Dict({key: layout(part, action=action) for key, part in space.spaces.items()})
    if isinstance(space, spaces.Tuple):
        return _Tuple([layout(part, action=action) for part in space.spaces])
    return _Json(values.decoder(space, action=action))


class _Numbers(ArrayLayout):
    def __init__(self, space: Any, action: bool) -> None:
        self._space = space
        self._action = action
        self._dtype = space.dtype
        self._wire = space.dtype.newbyteorder("<")
        self._shape = space.shape
        self._elements = int(np.prod(space.shape, dtype=np.int64))

    def empty(self, count: int) -> Any:
        return np.zeros((count, *self._shape), self._dtype)

    def put(self, batch: Any, row: int, value: Any) -> None:
        if type(value) is not np.ndarray or value.dtype is not self._dtype:
            value = self._converted(value)
        if value.shape != self._shape:
            raise CodecError(f"A value of shape {value.shape} is not in {self._space}.")
        batch[row] = value

    def _converted(self, value: Any) -> Any:
        try:
            array = np.asarray(value)
        except ValueError:
            raise CodecError(f"Lists of different lengths are not in {self._space}.") from None
        if array.dtype.kind not in "biuf" or (self._dtype.kind != "f" and array.dtype.kind == "f"):
            raise CodecError(f"A value of {array.dtype} is not in {self._space}.")
        if self._dtype.kind == "f":
            with np.errstate(over="ignore"):
                return array.astype(self._dtype)
        converted = array.astype(self._dtype)
        if not np.array_equal(converted, array):
            raise CodecError(f"A number of the value does not fit into {self._dtype}.")
        return converted

    def put_batch(self, batch: Any, row: int, part: Any, count: int) -> None:
        if type(part) is not np.ndarray or part.dtype != self._dtype or part.shape != (count, *self._shape):
            raise CodecError(f"These are not {count} values of {self._space}.")
        batch[row : row + count] = part

    def pack(self, batch: Any, count: int, into: list[bytes]) -> None:
        into.append(batch[:count].astype(self._wire, copy=False).tobytes())

    def unpack(self, data: memoryview, at: int, count: int) -> tuple[Any, int]:
        end = at + count * self._elements * self._wire.itemsize
        if end > len(data):
            raise CodecError("The message is too short for its values.")
        if self._dtype.kind == "b" and max(data[at:end], default=0) > 1:
            raise CodecError("True and false are sent as 1 and 0.")
        # A copy, since environments and agents may write into what they are given.
        batch = np.frombuffer(data, self._wire, count * self._elements, at).astype(self._dtype)
        batch = batch.reshape((count, *self._shape))
        if self._action:
            values.check_action(self._space, batch)
        return batch, end

    def rows(self, batch: Any, count: int) -> Sequence[Any]:
        return list(batch) if self._shape else [batch[row, ...] for row in range(count)]


class _Discrete(_Numbers):
    def put(self, batch: Any, row: int, value: Any) -> None:
        if type(value) is not int and type(value) is not self._dtype.type:
            value = self._converted(value)
            if value.shape != ():
                raise CodecError(f"A value of shape {value.shape} is not in {self._space}.")
        try:
            batch[row] = value
        except OverflowError:
            raise CodecError(f"A number of the value does not fit into {self._dtype}.") from None

    def rows(self, batch: Any, count: int) -> Sequence[Any]:
        return list(batch)


class _Json(ArrayLayout):
    """Writes values whose size varies as one column in JSON: the text's length, then the text of a list (`values`)."""

    def __init__(self, decode: values.Decode) -> None:
        self._decode = decode

    def empty(self, count: int) -> Any:
        return [None] * count

    def put(self, batch: Any, row: int, value: Any) -> None:
        batch[row] = value

    def pack(self, batch: Any, count: int, into: list[bytes]) -> None:
        text = values.to_text(list(batch[:count])).encode()
        into += (_LENGTH.pack(len(text)), text)

    def unpack(self, data: memoryview, at: int, count: int) -> tuple[Any, int]:
        start = at + _LENGTH.size
        if start > len(data):
            raise CodecError("The message is too short for its values.")
        end = start + _LENGTH.unpack_from(data, at)[0]
        if end > len(data):
            raise CodecError("The message is too short for its values.")
        parsed = values.from_text(bytes(data[start:end]))
        if not isinstance(parsed, list) or len(parsed) != count:
            raise CodecError(f"A list of {count} values is needed.")
        return tuple(self._decode(value) for value in parsed), end

    def rows(self, batch: Any, count: int) -> Sequence[Any]:
        return list(batch)


class _Dict(ArrayLayout):
    def __init__(self, parts: dict[str, ArrayLayout]) -> None:
        self._parts = parts

    def empty(self, count: int) -> Any:
        return {key: part.empty(count) for key, part in self._parts.items()}

    def put(self, batch: Any, row: int, value: Any) -> None:
        if not isinstance(value, dict) or value.keys() != self._parts.keys():
            raise CodecError(f"An object with {', '.join(self._parts) or 'no keys'} is needed.")
        for key, part in self._parts.items():
            part.put(batch[key], row, value[key])

    def put_batch(self, batch: Any, row: int, part: Any, count: int) -> None:
        for key, layout in self._parts.items():
            layout.put_batch(batch[key], row, part[key], count)

    def pack(self, batch: Any, count: int, into: list[bytes]) -> None:
        for key, part in self._parts.items():
            part.pack(batch[key], count, into)

    def unpack(self, data: memoryview, at: int, count: int) -> tuple[Any, int]:
        batch = {}
        for key, part in self._parts.items():
            batch[key], at = part.unpack(data, at, count)
        return batch, at

    def rows(self, batch: Any, count: int) -> Sequence[Any]:
        columns = [part.rows(batch[key], count) for key, part in self._parts.items()]
        return [{key: column[row] for key, column in zip(self._parts, columns, strict=True)} for row in range(count)]


class _Tuple(ArrayLayout):
    def __init__(self, parts: list[ArrayLayout]) -> None:
        self._parts = parts

    def empty(self, count: int) -> Any:
        return tuple(part.empty(count) for part in self._parts)

    def put(self, batch: Any, row: int, value: Any) -> None:
        if not isinstance(value, tuple | list) or len(value) != len(self._parts):
            raise CodecError(f"A list of {len(self._parts)} values is needed.")
        for column, part, one in zip(batch, self._parts, value, strict=True):
            part.put(column, row, one)

    def put_batch(self, batch: Any, row: int, part: Any, count: int) -> None:
        for column, layout, one in zip(batch, self._parts, part, strict=True):
            layout.put_batch(column, row, one, count)

    def pack(self, batch: Any, count: int, into: list[bytes]) -> None:
        for column, part in zip(batch, self._parts, strict=True):
            part.pack(column, count, into)

    def unpack(self, data: memoryview, at: int, count: int) -> tuple[Any, int]:
        batch = []
        for part in self._parts:
            column, at = part.unpack(data, at, count)
            batch.append(column)
        return tuple(batch), at

    def rows(self, batch: Any, count: int) -> Sequence[Any]:
        columns = [part.rows(column, count) for part, column in zip(self._parts, batch, strict=True)]
        return [tuple(column[row] for column in columns) for row in range(count)]


def batch_of(layout: ArrayLayout, rows: Sequence[Any]) -> Any:
    """Make one batch of the values `rows`. Raises CodecError if one lacks the space's shape or kind of numbers."""
    batch = layout.empty(len(rows))
    for row, value in enumerate(rows):
        layout.put(batch, row, value)
    return batch


def step_request(kind: int, handle: int, steps: int, actions: ArrayLayout, batch: Any, *, num_envs: int = 1) -> bytes:
    """Build the request STEP or STEP_MANY, with a batch of actions of an environment or a vector."""
    parts: list[bytes] = [_REQUEST.pack(kind, handle, steps)]
    actions.pack(batch, steps * num_envs, parts)
    return b"".join(parts)


def reset_request(handle: int, seed: Any, options: Any) -> bytes:
    """Build the request RESET. `seed` is None, a number, or for a vector a list; `options` is a dict or None."""
    return _REQUEST.pack(RESET, handle, 0) + exact.to_text({"seed": seed, "options": options}).encode()


def read_request(data: bytes) -> ArrayRequest:
    """Read the header of a client's message. Raises CodecError."""
    if len(data) < _REQUEST.size:
        raise CodecError("The message is too short for its header.")
    kind, handle, count = _REQUEST.unpack_from(data)
    if kind not in (STEP, STEP_MANY, RESET):
        raise CodecError(f"There is no message of kind {kind}.")
    if (kind == STEP and count != 1) or (kind == STEP_MANY and not 0 < count <= MAX_STEPS):
        raise CodecError(f"A message asks for one step, or by STEP_MANY for 1 to {MAX_STEPS}, not for {count}.")
    return ArrayRequest(kind, handle, count, memoryview(data)[_REQUEST.size :])


def read_actions(request: ArrayRequest, actions: ArrayLayout, num_envs: int = 1) -> Any:
    """Read the batch of actions of a STEP or STEP_MANY, of `steps * num_envs` rows. Raises CodecError."""
    return _whole(actions, request.body, request.steps * num_envs)


def refused(request: ArrayRequest, space: Space, num_envs: int = 1) -> Any:
    """Return the first action for which `read_actions` refuses a request; the body's size if no action can be read."""
    unchecked, checked = layout(space), layout(space, action=True)
    count = request.steps * num_envs
    with contextlib.suppress(CodecError):
        for row in unchecked.rows(_whole(unchecked, request.body, count), count):
            parts: list[bytes] = []
            unchecked.pack(batch_of(unchecked, [row]), 1, parts)
            try:
                _whole(checked, memoryview(b"".join(parts)), 1)
            except CodecError:
                return row
    return f"{len(request.body)} bytes"


def read_reset(request: ArrayRequest) -> tuple[Any, dict[str, Any] | None]:
    """Read the seed and the options of a RESET. Raises CodecError."""
    parsed = exact.from_text(bytes(request.body)) if len(request.body) else {}
    if not isinstance(parsed, dict) or not parsed.keys() <= {"seed", "options"}:
        raise CodecError("A reset has a seed and options, and nothing else.")
    seed, options = parsed.get("seed"), parsed.get("options")
    if not all(one is None or (type(one) is int and one >= 0) for one in (seed if isinstance(seed, list) else [seed])):
        raise CodecError("A seed is a whole number from 0 on.")
    if options is not None and not isinstance(options, dict):
        raise CodecError("The options of a reset are an object.")
    return seed, options


def steps_reply(kind: int, handle: int, observations: ArrayLayout, steps: StepRows) -> bytes:
    """Build the answer to STEP or STEP_MANY."""
    rows = len(steps.rewards)
    columns: list[bytes] = [np.asarray(steps.rewards, "<f8").tobytes()]
    observations.pack(steps.observations, rows, columns)
    columns += (np.asarray(steps.terminated, np.uint8).tobytes(), np.asarray(steps.truncated, np.uint8).tobytes())
    return _reply(kind, handle, rows, columns, steps.infos)


def reset_reply(handle: int, observations: ArrayLayout, rows: int, batch: Any, infos: Infos) -> bytes:
    """Build the answer to RESET, with a row for each environment."""
    columns: list[bytes] = []
    observations.pack(batch, rows, columns)
    return _reply(RESET, handle, rows, columns, infos)


def _reply(kind: int, handle: int, rows: int, columns: list[bytes], infos: Infos) -> bytes:
    length = sum(map(len, columns))
    pairs = [[step, info] for step, info in infos if info]
    text = exact.to_text(pairs).encode() if pairs else b""
    return b"".join((_REPLY.pack(kind, handle, rows, length, len(text)), *columns, text))


def check_reply(data: bytes, kind: int, handle: int, steps: int, num_envs: int = 1) -> None:
    """Raise CodecError if `data` does not answer a request of this kind for `steps` steps.

    The answer to STEP_MANY may have fewer steps: without autoreset they end with the episode.
    """
    if len(data) < _REPLY.size:
        raise CodecError("The message is too short for its header.")
    reply_kind, reply_handle, rows, *_ = _REPLY.unpack_from(data)
    fits = rows <= steps * num_envs and rows % num_envs == 0 if kind == STEP_MANY else rows == num_envs
    if (reply_kind, reply_handle) != (kind, handle) or not fits:
        raise CodecError(f"It has {rows} rows for {steps} steps, or answers something else.")


def read_steps(data: bytes, observations: ArrayLayout) -> StepRows:
    """Read the answer to STEP or STEP_MANY. Raises CodecError."""
    kind, rows, columns, infos = _opened(data)
    if kind not in (STEP, STEP_MANY):
        raise CodecError("The server has answered something else than a step.")
    fixed = rows * (_DOUBLE + 2)
    if len(columns) < fixed:
        raise CodecError("The message is too short for its values.")
    first, last = rows * _DOUBLE, len(columns) - 2 * rows
    rewards = np.frombuffer(columns, "<f8", rows).astype(np.float64)
    terminated, truncated = (_flags(columns, last + at * rows, rows) for at in (0, 1))
    return StepRows(_whole(observations, columns[first:last], rows), rewards, terminated, truncated, infos)


def read_reset_reply(data: bytes, observations: ArrayLayout) -> tuple[Any, Infos]:
    """Read the answer to RESET: the batch of observations, and the infos. Raises CodecError."""
    kind, rows, columns, infos = _opened(data)
    if kind != RESET:
        raise CodecError("The server has answered something else than a reset.")
    return _whole(observations, columns, rows), infos


def _opened(data: bytes) -> tuple[int, int, memoryview, Infos]:
    """Read a reply: return its kind, the number of its rows, its columns and its infos. Raises CodecError."""
    if len(data) < _REPLY.size:
        raise CodecError("The message is too short for its header.")
    kind, _, rows, length, after = _REPLY.unpack_from(data)
    if len(data) != _REPLY.size + length + after:
        raise CodecError("The message is not as long as its header says.")
    end = _REPLY.size + length
    infos: Infos = []
    if after:
        parsed = exact.from_text(bytes(data[end:]))
        if not isinstance(parsed, list) or not all(_is_info(one, rows) for one in parsed):
            raise CodecError("The infos are no list of steps and objects.")
        infos = [(step, info) for step, info in parsed]
    return kind, rows, memoryview(data)[_REPLY.size : end], infos


def _is_info(one: Any, rows: int) -> bool:
    return (
        isinstance(one, list)
        and len(one) == 2
        and type(one[0]) is int
        and 0 <= one[0] < rows
        and isinstance(one[1], dict)
    )


def _flags(columns: memoryview, at: int, rows: int) -> np.ndarray[Any, np.dtype[np.bool_]]:
    return np.frombuffer(columns, np.uint8, rows, at).astype(np.bool_)


def _whole(layout: ArrayLayout, data: memoryview, rows: int) -> Any:
    """Read `data` as a batch of `rows` values. Raises CodecError if `data` is longer."""
    batch, end = layout.unpack(data, 0, rows)
    if end != len(data):
        raise CodecError("The message is longer than its values.")
    return batch
