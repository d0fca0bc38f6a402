"""Train the policies of this study: `python train.py`. It takes half a minute on one core, and writes `policies/`.

A small network learns to play like the opponent that the package brings, which was evolved by David Ha. It learns by
DAgger (Ross et al. 2011, https://arxiv.org/abs/1011.0686): the network plays, the opponent of the package says for each
observation what it would have done, and the network learns from all of these. Hundreds of games are played
at once, as arrays, with the package's own physics. Needs `pip install onnx==1.23.2` beside requirements.txt.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper
from slime_volleyball.baseline_policy import BaselinePolicy
from slime_volleyball.core import constants, physics
from slime_volleyball.slimevolley_env import SlimeVolleyEnv
from volleyball import ACTIONS, MIRRORED

Array = Any
Chooser = Callable[[Array], Array]
"""Chooses the actions of one player from the observations of many games, a row for each game."""

BUTTONS = np.array(SlimeVolleyEnv.action_table, np.float32)
"""The pressed buttons (forwards, backwards, jump) of each action."""

INPUTS, HIDDEN, OUTPUTS = 12, 48, len(ACTIONS)
SIDES = (-1, 1)
"""The sign of x on the half of the left player, and on the half of the right one."""


class Games:
    """Many games at once: the last axis of every array is the game. Players are 0 (left) and 1 (right)."""

    def __init__(self, count: int, chance: np.random.Generator) -> None:
        self._count, self._chance = count, chance
        self._place = [_column(count, side * physics.AGENT_RIGHT_INIT_X, physics.AGENT_INIT_Y) for side in SIDES]
        self._speed = [_column(count, 0, 0) for _ in SIDES]
        self._ball, self._ball_speed = _column(count, 0, 0), _column(count, 0, 0)
        self._wait = np.zeros(count, int)
        self._serve(np.ones(count, bool))

    def _serve(self, where: Array) -> None:
        """Begin a point in these games."""
        self._ball[:, where] = np.array([[0], [physics.BALL_INIT_Y]])
        self._ball_speed[:, where] = self._chance.uniform([[-20], [10]], [[20], [25]], (2, int(where.sum())))
        self._wait[where] = constants.INIT_DELAY_FRAMES

    def observations(self, player: int) -> Array:
        """Return a row for each game, as the package's `compute_observations` makes them."""
        own, opponent = np.array([[SIDES[player]], [1]]), np.array([[-SIDES[player]], [1]])
        mine, theirs = (self._place[player], self._speed[player]), (self._place[1 - player], self._speed[1 - player])
        parts = [part * own for part in (*mine, self._ball, self._ball_speed)] + [part * opponent for part in theirs]
        return (np.concatenate(parts) / 10).T.astype(np.float32)

    def step(self, left: Array, right: Array) -> Array:
        """Take an action of each player in each game: forwards or backwards. Return the right player's rewards."""
        for player, actions in enumerate((left, right)):
            wanted = physics.actions_to_desired_vel(BUTTONS[actions]).T
            self._place[player], self._speed[player], _ = physics.update_agent(
                self._place[player], self._speed[player], wanted, np.zeros(self._count, int), np.float32(SIDES[player])
            )
        waits, before = self._wait > 0, self._ball
        ball, speed = physics.ball_apply_acceleration_and_move(self._ball, self._ball_speed, waits)
        stub = np.array([physics.FENCE_STUB_X, physics.FENCE_STUB_Y], np.float32)
        for place, radius in ((place, physics.AGENT_RADIUS) for place in self._place):
            ball, speed = _bounce(ball, speed, place, radius)
        ball, speed = _bounce(ball, speed, stub, physics.FENCE_STUB_R)
        self._ball, self._ball_speed, points = physics.ball_check_edges(ball, speed, before)
        self._wait = np.where(waits, self._wait - 1, self._wait)
        if points.any():
            self._serve(points != 0)
        return points


def _column(count: int, x: float, y: float) -> Array:
    return np.tile(np.array([[x], [y]], np.float32), count)


def _bounce(ball: Array, speed: Array, place: Array, radius: float) -> tuple[Array, Array]:
    ball, speed, _ = physics.ball_check_collision(ball, speed, place, radius, np.zeros(2, np.float32), np.float32(1))
    return ball, speed


class Teacher:
    """The opponent of the package, in many games at once. It remembers its last output."""

    def __init__(self, count: int) -> None:
        given = BaselinePolicy()
        self._weight, self._bias = given.weight.T, given.bias
        self._output = np.zeros((count, given.nOutput))

    def __call__(self, observations: Array) -> Array:
        """Return the opponent's actions. Forwards and backwards at once count as neither: there is no such action."""
        inputs = np.concatenate([observations[:, :8], self._output], axis=1)
        self._output = np.tanh(inputs @ self._weight + self._bias)
        forwards, backwards, jumps = (self._output[:, :3] > 0.75).T
        ahead, back = forwards & ~backwards, backwards & ~forwards
        return np.select([ahead & jumps, ahead, back & jumps, back], [2, 1, 4, 5], np.where(jumps, 3, 0))


class Network:
    """A network with two layers. Its action is the one with the largest of six values."""

    def __init__(self, chance: np.random.Generator) -> None:
        first, second = chance.normal(0, 1, (INPUTS, HIDDEN)), chance.normal(0, HIDDEN**-0.5, (HIDDEN, OUTPUTS))
        self.weights = [
            part.astype(np.float32) for part in (first, chance.normal(0, 1, HIDDEN), second, np.zeros(OUTPUTS))
        ]
        self._means = [np.zeros_like(part) for part in self.weights]
        self._squares = [np.zeros_like(part) for part in self.weights]
        self._steps = 0

    def __call__(self, observations: Array) -> Array:
        return self._values(observations)[1].argmax(1)

    def _values(self, observations: Array) -> tuple[Array, Array]:
        first, bias, second, last = self.weights
        hidden = np.tanh(observations @ first + bias)
        return hidden, hidden @ second + last

    def learn(self, observations: Array, actions: Array, rate: float) -> float:
        """Take one step of Adam towards these actions. Return the share of them that the network chose before."""
        hidden, values = self._values(observations)
        right = float((values.argmax(1) == actions).mean())
        shares = np.exp(values - values.max(1, keepdims=True))
        shares /= shares.sum(1, keepdims=True)
        shares[np.arange(len(actions)), actions] -= 1
        shares /= len(actions)
        behind = shares @ self.weights[2].T * (1 - hidden**2)
        slopes = [observations.T @ behind, behind.sum(0), hidden.T @ shares, shares.sum(0)]
        self._steps += 1
        for number, slope in enumerate(slopes):
            self._means[number] += 0.1 * (slope - self._means[number])
            self._squares[number] += 0.001 * (slope**2 - self._squares[number])
            size = np.sqrt(self._squares[number] / (1 - 0.999**self._steps)) + 1e-8
            self.weights[number] -= rate * self._means[number] / (1 - 0.9**self._steps) / size
        return right


def play(left: Chooser, right: Chooser, games: int, steps: int, seed: int) -> tuple[float, Array, Array]:
    """Play. Return the right player's mean score, their observations, and the teacher's actions for these.

    The score of a game is the points that the player has won, less those that they have lost.
    """
    world, teacher = Games(games, np.random.default_rng(seed)), Teacher(games)
    points, observed, wanted = 0.0, [], []
    for _ in range(steps):
        seen = world.observations(1)
        observed.append(seen)
        wanted.append(teacher(seen))
        points += float(world.step(left(world.observations(0)), right(seen)).mean())
    return points, np.concatenate(observed), np.concatenate(wanted)


def train(rounds: int, seed: int, games: int = 200, steps: int = 500) -> Network:
    chance = np.random.default_rng(seed)
    network = Network(chance)

    def at_random(seen: Array) -> Array:
        return chance.integers(OUTPUTS, size=len(seen))

    lessons = [
        play(Teacher(games), Teacher(games), games, steps, seed)[1:],
        play(at_random, Teacher(games), games, steps, seed + 1)[1:],
    ]
    for number in range(rounds):
        observed, wanted = (np.concatenate(parts) for parts in zip(*lessons, strict=True))
        rate = 3e-3 * (1 - number / rounds)
        order = chance.permutation(len(wanted))[:300_000]
        right = [network.learn(observed[part], wanted[part], rate) for part in np.array_split(order, len(order) // 500)]
        # Its opponents are the teacher, itself, and one that acts at random.
        other = [Teacher(games), network, at_random][number % 3]
        points, *lesson = play(other, network, games, steps, seed + 2 + number)
        lessons.append((lesson[0], lesson[1]))
        if number % 3 == 0:
            said = f"{np.mean(right):.0%} of the actions are the teacher's, {points:+.2f} points against it"
            print(f"round {number + 1}: {said}", flush=True)
    return network


def export(network: Network, path: Path, *, left: bool, about: str) -> None:
    """Write the network as ONNX: observation (batch, 12) to the values of the actions (batch, 6).

    The network's second action is forwards. For the player of the right half that is to the left, as in the
    environment; for the left half the values are exchanged.
    """
    first, bias, second, last = network.weights
    if left:
        second, last = second[:, MIRRORED], last[list(MIRRORED)]
    weights = {"first": first, "first_bias": bias, "second": second, "second_bias": last}
    graph = helper.make_graph(
        [
            helper.make_node("Gemm", ["observation", "first", "first_bias"], ["sum"]),
            helper.make_node("Tanh", ["sum"], ["hidden"]),
            helper.make_node("Gemm", ["hidden", "second", "second_bias"], ["logits"]),
        ],
        "slime_volleyball",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", INPUTS])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, ["batch", OUTPUTS])],
        [numpy_helper.from_array(values, name) for name, values in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9, doc_string=about)
    onnx.checker.check_model(model)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(model.SerializeToString())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=30, help="how often the network plays and then learns")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--into", type=Path, default=Path(__file__).parent / "policies")
    given = parser.parse_args()
    began = time.monotonic()
    network = train(given.rounds, given.seed)
    about = f"train.py --rounds {given.rounds} --seed {given.seed}"
    export(network, given.into / "left.onnx", left=True, about=about)
    export(network, given.into / "right.onnx", left=False, about=about)
    print(f"{given.into}: left.onnx and right.onnx, after {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
