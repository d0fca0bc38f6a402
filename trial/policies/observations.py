"""How an observation becomes the numbers that a policy's file takes."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from itertools import accumulate
from typing import Any

import numpy as np

from trial.core.players import ACTION_MASK

Array = np.ndarray[Any, np.dtype[Any]]
Shape = Sequence[int | str | None]
"""Of an input: a text or None is a size that the file leaves open."""
Encoding = Callable[[Any], Array]

MOST_ONE_HOT = 10_000_000
"""Numbers of an observation whose discrete parts are one-hot; no policy takes more."""


def without_mask(observation: Any) -> Any:
    """What is to be seen, without the mask that PettingZoo's games put beside it."""
    if isinstance(observation, Mapping) and ACTION_MASK in observation:
        rest = {key: value for key, value in observation.items() if key != ACTION_MASK}
        return next(iter(rest.values())) if len(rest) == 1 else rest
    return observation


def flat(observation: Any) -> Array:
    """All its numbers in one row. Those of a map come in the order of its sorted keys, as RLlib and Gymnasium do it."""
    if isinstance(observation, Mapping):
        parts = [flat(observation[key]) for key in sorted(observation, key=str)]
    elif isinstance(observation, tuple):
        parts = [flat(part) for part in observation]
    else:
        return np.asarray(observation, np.float64).reshape(-1)
    return np.concatenate(parts) if parts else np.zeros(0)


def numbers(observation: Any) -> Array:
    """An array stays as it is; of a map or a tuple, all numbers in a row."""
    return flat(observation) if isinstance(observation, Mapping | tuple) else np.asarray(observation)


def encodings(space: Any) -> list[Encoding]:
    """How observations of this space may be meant, the likeliest first: as they are, or a discrete one as one-hot."""
    found: list[Encoding] = [numbers]
    if space is not None and one_hot_size(space) <= MOST_ONE_HOT:
        found.append(lambda observation: _one_hot(space, observation))
    return found


def one_hot_size(space: Any) -> int:
    """How many numbers an observation of this space has where each `Discrete` is one-hot; 0 if that is not known."""
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
    """The numbers in a row, where each `Discrete` is one-hot, as Gymnasium's `flatten` and RLlib do it."""
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
    """An observation of zeros, or of the least value of what cannot be zero. None if the space is not known."""
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
    """The values in the shape of an input, with a batch of one; None if they do not fit.

    They fit as they are, with one or two axes of size 1 before them (batch and time), in one row, or as an image whose
    channels come first.
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
        first = np.moveaxis(values, 2, 0)
        for candidate in ((1, *first.shape), first.shape):
            if _fits(candidate, shape):
                return first.reshape(candidate)
    return None


def _fits(sizes: Sequence[int], shape: Shape) -> bool:
    return len(sizes) == len(shape) and all(
        not isinstance(wanted, int) or wanted == size for size, wanted in zip(sizes, shape, strict=True)
    )


def shown(shape: Shape) -> str:
    """A shape in words: `12 numbers` or `84 x 84 x 3`, without the batch."""
    sizes = [str(size) if isinstance(size, int) else "any" for size in shape]
    if len(sizes) > 1 and sizes[0] in ("any", "1"):
        sizes = sizes[1:]
    return f"{sizes[0]} numbers" if len(sizes) == 1 else " x ".join(sizes) if sizes else "one number"
