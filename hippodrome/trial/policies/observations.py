"""Turns an observation into the array of numbers that an input of a policy's file takes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from hippodrome.trial.core.players import ACTION_MASK

Array = np.ndarray[Any, np.dtype[Any]]
Shape = Sequence[int | str | None]
"""The shape of an input. A text or None stands for a size that the file leaves open."""


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
