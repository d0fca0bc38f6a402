"""Runs policies that are ONNX files, by onnxruntime on one thread of the CPU.

The name of an input or output says what it is for. These names are known: RLlib's (`obs`, `state_ins` or `state_in_0`
…, `seq_lens`; `output`, `state_outs` or `state_out_0` …), those of sb3-contrib (`episode_starts`), and any pairs with
`_in` and `_out` or `h` and `hn`. An older RLlib numbers its states wrongly, so that the second state has the name
`seq_lens`. This state has two axes; the real `seq_lens` has one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from protocol.players import ONNXRUNTIME
from trial.core.players import ACTION_MASK, Mask, legal_actions
from trial.core.policies import Observed
from trial.policies.observations import Array, Encoding, Shape, encodings, fitted, shown, without_mask, zero
from trial.policies.policy import PolicyError, choose_again

_OBSERVATION = ("obs", "observation", "observations", "input", "inputs", "state", "features", "x")
_CONSTANT = {"seq_lens": 1, "episode_starts": 0, "is_init": 0, "is_training": 0, "timestep": 0}
"""The inputs with a constant value, each with its value for one observation at a time."""
_TYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16,
    "tensor(int64)": np.int64, "tensor(int32)": np.int32, "tensor(int16)": np.int16, "tensor(int8)": np.int8,
    "tensor(uint8)": np.uint8, "tensor(bool)": np.bool_,
}  # fmt: skip
_OUTPUTS = (
    ("_in", "_out"), ("in_", "out_"), ("", "_out"), ("", "n"), ("", "_n"), ("0", "n"), ("_0", "_n"), ("", "_next"),
)  # fmt: skip
"""The ways to name a state's output after its input: the second text replaces the first one in the input's name."""


@dataclass(frozen=True, slots=True)
class _Port:
    """An input or output of a file."""

    name: str
    dtype: type[np.generic]
    shape: Shape

    def zeros(self, fill: int = 0) -> Array:
        return np.full([size if isinstance(size, int) else 1 for size in self.shape], fill, self.dtype)


@dataclass(frozen=True, slots=True)
class _Ports:
    """The inputs and outputs of a file by their purpose."""

    observation: tuple[tuple[_Port, Encoding], ...]
    """The input for the whole observation, or inputs with the names of its parts; and the encoding of each."""
    states: Mapping[str, _Port]
    """The recurrent states: by the name of an output, the input that gets its value at the next call."""
    constants: Mapping[str, Array]
    mask: _Port | None
    action: str
    """The name of the output with the values of all actions, or with the number of the chosen action."""


class OnnxPolicy:
    """Takes the action with the highest value; with `sample`, a random action by the softmax of the values."""

    def __init__(self, spec: str, session: Any, ports: _Ports, count: int, *, sha256: str, sample: bool) -> None:
        self._spec, self._session, self._ports, self._count = spec, session, ports, count
        self._sha256, self._sample = sha256, sample
        self._random = Random(0)  # noqa: S311 - a game
        self._fetched = [ports.action, *ports.states]
        self._state: dict[str, Array] = {}
        self.reset(0)

    def act(self, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> int:
        """Choose an action, and return its number. Raises PolicyError if the observation or the output does not fit."""
        try:
            inputs = self._inputs(observation)
        except RecursionError:
            raise PolicyError(f"{self._spec} takes no observation that contains itself") from None
        except (TypeError, ValueError) as error:
            raise PolicyError(f"{self._spec} takes an observation of numbers, and this is none: {error}") from error
        feeds: dict[str, Array] = {**self._ports.constants, **self._state, **inputs}
        if self._ports.mask is not None:
            feeds[self._ports.mask.name] = self._mask_input(self._ports.mask, mask)
        try:
            values, *states = self._session.run(self._fetched, feeds)
        except Exception as error:
            raise PolicyError(f"{self._spec} fails: {_short(error)}") from error
        action = self._chosen(np.asarray(values), mask)
        for port, state in zip(self._ports.states.values(), states, strict=True):
            self._state[port.name] = state
        return action

    def reset(self, seed: int) -> None:
        self._random.seed(seed)
        self._state = {port.name: port.zeros() for port in self._ports.states.values()}

    def resume(self, observed: Sequence[Observed]) -> None:
        choose_again(self, observed)

    def close(self) -> None:
        self._session = None

    def description(self) -> Mapping[str, Any]:
        return {"kind": "policy", "policy": self._spec, "sha256": self._sha256}

    def _inputs(self, observation: Any) -> dict[str, Array]:
        """Return the values of the inputs that take the observation, by the names of the inputs."""
        observation = without_mask(observation)
        return {
            port.name: _fit(self._spec, encode(_part(observation, port)), port)
            for port, encode in self._ports.observation
        }

    def _mask_input(self, port: _Port, mask: Mask | None) -> Array:
        allowed = np.ones(self._count) if mask is None else np.asarray(mask)
        array = fitted(allowed, port.shape)
        if array is None:
            raise PolicyError(f"{self._spec} takes {port.name} of {shown(port.shape)}; there are {self._count} actions")
        return array.astype(port.dtype)

    def _chosen(self, output: Array, mask: Mask | None) -> int:
        """Return the number of the action with the best value, or the number that the file returned."""
        row = output.reshape(-1)
        if row.size != self._count or (self._count == 1 and output.dtype.kind in "iu"):
            return self._chosen_by_file(row, mask)
        values = row.astype(np.float64)
        if np.isnan(values).any():
            raise PolicyError(f"{self._spec} returned NaN instead of the actions' values")
        allowed = legal_actions(self._count, mask)
        if self._sample:
            return _drawn(values, allowed, self._random)
        return max(allowed, key=values.__getitem__)

    def _chosen_by_file(self, row: Array, mask: Mask | None) -> int:
        if row.size != 1 or row.dtype.kind not in "iu":
            size = "one number" if row.size == 1 else f"{row.size} numbers"
            raise PolicyError(
                f"{self._spec} returns {size} as {self._ports.action!r}; expected {self._count}, one for each action"
            )
        action = int(row[0])
        if not 0 <= action < self._count:
            raise PolicyError(f"{self._spec} returned action {action}; there are 0 to {self._count - 1}")
        if action not in legal_actions(self._count, mask):
            raise PolicyError(f"{self._spec} returned action {action}, which action_mask forbids now")
        return action


def load(spec: str, file: Path, count: int, space: Any, *, sample: bool) -> OnnxPolicy:
    """Load the policy in a file, and try it with one observation of zeros if the space is known.

    `count` is the number of the player's actions, and `space` the player's observation space, or None. Raises
    PolicyError if onnxruntime is missing or cannot read the file, or if the file does not fit the observations and
    actions.
    """
    session = _session(spec, file)
    inputs, outputs = [_port(spec, port) for port in session.get_inputs()], session.get_outputs()
    try:
        first = None if space is None else without_mask(zero(space))
    except MemoryError as error:
        raise PolicyError(f"{spec} cannot be tried: an observation of the environment needs more memory") from error
    ports = _read(spec, inputs, outputs, space, first)
    policy = OnnxPolicy(spec, session, ports, count, sha256=_sha256(file), sample=sample)
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


def _port(spec: str, port: Any) -> _Port:
    if port.type not in _TYPES:
        raise PolicyError(f"{spec} has {port.name!r} of the type {port.type}; expected numbers such as tensor(float)")
    return _Port(port.name, _TYPES[port.type], tuple(port.shape))


def _read(spec: str, inputs: list[_Port], outputs: list[Any], space: Any, first: Any) -> _Ports:
    """Find out what each input and output is for. `space` is that of the observations, `first` one of them, or None.

    Raises PolicyError for an input of unknown purpose.
    """
    if not inputs or not outputs:
        raise PolicyError(f"{spec} has no {'output' if inputs else 'input'}")
    observation = _observation_inputs(inputs, first)
    rest = [port for port in inputs if port not in observation]
    mask = next((port for port in rest if port.name in (ACTION_MASK, "mask", "action_masks")), None)
    constants = {
        port.name: port.zeros(_CONSTANT[port.name]) for port in rest if port.name in _CONSTANT and len(port.shape) <= 1
    }
    state_inputs = [port for port in rest if port is not mask and port.name not in constants]
    states = _states(spec, state_inputs, outputs)
    return _Ports(
        observation=tuple((port, _encoding(port, space, first)) for port in observation),
        states=states,
        constants=constants,
        mask=mask,
        action=next((port.name for port in outputs if port.name not in states), outputs[0].name),
    )


def _observation_inputs(inputs: list[_Port], first: Any) -> tuple[_Port, ...]:
    """Return the inputs for the observation: those with the names of its parts; or one with a usual name; or the first.

    A file may take only some parts.
    """
    parts = tuple(port for port in inputs if isinstance(first, Mapping) and port.name in first)
    if parts:
        return parts
    named = [port for name in _OBSERVATION for port in inputs if port.name == name]
    return ((named or inputs)[0],)


def _states(spec: str, inputs: list[_Port], outputs: list[Any]) -> dict[str, _Port]:
    """Pair the recurrent states: return, by an output's name, the input that gets its value at the next call.

    Names decide, and for the others the shapes, in their order. Raises PolicyError for an input
    without an output.
    """
    free = {port.name: port for port in outputs}
    pairs: dict[str, _Port] = {}
    unpaired = []
    for port in inputs:
        name = next((name for name in _output_names(port.name) if name in free), None)
        if name is None:
            unpaired.append(port)
        else:
            pairs[name] = port
            del free[name]
    candidates = list(free.values())[1:]  # the first output is the actions', and no state
    for port in unpaired:
        out = next((out for out in candidates if _same_shape(port.shape, out.shape)), None)
        if out is None:
            raise PolicyError(
                f"{spec} takes an input {port.name!r} of {shown(port.shape)}, which is no observation and no state: "
                "no output has its shape"
            )
        candidates.remove(out)
        pairs[out.name] = port
    return pairs


def _output_names(name: str) -> Iterable[str]:
    """Yield the possible names of a state's output, by the name of its input."""
    for old, new in _OUTPUTS:
        if not old:
            yield name + new
        elif old in name:
            yield name.replace(old, new)
    yield from (f"next_{name}", f"new_{name}", f"out_{name}")


def _same_shape(one: Shape, other: Shape) -> bool:
    """Whether two shapes are equal, apart from sizes that the file leaves open."""
    return len(one) == len(other) and all(
        a == b or not (isinstance(a, int) and isinstance(b, int)) for a, b in zip(one, other, strict=True)
    )


def _part(observation: Any, port: _Port) -> Any:
    """Return the part of an observation that has the input's name; the whole observation if it has no such part."""
    return observation[port.name] if isinstance(observation, Mapping) and port.name in observation else observation


def _encoding(port: _Port, space: Any, first: Any) -> Encoding:
    """Choose the encoding with which observations fit an input; the usual one if none fits, or if none was tried."""
    space, value = _without_mask_space(space), _part(first, port)
    parts = getattr(space, "spaces", None)
    possible = encodings(parts[port.name] if isinstance(parts, Mapping) and port.name in parts else space)
    fitting = (each for each in possible if first is not None and fitted(each(value), port.shape) is not None)
    return next(fitting, possible[0])


def _without_mask_space(space: Any) -> Any:
    """Return the space of observations from which `without_mask` has removed the mask."""
    inner = getattr(space, "spaces", None)
    if isinstance(inner, Mapping) and ACTION_MASK in inner:
        rest = {key: part for key, part in inner.items() if key != ACTION_MASK}
        if len(rest) == 1:
            return next(iter(rest.values()))
    return space


def _fit(spec: str, values: Array, port: _Port) -> Array:
    """Give the values the shape and type of an input. Raises PolicyError if they do not fit."""
    array = fitted(values, port.shape)
    if array is None:
        raise PolicyError(
            f"{spec} takes observations of {shown(port.shape)} (its input {port.name!r}); "
            f"the environment gives {shown(values.shape)}{_fixed_batch(values, port)}"
        )
    return np.ascontiguousarray(array, port.dtype)


def _fixed_batch(values: Array, port: _Port) -> str:
    """Return what to do if the file takes only several observations at once, for the end of a message; else empty."""
    batch = port.shape[0] if len(port.shape) > 1 else 1
    if not isinstance(batch, int) or batch == 1 or fitted(values, (1, *port.shape[1:])) is None:
        return ""
    return f"; {batch} is its batch: export it with a batch of 1, or of any size (dynamic axes)"


def _drawn(values: Array, allowed: list[int], random: Random) -> int:
    """Draw one of the allowed actions, with the probabilities of the softmax of their values."""
    allowed_values = values[allowed]
    best = allowed_values.max()
    if not np.isfinite(best):  # the softmax is not defined: all actions with this value are equally good
        return random.choice([action for action, value in zip(allowed, allowed_values, strict=True) if value == best])
    return random.choices(allowed, np.exp(allowed_values - best).tolist())[0]


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
