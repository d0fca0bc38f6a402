"""Hypothesis strategies: spaces of every kind, nested, and values of them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from gymnasium import spaces
from hypothesis import strategies as st

FLOATS = ("float16", "float32", "float64")
WHOLES = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")
SHAPES = st.lists(st.integers(0, 3), max_size=3).map(tuple)
SEEDS = st.integers(0, 2**31 - 1)


@st.composite
def float_boxes(draw: Any) -> Any:
    dtype = np.dtype(draw(st.sampled_from(FLOATS)))
    shape = draw(SHAPES)
    width = dtype.itemsize * 8
    count = math.prod(shape)
    numbers = st.lists(st.floats(width=width, allow_nan=False), min_size=count, max_size=count)
    one, other = (np.array(draw(numbers), dtype).reshape(shape) for _ in range(2))
    return spaces.Box(np.minimum(one, other), np.maximum(one, other), shape, dtype)


@st.composite
def whole_boxes(draw: Any) -> Any:
    dtype = np.dtype(draw(st.sampled_from(WHOLES)))
    info = np.iinfo(dtype)
    shape = draw(SHAPES)
    count = math.prod(shape)
    # Gymnasium cannot sample from bounds at the ends of 64 bits.
    numbers = st.lists(
        st.integers(max(-(2**62), int(info.min)), min(2**62, int(info.max))), min_size=count, max_size=count
    )
    one, other = (np.array(draw(numbers), dtype).reshape(shape) for _ in range(2))
    return spaces.Box(np.minimum(one, other), np.maximum(one, other), shape, dtype)


@st.composite
def discretes(draw: Any) -> Any:
    dtype = draw(st.sampled_from(WHOLES))
    start = draw(st.integers(0, 100)) if dtype.startswith("u") else draw(st.integers(-100, 100))
    return spaces.Discrete(draw(st.integers(1, 20)), start=start, dtype=np.dtype(dtype).type)


@st.composite
def multi_discretes(draw: Any) -> Any:
    shape = draw(st.lists(st.integers(1, 3), min_size=1, max_size=2).map(tuple))
    count = math.prod(shape)
    nvec = np.array(draw(st.lists(st.integers(1, 9), min_size=count, max_size=count))).reshape(shape)
    start = np.array(draw(st.lists(st.integers(-9, 9), min_size=count, max_size=count))).reshape(shape)
    return spaces.MultiDiscrete(nvec, dtype=draw(st.sampled_from([np.int8, np.int32, np.int64])), start=start)


@st.composite
def texts(draw: Any) -> Any:
    shortest = draw(st.integers(0, 4))
    alphabet = draw(st.text(min_size=1, max_size=6))
    return spaces.Text(shortest + draw(st.integers(0, 5)), min_length=shortest, charset=alphabet)


FIXED = st.one_of(
    float_boxes(),
    whole_boxes(),
    st.builds(lambda: spaces.Box(0, 1, (3,), bool)),
    discretes(),
    st.builds(spaces.MultiBinary, st.one_of(st.integers(1, 4), st.lists(st.integers(1, 3), min_size=1, max_size=2))),
    multi_discretes(),
)
LEAVES = st.one_of(FIXED, texts())


def _nested(inner: Any) -> Any:
    parts = st.lists(inner, max_size=3)
    return st.one_of(
        st.dictionaries(st.text(max_size=4), inner, max_size=3).map(spaces.Dict),
        parts.map(spaces.Tuple),
        st.lists(inner, min_size=1, max_size=3).map(spaces.OneOf),
        st.builds(spaces.Sequence, inner),
    )


GRAPHS = st.builds(
    spaces.Graph,
    st.one_of(float_boxes(), discretes()),
    st.one_of(st.none(), float_boxes(), discretes()),
)
STACKS = st.builds(spaces.Sequence, FIXED, stack=st.just(True))
SPACES = st.recursive(st.one_of(LEAVES, GRAPHS, STACKS), _nested, max_leaves=6)


def sampled(space: Any, seed: int, count: int) -> list[Any]:
    """Sample `count` values of the space."""
    space.seed(seed)
    with np.errstate(all="ignore"):
        return [space.sample() for _ in range(count)]


def same(one: Any, other: Any) -> bool:
    """Equal in value, in type, in dtype and in shape; NaN equals NaN.

    A number of numpy equals an array without axes: a Box of shape () samples one or the other, by its dtype.
    """
    if isinstance(one, np.generic) and isinstance(other, np.ndarray):
        one = np.asarray(one)
    if isinstance(other, np.generic) and isinstance(one, np.ndarray):
        other = np.asarray(other)
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray) and one.dtype == other.dtype == object:
        return one.shape == other.shape and all(map(same, one.ravel().tolist(), other.ravel().tolist()))
    if isinstance(one, np.ndarray | np.generic):
        equal = np.array_equal(one, other, equal_nan=one.dtype.kind in "fc")
        return one.dtype == other.dtype and one.shape == other.shape and equal
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple | list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and math.isnan(one):
        return math.isnan(other)
    return bool(one == other)
