"""Policies that are ONNX files, run by onnxruntime on one thread of the CPU.

The names of inputs and outputs are those of the exports that researchers have: RLlib's (`obs`, `state_ins` or
`state_in_0` …, `seq_lens`; `output`, `state_outs` or `state_out_0` …), those of sb3-contrib (`episode_starts`), and any
pairs with `_in` and `_out` or `h` and `hn`. An older RLlib numbers its states wrongly, so that a second state is called
`seq_lens`; a second axis tells it from the real one.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from random import Random
from typing import Any

import numpy as np

from protocol.players import ONNXRUNTIME
from trial.core.players import ACTION_MASK, Mask, legal_actions
from trial.policies.observations import Array, Encoding, Shape, encodings, fitted, shown, without_mask, zero
from trial.policies.policy import PolicyError

_OBSERVATION = ("obs", "observation", "observations", "input", "inputs", "state", "features", "x")
_CONSTANT = {"seq_lens": 1, "episode_starts": 0, "is_init": 0, "is_training": 0, "timestep": 0}
"""Inputs that are no observation, by their value where one observation comes at a time."""
_TYPES: dict[str, type[np.generic]] = {
    "tensor(float)": np.float32, "tensor(double)": np.float64, "tensor(float16)": np.float16,
    "tensor(int64)": np.int64, "tensor(int32)": np.int32, "tensor(int16)": np.int16, "tensor(int8)": np.int8,
    "tensor(uint8)": np.uint8, "tensor(bool)": np.bool_,
}  # fmt: skip
_OUTPUTS = (
    ("_in", "_out"), ("in_", "out_"), ("", "_out"), ("", "n"), ("", "_n"), ("0", "n"), ("_0", "_n"), ("", "_next"),
)  # fmt: skip
"""How the name of a state's output comes of that of its input."""


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
    """What the inputs and outputs of a file are for."""

    observation: tuple[_Port, ...]
    """One, or as many as the observation has parts, which they are named after."""
    states: Mapping[str, _Port]
    """Recurrent states: by the name of the output, the input that it becomes."""
    constants: Mapping[str, Array]
    mask: _Port | None
    action: str
    """The output: of the actions' values, or the action."""


class OnnxPolicy:
    """Takes the action with the highest value, or with `sample` one drawn by the softmax of the values."""

    def __init__(
        self, spec: str, session: Any, ports: _Ports, count: int, encode: Encoding, *, sha256: str, sample: bool
    ) -> None:
        self._spec, self._session, self._ports, self._count = spec, session, ports, count
        self._encode, self._sha256, self._sample = encode, sha256, sample
        self._random = Random(0)  # noqa: S311 - a game
        self._fetched = [ports.action, *ports.states]
        self._state: dict[str, Array] = {}
        self.reset(0)

    def act(self, observation: Any, info: Mapping[str, Any], mask: Mask | None) -> int:
        """The action. Raises PolicyError if the observation does not fit, or the answer is no action."""
        try:
            seen = self._seen(observation)
        except RecursionError:
            raise PolicyError(f"{self._spec} takes no observation that holds itself") from None
        except (TypeError, ValueError) as error:
            raise PolicyError(f"{self._spec} takes an observation of numbers, and this is none: {error}") from error
        feeds: dict[str, Array] = {**self._ports.constants, **self._state, **seen}
        if self._ports.mask is not None:
            feeds[self._ports.mask.name] = self._masked(self._ports.mask, mask)
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

    def close(self) -> None:
        self._session = None

    def description(self) -> Mapping[str, Any]:
        return {"kind": "policy", "policy": self._spec, "sha256": self._sha256}

    def _seen(self, observation: Any) -> dict[str, Array]:
        seen = without_mask(observation)
        if len(self._ports.observation) == 1:
            port = self._ports.observation[0]
            if isinstance(seen, Mapping) and set(seen) == {port.name}:
                seen = seen[port.name]
            return {port.name: _fit(self._spec, self._encode(seen), port)}
        return {port.name: _fit(self._spec, np.asarray(seen[port.name]), port) for port in self._ports.observation}

    def _masked(self, port: _Port, mask: Mask | None) -> Array:
        allowed = np.ones(self._count) if mask is None else np.asarray(mask)
        found = fitted(allowed, port.shape)
        if found is None:
            raise PolicyError(f"{self._spec} takes {port.name} of {shown(port.shape)}; there are {self._count} actions")
        return found.astype(port.dtype)

    def _chosen(self, values: Array, mask: Mask | None) -> int:
        row = values.reshape(-1)
        if row.size != self._count or (self._count == 1 and values.dtype.kind in "iu"):
            return self._given(row, mask)
        found = row.astype(np.float64)
        if np.isnan(found).any():
            raise PolicyError(f"{self._spec} returned NaN instead of the actions' values")
        allowed = legal_actions(self._count, mask)
        if self._sample:
            return _drawn(found, allowed, self._random)
        return max(allowed, key=found.__getitem__)

    def _given(self, row: Array, mask: Mask | None) -> int:
        """The action that the file chose itself."""
        if row.size != 1 or row.dtype.kind not in "iu":
            said = "one number" if row.size == 1 else f"{row.size} numbers"
            raise PolicyError(
                f"{self._spec} returns {said} as {self._ports.action!r}; expected {self._count}, one for each action"
            )
        action = int(row[0])
        if not 0 <= action < self._count:
            raise PolicyError(f"{self._spec} returned action {action}; there are 0 to {self._count - 1}")
        if action not in legal_actions(self._count, mask):
            raise PolicyError(f"{self._spec} returned action {action}, which action_mask forbids now")
        return action


def load(spec: str, file: Path, count: int, space: Any, *, sample: bool) -> OnnxPolicy:
    """The policy in a file, tried with one observation of zeros if the space is known.

    Raises PolicyError if the file is no ONNX, does not fit the observations and actions, or fails.
    """
    session = _session(spec, file)
    inputs, outputs = ([_port(spec, port) for port in ports] for ports in (session.get_inputs(), session.get_outputs()))
    try:
        first = None if space is None else without_mask(zero(space))
    except MemoryError as error:
        raise PolicyError(f"{spec} cannot be tried: an observation of the environment needs more memory") from error
    ports = _read(spec, inputs, outputs, first)
    encode = _encoding(spec, ports, space, first)
    policy = OnnxPolicy(spec, session, ports, count, encode, sha256=_sha256(file), sample=sample)
    if first is not None:
        policy.act(first, {}, None)
        policy.reset(0)
    return policy


def _session(spec: str, file: Path) -> Any:
    try:
        import onnxruntime  # noqa: PLC0415 - a server without such a policy does without
    except ImportError as error:
        raise PolicyError(
            f"{spec} needs the package onnxruntime, which is not installed; write {ONNXRUNTIME} into requirements.txt"
        ) from error
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4  # what is wrong comes as an exception
    try:
        return onnxruntime.InferenceSession(str(file), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise PolicyError(f"{spec} is no ONNX file that onnxruntime can read: {_short(error)}") from error


def _port(spec: str, port: Any) -> _Port:
    if port.type not in _TYPES:
        raise PolicyError(f"{spec} has {port.name!r} of the type {port.type}; expected numbers such as tensor(float)")
    return _Port(port.name, _TYPES[port.type], tuple(port.shape))


def _read(spec: str, inputs: list[_Port], outputs: list[_Port], first: Any) -> _Ports:
    """What each input and output is for. Raises PolicyError for an input that nothing can be given for."""
    if not inputs or not outputs:
        raise PolicyError(f"{spec} has no {'output' if inputs else 'input'}")
    seen = _observed(inputs, first)
    rest = [port for port in inputs if port not in seen]
    mask = next((port for port in rest if port.name in (ACTION_MASK, "mask", "action_masks")), None)
    constants = {
        port.name: port.zeros(_CONSTANT[port.name]) for port in rest if port.name in _CONSTANT and len(port.shape) <= 1
    }
    wanted = [port for port in rest if port is not mask and port.name not in constants]
    states = _states(spec, wanted, outputs)
    return _Ports(
        observation=seen,
        states=states,
        constants=constants,
        mask=mask,
        action=next((port.name for port in outputs if port.name not in states), outputs[0].name),
    )


def _observed(inputs: list[_Port], first: Any) -> tuple[_Port, ...]:
    """The inputs that take the observation: those named after its parts, or one of a usual name, or the first."""
    if isinstance(first, Mapping):
        parts = tuple(port for port in inputs if port.name in first)
        if len(parts) == len(first):
            return parts
    named = [port for name in _OBSERVATION for port in inputs if port.name == name]
    return ((named or inputs)[0],)


def _states(spec: str, wanted: list[_Port], outputs: list[_Port]) -> dict[str, _Port]:
    """By the name of the output, the input that it becomes: paired by their names, the others in their order."""
    left = {port.name: port for port in outputs}
    pairs: dict[str, _Port] = {}
    unpaired = []
    for port in wanted:
        name = next((name for name in _next_names(port.name) if name in left), None)
        if name is None:
            unpaired.append(port)
        else:
            pairs[name] = port
            del left[name]
    values = next(iter(left), "")  # the first output is not a state
    others = [port for name, port in left.items() if name != values]
    for port in unpaired:
        out = next((out for out in others if _alike(port.shape, out.shape)), None)
        if out is None:
            raise PolicyError(
                f"{spec} takes an input {port.name!r} of {shown(port.shape)}, which is no observation and no state: "
                "no output has its shape"
            )
        others.remove(out)
        pairs[out.name] = port
    return pairs


def _next_names(name: str) -> Iterable[str]:
    for old, new in _OUTPUTS:
        if not old:
            yield name + new
        elif old in name:
            yield name.replace(old, new)
    yield from (f"next_{name}", f"new_{name}", f"out_{name}")


def _alike(one: Shape, other: Shape) -> bool:
    return len(one) == len(other) and all(
        a == b or not (isinstance(a, int) and isinstance(b, int)) for a, b in zip(one, other, strict=True)
    )


def _encoding(spec: str, ports: _Ports, space: Any, first: Any) -> Encoding:
    """How observations fit the file's one input. Raises PolicyError if they do not."""
    ways = encodings(_seen_space(space))
    if first is None or len(ports.observation) > 1:
        return ways[0]
    port = ports.observation[0]
    for encode in ways:
        if fitted(encode(first), port.shape) is not None:
            return encode
    _fit(spec, ways[0](first), port)
    raise AssertionError("unreachable")


def _seen_space(space: Any) -> Any:
    """The space of what is to be seen, without the mask."""
    inner = getattr(space, "spaces", None)
    if isinstance(inner, Mapping) and ACTION_MASK in inner:
        rest = {key: part for key, part in inner.items() if key != ACTION_MASK}
        if len(rest) == 1:
            return next(iter(rest.values()))
    return space


def _fit(spec: str, values: Array, port: _Port) -> Array:
    found = fitted(values, port.shape)
    if found is None:
        raise PolicyError(
            f"{spec} takes observations of {shown(port.shape)} (its input {port.name!r}); "
            f"the environment gives {shown(values.shape)}{_fixed_batch(values, port)}"
        )
    return np.ascontiguousarray(found, port.dtype)


def _fixed_batch(values: Array, port: _Port) -> str:
    """What to do about a file that takes several observations at once and no fewer; empty for any other."""
    batch = port.shape[0] if len(port.shape) > 1 else 1
    if not isinstance(batch, int) or batch == 1 or fitted(values, (1, *port.shape[1:])) is None:
        return ""
    return f"; {batch} is its batch: export it with a batch of 1, or of any size (dynamic axes)"


def _drawn(values: Array, allowed: list[int], random: Random) -> int:
    """An action, each as likely as the softmax of the values says."""
    chosen = values[allowed]
    best = chosen.max()
    if not np.isfinite(best):  # all of these are as good as one another
        return random.choice([action for action, value in zip(allowed, chosen, strict=True) if value == best])
    return random.choices(allowed, np.exp(chosen - best).tolist())[0]


def _sha256(file: Path) -> str:
    """Of the file, and of the weights that PyTorch's newer export puts beside it."""
    digest = hashlib.sha256(file.read_bytes())
    beside = file.with_name(f"{file.name}.data")
    if beside.is_file():
        digest.update(beside.read_bytes())
    return digest.hexdigest()


def _short(error: Exception) -> str:
    """What onnxruntime says, on one line, without its number and the places in its code."""
    words = " ".join(str(error).split())
    said = words.rpartition(" : ")[2] or words
    return said if len(said) <= 200 else f"{said[:200]}…"
