"""The agent of the example study: the participant plays the environment of config.yml. Start your own from here.

Hippodrome makes one `Agent` for a participant and calls `start` once, then `reset` at the beginning of each episode.
For every frame it calls `step` with the participant's action and `render` for the picture. To let your agent act,
change the action in `step` before the environment takes it.
"""

import ale_py
import gymnasium
import numpy as np

gymnasium.register_envs(ale_py)

NATIVE_FRAMES = 2
"""Frames of the console in one step. The console makes 60 a second, so 30 steps a second are its real speed."""

GREEN = 1
"""The index of the color channel that contributes most to a pixel's brightness."""


class Agent:
    def start(self, game):
        """Make the environment and return it. `game` is `trial.game` of config.yml."""
        # By default the environment repeats each action for 4 frames and, one time in four, ignores a new one. To a
        # person this feels like a bad keyboard, so here every frame takes the key that is held now.
        self.env = gymnasium.make(
            game, render_mode="rgb_array", frameskip=1, repeat_action_probability=0.0, disable_env_checker=True
        )
        self.screens = []
        return self.env

    def reset(self, seed=None):
        """Begin an episode. The recorded seed and actions repeat it exactly."""
        observation, info = self.env.reset(seed=seed)
        self.screens = [self.env.render()]
        return observation, info

    def step(self, action):
        """Take the participant's action (an index into actionSpace; 0 does nothing)."""
        total = 0.0
        for _ in range(NATIVE_FRAMES):
            observation, reward, terminated, truncated, info = self.env.step(action)
            self.screens.append(observation)
            total += reward
            if terminated or truncated:
                break
        del self.screens[:-4]
        return observation, total, terminated, truncated, info

    def render(self):
        """The picture: height x width x 3 bytes.

        The console draws each ghost in only one frame of four; on a television the frames blur. A step has two frames,
        so the last frames of the steps would never show some ghosts. So each pixel is the brightest of the last four
        frames.
        """
        picture = self.screens[-1].copy()
        pixels = picture.reshape(-1, 3)
        for screen in self.screens[:-1]:
            others = screen.reshape(-1, 3)
            brighter = np.flatnonzero(others[:, GREEN] > pixels[:, GREEN])  # few pixels: indices are faster than a mask
            pixels[brighter] = others[brighter]
        return picture

    def close(self):
        self.env.close()
