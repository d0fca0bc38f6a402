"""Spaces and values of every kind travel both ways, by JSON and by raw arrays, and arrive as they were."""

from __future__ import annotations

import json
from typing import Any

import numpy as np
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from tests.trial.gym.space_strategies import SEEDS, SPACES, same, sampled
from trial.gym import arrays, values
from trial.gym.spaces import build, describe

IMAGE = spaces.Box(0, 255, (210, 160, 3), np.uint8)


def over_json(value: Any) -> Any:
    return json.loads(values.to_text(value))


@given(SPACES, st.booleans())
def test_a_space_is_built_again_from_its_description(space: Any, compact: bool) -> None:
    built = build(over_json(describe(space, compact=compact)))
    assert built == space
    assert describe(built, compact=compact) == describe(space, compact=compact)


@given(SPACES, SEEDS)
def test_a_built_space_samples_what_the_space_itself_samples(space: Any, seed: int) -> None:
    built = build(over_json(describe(space)))
    assert all(map(same, sampled(built, seed, 2), sampled(space, seed, 2)))


@given(SPACES, SEEDS)
def test_values_travel_as_json(space: Any, seed: int) -> None:
    read = values.decoder(space)
    for value in sampled(space, seed, 3):
        assert same(read(over_json(value)), value)


@given(SPACES, SEEDS, st.integers(1, 5))
def test_batches_travel_as_raw_arrays(space: Any, seed: int, count: int) -> None:
    layout = arrays.layout(space)
    rows = sampled(space, seed, count)
    batch = arrays.batch_of(layout, rows)
    message = arrays.step_request(arrays.STEP_MANY, 7, count, layout, batch)
    request = arrays.read_request(message)
    assert (request.kind, request.handle, request.steps) == (arrays.STEP_MANY, 7, count)
    found = layout.rows(arrays.read_actions(request, layout), count)
    assert all(map(same, found, rows))
