"""Runs policies that are ONNX files, by onnxruntime on one thread of the CPU.

An input takes the part of the observation that has its name; the first other input takes the whole observation, and
each further one is a recurrent state. RLlib's `seq_lens` and sb3-contrib's `episode_starts` are constants. An older
RLlib calls the second state `seq_lens`: it has two axes, and the real one has one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
from gymnasium import spaces

from hippodrome.protocol.players import ONNXRUNTIME
from hippodrome.trial.core.players import ACTION_MASK, Mask, legal_actions
from hippodrome.trial.core.policies import Observed
from hippodrome.trial.policies.policy import PolicyError, choose_again

Array = np.ndarray[Any, np.dtype[Any]]
Shape = Sequence[int | str | None]
"""The shape of an input. A text or None stands for a size that the file leaves open."""

_CONSTANT = {"seq_lens": 1, "episode_starts": 0}
"""The inputs with a constant value, each with its value for one observation at a time."""
_TYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(int64)": np.int64, "tensor(int32)": np.int32,
    "tensor(uint8)": np.uint8, "tensor(bool)": np.bool_,
}  # fmt: skip
_INSTEAD = "write a class with act() in agent.py that runs the file"


@dataclass(frozen=True, slots=True)
class _Port:
    """An input of a file."""

    name: str
    dtype: type[np.generic]
    shape: Shape

    def filled(self, value: int) -> Array:
        return np.full([size if isinstance(size, int) else 1 for size in self.shape], value, self.dtype)


@dataclass(frozen=True, slots=True)
class _Ports:
    """The inputs and outputs of a file by their purpose."""

    parts: tuple[_Port, ...]
    """The inputs that take parts of the observation, by their names."""
    whole: _Port | None
    """The input that takes the whole observation, without its mask."""
    constants: Mapping[str, Array]
    states: Mapping[str, _Port]
    """The recurrent states: by the name of an output, the input that gets its value at the next call."""
    action: str
    """The name of the output with the values of all actions, or with the number of the chosen action."""


class OnnxPolicy:
    """Takes the action with the highest value; with `sample`, a random action by the softmax of the values."""

    def __init__(self, spec: str, session: Any, count: int, space: Any, *, sha256: str, sample: bool) -> None:
        self._spec, self._session, self._count, self._space = spec, session, count, space
        self._sha256, self._sample = sha256, sample
        self._random = Random(0)  # noqa: S311 - a game
        self._ports: _Ports | None = None  # until there is an observation
        self._state: dict[str, Array] = {}

    def act(self, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> int:
        """Choose an action, and return its number. Raises PolicyError if the observation or the output does not fit."""
        if self._ports is None:
            self._ports = _read(self._spec, self._session, observation)
        ports = self._ports
        inputs = {**ports.constants, **{port.name: port.filled(0) for port in ports.states.values()}, **self._state}
        whole, space = without_mask(observation), space_without_mask(self._space)
        for port in ports.parts:
            part_space = getattr(self._space, "spaces", {}).get(port.name)
            inputs[port.name] = self._fitted(observation[port.name], part_space, port)
        if ports.whole is not None:
            inputs[ports.whole.name] = self._fitted(whole, space, ports.whole)
        try:
            values, *states = self._session.run([ports.action, *ports.states], inputs)
        except Exception as error:
            raise PolicyError(f"{self._spec} fails: {_short(error)}") from error
        action = self._chosen(np.asarray(values), mask)
        self._state = {port.name: state for port, state in zip(ports.states.values(), states, strict=True)}
        return action

    def reset(self, seed: int) -> None:
        self._random.seed(seed)
        self._state = {}

    def resume(self, observed: Sequence[Observed]) -> None:
        choose_again(self, observed)

    def close(self) -> None:
        self._session = None

    def description(self) -> Mapping[str, Any]:
        return {"kind": "policy", "policy": self._spec, "sha256": self._sha256}

    def _fitted(self, observation: Any, space: Any, port: _Port) -> Array:
        """Return the observation, or a part of it, in the shape and type of an input."""
        try:
            array = fitted(observation, space, port.shape)
            if array is not None:
                return np.ascontiguousarray(array, port.dtype)
        except (TypeError, ValueError) as error:
            raise PolicyError(f"{self._spec} takes an observation of numbers, and this is none: {error}") from error
        raise PolicyError(
            f"{self._spec} takes observations of {shown(port.shape)} (its input {port.name!r}); "
            f"the environment gives {shown(numbers(observation).shape)}; export it for one such observation, "
            f"or {_INSTEAD}"
        )

    def _chosen(self, output: Array, mask: Mask | None) -> int:
        """Return the number of the action with the best value, or the number that the file returned."""
        row, allowed = output.reshape(-1), legal_actions(self._count, mask)
        if row.size == 1 and row.dtype.kind in "iu":
            action = int(row[0])
            if not 0 <= action < self._count:
                raise PolicyError(f"{self._spec} returned action {action}; there are 0 to {self._count - 1}")
            if action not in allowed:
                raise PolicyError(f"{self._spec} returned action {action}, which action_mask forbids now")
            return action
        if row.size != self._count:
            size = "one number" if row.size == 1 else f"{row.size} numbers"
            action_output = self._ports.action if self._ports else ""
            raise PolicyError(
                f"{self._spec} returns {size} as {action_output!r}; expected {self._count}, one for each action, "
                f"as its first output; export it so, or {_INSTEAD}"
            )
        values = row.astype(np.float64)
        if np.isnan(values).any():
            raise PolicyError(f"{self._spec} returned NaN instead of the actions' values")
        if self._sample:
            weights = np.exp(values[allowed] - values[allowed].max())
            return self._random.choices(allowed, weights.tolist())[0]
        return max(allowed, key=values.__getitem__)


def load(spec: str, file: Path, count: int, space: Any, *, sample: bool) -> OnnxPolicy:
    """Load the policy in a file, and try it with one observation of zeros if the space is known.

    `count` is the number of the player's actions, and `space` the player's observation space, or None. Raises
    PolicyError if onnxruntime is missing or cannot read the file, or if the file does not fit the observations and
    actions.
    """
    policy = OnnxPolicy(spec, _session(spec, file), count, space, sha256=_sha256(file), sample=sample)
    first = zero(space)
    if first is not None:
        policy.act(first, {}, None)
        policy.reset(0)
    return policy


def _session(spec: str, file: Path) -> Any:
    try:
        import onnxruntime  # noqa: PLC0415 - a server without such a policy may not have it
    except ImportError as error:
        raise PolicyError(
            f"{spec} needs the package onnxruntime, which is not installed; write {ONNXRUNTIME} into requirements.txt"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # fatal errors alone: the others are raised as exceptions too
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise PolicyError(f"{spec} is no ONNX file that onnxruntime can read: {_short(error)}") from error


def _read(spec: str, session: Any, observation: Any) -> _Ports:
    """Find out what each input and output is for. Raises PolicyError for an input of unknown purpose."""
    inputs, outputs = [_port(spec, port) for port in session.get_inputs()], session.get_outputs()
    names = observation if isinstance(observation, Mapping) else ()
    parts = tuple(port for port in inputs if port.name in names)
    constant = [port for port in inputs if port.name in _CONSTANT and len(port.shape) <= 1]
    rest = [port for port in inputs if port not in parts and port not in constant]
    whole = rest.pop(0) if rest and all(port.name == ACTION_MASK for port in parts) else None
    states: dict[str, _Port] = {}
    for port in rest:  # in their order, each with the next output of its shape
        same = (out.name for out in outputs[1:] if out.name not in states and _same(port.shape, out.shape))
        output = next(same, None)
        if output is None:
            raise PolicyError(
                f"{spec} takes an input {port.name!r} of {shown(port.shape)}, which is neither an observation nor a "
                f"recurrent state (no output has its shape); {_INSTEAD}"
            )
        states[output] = port
    constants = {port.name: port.filled(_CONSTANT[port.name]) for port in constant}
    return _Ports(parts, whole, constants, states, outputs[0].name)


def _port(spec: str, port: Any) -> _Port:
    if port.type not in _TYPES:
        raise PolicyError(f"{spec} takes an input {port.name!r} of the type {port.type}; {_INSTEAD}")
    return _Port(port.name, _TYPES[port.type], tuple(port.shape))


def _same(shape: Shape, other: Shape) -> bool:
    """Whether two shapes are equal, apart from sizes that the file leaves open."""
    return len(shape) == len(other) and all(
        a == b or not (isinstance(a, int) and isinstance(b, int)) for a, b in zip(shape, other, strict=True)
    )


def _sha256(file: Path) -> str:
    """Return the hash of the file and of the file of weights that PyTorch's newer export may put beside it."""
    digest = hashlib.sha256(file.read_bytes())
    weights = file.with_name(f"{file.name}.data")
    if weights.is_file():
        digest.update(weights.read_bytes())
    return digest.hexdigest()


def _short(error: Exception) -> str:
    """Return onnxruntime's message on one line, without its error number and the places in its code."""
    line = " ".join(str(error).split())
    message = line.rpartition(" : ")[2] or line
    return message if len(message) <= 200 else f"{message[:200]}…"


# ---- observations as arrays


def without_mask(observation: Any) -> Any:
    """Return the observation without the `action_mask` that PettingZoo's games put beside it.

    A map with one entry left becomes the value of that entry.
    """
    if isinstance(observation, Mapping) and ACTION_MASK in observation:
        rest = {key: value for key, value in observation.items() if key != ACTION_MASK}
        return next(iter(rest.values())) if len(rest) == 1 else rest
    return observation


def space_without_mask(space: Any) -> Any:
    """Return the space of the observations from which `without_mask` has removed the mask."""
    if isinstance(space, spaces.Dict):
        rest = without_mask(space.spaces)
        return spaces.Dict(rest) if isinstance(rest, dict) else rest
    return space


def zero(space: Any) -> Any:
    """Return an observation of zeros, with `start` for each `Discrete`. None if the space is not known."""
    if isinstance(space, spaces.Dict):
        return {key: zero(part) for key, part in space.items()}
    if isinstance(space, spaces.Tuple):
        return tuple(map(zero, space))
    if isinstance(space, spaces.Discrete):
        return int(space.start)
    shape = getattr(space, "shape", None)
    return None if shape is None else np.zeros(shape, getattr(space, "dtype", None))


def numbers(observation: Any) -> Array:
    """Convert an observation to an array: a map or a tuple to one row, a map's values in the order of its keys."""
    if isinstance(observation, Mapping):
        return _row([observation[key] for key in sorted(observation, key=str)])
    return _row(observation) if isinstance(observation, tuple) else np.asarray(observation)


def _row(parts: Sequence[Any]) -> Array:
    return np.concatenate([numbers(part).reshape(-1) for part in parts]) if parts else np.zeros(0)


def fitted(observation: Any, space: Any, shape: Shape) -> Array | None:
    """Return the observation as an array of this shape. None if it does not fit.

    It fits as it is, or with each discrete value as one-hot numbers, as Gymnasium's `flatten` and RLlib have them.
    """
    array = _shaped(numbers(observation), shape)
    if array is not None or not isinstance(space, spaces.Space) or not space.is_np_flattenable:
        return array
    if [spaces.flatdim(space)] != list(shape[-1:]):  # it may be far too many to make
        return None
    return _shaped(np.asarray(spaces.flatten(space, observation)), shape)


def _shaped(values: Array, shape: Shape) -> Array | None:
    """Give the values the shape, with a batch of one: as they are, with channels first, or all numbers in a row."""
    images = [values] if values.ndim != 3 else [values, np.moveaxis(values, 2, 0)]
    for array in (*(image[np.newaxis] for image in images), values, values.reshape(1, -1), values.reshape(1, 1, -1)):
        if len(shape) == array.ndim and all(
            size == length for size, length in zip(shape, array.shape, strict=True) if isinstance(size, int)
        ):
            return array
    return None


def shown(shape: Shape) -> str:
    """Describe the shape in words, without the batch: `12 numbers` or `84 x 84 x 3`."""
    sizes = [str(size) if isinstance(size, int) else "any" for size in shape]
    if len(sizes) > 1 and sizes[0] in ("any", "1"):
        sizes = sizes[1:]
    return f"{sizes[0]} numbers" if len(sizes) == 1 else " x ".join(sizes) if sizes else "one number"
