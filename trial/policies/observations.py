"""Turns an observation into the array of numbers that a policy's file takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np

from trial.core.players import ACTION_MASK

Array = np.ndarray[Any, np.dtype[Any]]
Shape = Sequence[int | str | None]
"""The shape of an input. A text or None stands for a size that the file leaves open."""
Encoding = Callable[[Any], Array]
"""Turns an observation into an array."""

MAX_ONE_HOT = 10_000_000
"""The most numbers of an observation with one-hot discrete parts: no policy takes more."""


def without_mask(observation: Any) -> Any:
    """Return the observation without the `action_mask` that PettingZoo's games put beside it.

    A map with one entry left becomes the value of that entry.
    """
    if isinstance(observation, Mapping) and ACTION_MASK in observation:
        rest = {key: value for key, value in observation.items() if key != ACTION_MASK}
        return next(iter(rest.values())) if len(rest) == 1 else rest
    return observation


def flat(observation: Any) -> Array:
    """Return all numbers of an observation in one row; a map's in the order of its keys, as RLlib and Gymnasium do."""
    if isinstance(observation, Mapping):
        parts = [flat(observation[key]) for key in sorted(observation, key=str)]
    elif isinstance(observation, tuple):
        parts = [flat(part) for part in observation]
    else:
        return np.asarray(observation, np.float64).reshape(-1)
    return np.concatenate(parts) if parts else np.zeros(0)


def numbers(observation: Any) -> Array:
    """Convert an observation to an array: a map or a tuple to one row, anything else in its own shape."""
    return flat(observation) if isinstance(observation, Mapping | tuple) else np.asarray(observation)


def encodings(space: Any) -> list[Encoding]:
    """Return the encodings that a file may expect for observations of this space, the likeliest first.

    One takes the numbers as they are, the other turns each discrete value into one-hot numbers.
    """
    possible: list[Encoding] = [numbers]
    if space is not None and one_hot_size(space) <= MAX_ONE_HOT:
        possible.append(lambda observation: _one_hot(space, observation))
    return possible


def one_hot_size(space: Any) -> int:
    """Return how many numbers an observation of this space has if each discrete value is one-hot; 0 if unknown."""
    inner = getattr(space, "spaces", None)
    if isinstance(inner, Mapping):
        return sum(map(one_hot_size, inner.values()))
    if isinstance(inner, Sequence):
        return sum(map(one_hot_size, inner))
    shape = getattr(space, "shape", None)
    if hasattr(space, "n") and shape == ():
        return int(space.n)
    if hasattr(space, "nvec"):
        return sum(int(n) for n in flat(space.nvec))
    return 0 if shape is None else math.prod(int(size) for size in shape)


def _one_hot(space: Any, observation: Any) -> Array:
    """Put the numbers in a row, each discrete value as one-hot, as Gymnasium's `flatten` and RLlib do it."""
    inner = getattr(space, "spaces", None)
    if isinstance(inner, Mapping):
        parts = [_one_hot(inner[key], observation[key]) for key in sorted(inner, key=str) if key in observation]
    elif isinstance(inner, Sequence):
        parts = [_one_hot(part, value) for part, value in zip(inner, observation, strict=True)]
    elif hasattr(space, "n") and getattr(space, "shape", None) == ():
        row = np.zeros(int(space.n))
        row[int(observation) - int(getattr(space, "start", 0))] = 1
        return row
    elif hasattr(space, "nvec"):
        counts = [int(n) for n in flat(space.nvec)]
        row = np.zeros(sum(counts))
        for first, value in zip(accumulate(counts, initial=0), flat(observation), strict=False):
            row[first + int(value)] = 1
        return row
    else:
        return flat(observation)
    return np.concatenate(parts) if parts else np.zeros(0)


def zero(space: Any) -> Any:
    """Return an observation of zeros, with `start` for each `Discrete`. None if the space is not known."""
    inner = getattr(space, "spaces", None)
    if isinstance(inner, Mapping):
        return {key: zero(part) for key, part in inner.items()}
    if isinstance(inner, Sequence):
        return tuple(zero(part) for part in inner)
    if hasattr(space, "n") and getattr(space, "shape", None) == ():
        return int(getattr(space, "start", 0))
    shape = getattr(space, "shape", None)
    return None if shape is None else np.zeros(shape, getattr(space, "dtype", None) or np.float32)


def fitted(values: Array, shape: Shape) -> Array | None:
    """Give the values the shape of an input, with a batch of one. Return None if they do not fit.

    They may fit as they are, with one or two axes of size 1 before them (batch and time), in one row, or as an image
    with its channels as the first axis.
    """
    if any(size == 0 for size in shape):
        return None
    candidates = [(1, *values.shape), values.shape, (1, 1, *values.shape)]
    if values.ndim != 1:
        candidates += [(1, values.size), (1, 1, values.size), (values.size,)]
    for candidate in candidates:
        if _fits(candidate, shape):
            return values.reshape(candidate)
    if values.ndim == 3:
        channels_first = np.moveaxis(values, 2, 0)
        for candidate in ((1, *channels_first.shape), channels_first.shape):
            if _fits(candidate, shape):
                return channels_first.reshape(candidate)
    return None


def _fits(sizes: Sequence[int], shape: Shape) -> bool:
    return len(sizes) == len(shape) and all(
        not isinstance(wanted, int) or wanted == size for size, wanted in zip(sizes, shape, strict=True)
    )


def shown(shape: Shape) -> str:
    """Describe the shape in words, without the batch: `12 numbers` or `84 x 84 x 3`."""
    sizes = [str(size) if isinstance(size, int) else "any" for size in shape]
    if len(sizes) > 1 and sizes[0] in ("any", "1"):
        sizes = sizes[1:]
    return f"{sizes[0]} numbers" if len(sizes) == 1 else " x ".join(sizes) if sizes else "one number"
