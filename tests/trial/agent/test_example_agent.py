"""The agent of the example study (agent.py)."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np

EXAMPLE = Path(__file__).parents[3] / "agent.py"


def example() -> Any:
    spec = importlib.util.spec_from_file_location("example_agent", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Agent()


def test_each_pixel_is_the_brightest_of_the_last_four_frames() -> None:
    agent, noise = example(), np.random.default_rng(7)
    for count in (1, 2, 4):
        agent.screens = [noise.integers(0, 256, (210, 160, 3), np.uint8) for _ in range(count)]
        shown = agent.render()
        greens = np.stack([screen[:, :, 1] for screen in agent.screens])
        assert np.array_equal(shown[:, :, 1], greens.max(axis=0))
        colours = np.stack(agent.screens)
        assert (colours == shown).all(axis=3).any(axis=0).all(), "a pixel has the colour of one of the frames"


def test_a_picture_does_not_change_the_frames() -> None:
    agent, noise = example(), np.random.default_rng(7)
    agent.screens = [noise.integers(0, 256, (210, 160, 3), np.uint8) for _ in range(4)]
    before = [screen.copy() for screen in agent.screens]
    agent.render()
    assert np.array_equal(agent.screens, before)
