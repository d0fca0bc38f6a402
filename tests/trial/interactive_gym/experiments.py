"""Experiments for the tests, as researchers write them for Interactive Gym, and how they are run."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

from testing import processes

ALONE = """
import gymnasium
import helper
import eventlet

eventlet.monkey_patch()

from interactive_gym.configurations import configuration_constants, object_contexts
from interactive_gym.configurations.remote_config import RemoteConfig
from interactive_gym.server import callback, server_app

LEFT, NOOP, RIGHT = 0, 1, 2

class Watch(callback.GameCallback):
    def on_episode_start(self, remote_game):
        self.before = []
    def on_game_tick_start(self, remote_game):
        self.before.append((remote_game.tick_num, float(remote_game.env.unwrapped.state[0])))
    def on_game_tick_end(self, remote_game):
        remote_game.record("rewards", [remote_game.prev_actions, remote_game.prev_rewards])
    def on_episode_end(self, remote_game):
        return {"ticks": remote_game.tick_num, "before": len(self.before), "score": remote_game.episode_rewards[0]}

def env_creator(*args, **kwargs):
    return gymnasium.make("MountainCar-v0", render_mode=None, max_episode_steps=kwargs.get("steps", 20))

def draw(env, config):
    return [object_contexts.Circle("car", "#ff0000", helper.place(env), 0.5, config.game_width / 60).as_dict()]

config = (
    RemoteConfig()
    .policies(policy_mapping={"human": configuration_constants.PolicyTypes.Human})
    .environment(env_creator=env_creator, env_name="Mountain_Car", env_config={"steps": 20})
    .rendering(fps=60, env_to_state_fn=draw, hud_text_fn=lambda game: f"Tick {game.tick_num}")
    .gameplay(
        default_action=NOOP,
        action_mapping={"ArrowLeft": LEFT, "ArrowRight": RIGHT, ("a", "b"): RIGHT},
        num_episodes=2,
        callback=Watch(),
    )
    .hosting(port=0, host="0.0.0.0", max_ping=100)
    .user_experience(
        page_title="Mountain car",
        welcome_text="Hello {{ you }} & <friends>",
        instructions_html_file="how.html",
        game_page_text="Go & go",
        final_page_text="Bye",
        experiment_end_redirect_url="https://example.org/?a=1&id=",
        append_subject_id_to_redirect=True,
    )
)
"""
HELPER = """
def place(env):
    return (float(env.unwrapped.state[0]) + 1.2) / 1.8
"""
RUN = """
if __name__ == "__main__":
    server_app.run(config)
"""

TOGETHER = '''
import numpy as np
from gymnasium import spaces
from configurations import configuration_constants, object_contexts
from configurations.remote_config import RemoteConfig
from server import callback, server_app

class Fields:
    """Two players; each reward is the player's own action."""
    action_space = spaces.Dict({0: spaces.Discrete(3), 1: spaces.Discrete(3)})
    observation_space = spaces.Dict({0: spaces.Box(0, 99, (2,)), 1: spaces.Box(0, 99, (2,))})
    max_steps = 10
    def reset(self, seed=None, options=None):
        self.t = 0
        return self.seen(), {0: {}, 1: {}}
    def seen(self):
        return {player: np.array([self.t, player], np.float32) for player in (0, 1)}
    def step(self, actions):
        assert set(actions) == {0, 1}
        self.t += 1
        ended = {0: False, 1: False, "__all__": False}
        cut = dict.fromkeys(ended, self.t == self.max_steps)
        return self.seen(), {key: float(value) for key, value in actions.items()}, ended, cut, {0: {}, 1: {}}

def env_creator(*args, **kwargs):
    return Fields()

def draw(env, config):
    return [object_contexts.Text("t", str(env.t), 0.5, 0.5).as_dict()]

def load(name):
    return open(name).read().strip()

def infer(observation, policy):
    return int(policy)

class Log(callback.GameCallback):
    def on_game_tick_end(self, remote_game):
        remote_game.record("tick", [remote_game.tick_num, dict(remote_game.prev_actions), dict(remote_game.bot_players)])

config = (
    RemoteConfig()
    .policies(
        policy_mapping={0: configuration_constants.PolicyTypes.Human, 1: "brains/two.txt"},
        load_policy_fn=load,
        policy_inference_fn=infer,
        frame_skip=1,
    )
    .environment(env_creator=env_creator, env_name="fields")
    .rendering(fps=60, env_to_state_fn=draw)
    .gameplay(default_action=0, action_mapping={"ArrowUp": 1}, num_episodes=1, callback=Log(),
              input_mode=configuration_constants.InputModes.SingleKeystroke)
)
'''
PEOPLE = TOGETHER.replace('"brains/two.txt"', "configuration_constants.PolicyTypes.Human").replace(
    "config = (\n    RemoteConfig()",
    """config = (
    RemoteConfig()
    .hosting(max_ping=250, max_concurrent_games=3)
    .user_experience(
        waitroom_timeout=90_000,
        waitroom_timeout_redirect_url="https://example.org/alone?id=",
        experiment_end_redirect_url="https://example.org/done?id=",
        append_subject_id_to_redirect=True,
        game_page_html_fn=lambda game, subject: "Play well",
    )""",
)
"""TOGETHER, with two humans."""


def environment() -> dict[str, str]:
    """Return the variables of a process that finds `trial`."""
    return {**os.environ, "PYTHONPATH": str(processes.ROOT), "PYTHONDONTWRITEBYTECODE": "1"}


def run_experiment(folder: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    """Run `python -m hippodrome.trial.interactive_gym --no-run ARGUMENTS` in this folder, by default for `experiment.py`."""
    return subprocess.run(
        [sys.executable, "-m", "hippodrome.trial.interactive_gym", "--no-run", *(arguments or ["experiment.py"])],
        cwd=folder,
        env=environment(),
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
