"""The kinds of picture with which frames are measured, each as a sequence of frames."""

from __future__ import annotations

import importlib.util
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from trial.pictures.frames import Frame, as_frame

ROOT = Path(__file__).parents[1]
GAME = "ALE/MsPacman-v5"
FRAMES = 300  # frames of each kind of picture


def example_agent() -> Any:
    """Make the agent of the example study."""
    spec = importlib.util.spec_from_file_location("example_agent", ROOT / "agent.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.Agent()


def ms_pacman() -> list[Frame]:
    """Draw the example agent's game with random keys: 160 x 210 pixels, flat colours, small parts that move."""
    agent = example_agent()
    agent.start(GAME)
    keys = random.Random(7)
    frames, action, over = [], 0, True
    for number in range(FRAMES):
        if over:
            agent.reset(seed=7)
        if number % 12 == 0:
            action = keys.choice([1, 2, 3, 4])
        _, _, terminated, truncated, _ = agent.step(action)
        over = terminated or truncated
        frames.append(as_frame(agent.render()))
    agent.close()
    return frames


def cart_pole() -> list[Frame]:
    """Draw Gymnasium's CartPole by its own code, with random pushes: 600 x 400 pixels, flat colours, smoothed lines."""
    import gymnasium

    env: Any = gymnasium.make("CartPole-v1", render_mode="rgb_array")
    pushes = random.Random(7)
    frames, over = [], True
    for _ in range(FRAMES):
        if over:
            env.reset(seed=7)
        _, _, terminated, truncated, _ = env.step(pushes.randrange(2))
        over = terminated or truncated
        frames.append(as_frame(env.render()))
    env.close()
    return frames


def texture(width: int, height: int = 400) -> Frame:
    """Make coloured noise of several sizes, which looks like grass and gravel."""
    noise = np.random.default_rng(7)
    mixed = np.full((height, width, 3), (110.0, 120.0, 90.0))
    for size in (1, 2, 4, 8, 16):
        shape = (height // size + 1, width // size + 1)
        grey = noise.normal(scale=10, size=(*shape, 1)) + noise.normal(scale=2, size=(*shape, 3))
        mixed += grey.repeat(size, 0).repeat(size, 1)[:height, :width]
    return mixed.clip(0, 255).astype(np.uint8)


def scrolling_texture() -> list[Frame]:
    """Make a texture of 600 x 400 pixels that moves by three pixels a frame, so that nearly all pixels change."""
    whole = texture(600 + 3 * FRAMES)
    return [np.ascontiguousarray(whole[:, 3 * number : 3 * number + 600]) for number in range(FRAMES)]


KINDS: dict[str, Callable[[], list[Frame]]] = {
    "Ms. Pac-Man": ms_pacman,
    "CartPole, 600 x 400": cart_pole,
    "scrolling texture, 600 x 400": scrolling_texture,
}
