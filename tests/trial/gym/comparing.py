"""Compares values with their types, and samples spaces."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


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
