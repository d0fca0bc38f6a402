"""Train the partner of this study: `python train.py`. It takes two minutes on one core; it writes `policies/cook.onnx`.

A small network learns to do what the cook by rules (`cook.py`) would do, from what a chef observes: behaviour cloning,
then DAgger (Ross et al. 2011, https://arxiv.org/abs/1011.0686): the network plays, the cook says what it would have
done, and the network learns from both. Partners in training are the cook, a chef that stands still, one that moves at
random, and the network itself. Needs `pip install onnx==1.23.2` beside requirements.txt.
"""

from __future__ import annotations

import argparse
import random
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cook
import numpy as np
import onnx
from kitchen import ACTIONS, CRAMPED, NOOP, Kitchen, Overcooked
from onnx import TensorProto, helper, numpy_helper

Array = Any
Player = Callable[[Kitchen, int, Array], int]
"""Chooses an action from the state of the kitchen, the number of the chef, and the chef's observation."""

HIDDEN = 64
EPISODE = 250
"""The steps of an episode in training. It is short, so that training has many beginnings."""


@dataclass
class Network:
    """A network with two layers. Inputs are scaled by the mean and deviation of the observations in training."""

    mean: Array
    deviation: Array
    weights: list[Array]

    @classmethod
    def new(cls, observations: Array, chance: np.random.Generator) -> Network:
        sizes = observations.shape[1], HIDDEN, len(ACTIONS)
        weights = [
            chance.normal(0, sizes[0] ** -0.5, sizes[:2]),
            np.zeros(HIDDEN),
            chance.normal(0, HIDDEN**-0.5, sizes[1:]),
            np.zeros(sizes[2]),
        ]
        mean, deviation = observations.mean(0), observations.std(0)
        return cls(mean, np.where(deviation > 1e-6, deviation, 1.0), [part.astype(np.float32) for part in weights])

    def values(self, observations: Array) -> Array:
        first, bias, second, last = self.weights
        return np.maximum((observations - self.mean) / self.deviation @ first + bias, 0) @ second + last

    def act(self, kitchen: Kitchen, chef: int, observation: Array) -> int:
        return int(self.values(observation[None])[0].argmax())

    def learn(self, observations: Array, labels: Array, chance: np.random.Generator, epochs: int) -> float:
        """Learn to choose these actions, by Adam. Return the share of them that the network now chooses."""
        means = [np.zeros_like(part) for part in self.weights]
        squares = [np.zeros_like(part) for part in self.weights]
        inputs = ((observations - self.mean) / self.deviation).astype(np.float32)
        step = 0
        for epoch in range(epochs):
            rate = 2e-3 * (1 - epoch / epochs)
            for batch in np.array_split(chance.permutation(len(labels)), max(1, len(labels) // 256)):
                step += 1
                for number, slope in enumerate(self._slopes(inputs[batch], labels[batch])):
                    means[number] += 0.1 * (slope - means[number])
                    squares[number] += 0.001 * (slope**2 - squares[number])
                    size = np.sqrt(squares[number] / (1 - 0.999**step)) + 1e-8
                    self.weights[number] -= rate * means[number] / (1 - 0.9**step) / size
        return float((self.values(observations).argmax(1) == labels).mean())

    def _slopes(self, inputs: Array, labels: Array) -> list[Array]:
        first, bias, second, last = self.weights
        hidden = np.maximum(inputs @ first + bias, 0)
        values = hidden @ second + last
        shares = np.exp(values - values.max(1, keepdims=True))
        shares /= shares.sum(1, keepdims=True)
        shares[np.arange(len(labels)), labels] -= 1
        shares /= len(labels)
        behind = shares @ second.T * (hidden > 0)
        return [inputs.T @ behind, behind.sum(0), hidden.T @ shares, shares.sum(0)]


def idle(kitchen: Kitchen, chef: int, observation: Array) -> int:
    return NOOP


def at_random(chance: random.Random) -> Player:
    return lambda kitchen, chef, observation: chance.randrange(len(ACTIONS))


def by_rules(chance: random.Random, astray: float) -> Player:
    """Return the cook by rules, who sometimes takes a random action: so the network learns to go on after mistakes."""
    return lambda kitchen, chef, observation: (
        chance.randrange(len(ACTIONS)) if chance.random() < astray else cook.act(kitchen, chef)
    )


def play(players: tuple[Player, Player], steps: int, seed: int, layout: str = CRAMPED) -> tuple[Array, Array, float]:
    """Play. Return the observations, the actions of the cook by rules for them, and the soups in 100 steps."""
    env, observed, labels, soups = Overcooked(layout, max_steps=EPISODE), [], [], 0
    for number in range(steps):
        if number % EPISODE == 0:
            soups += env.soups
            observations, _ = env.reset(seed=seed + number)
        kitchen = env.kitchen()
        for chef in env.possible_agents:
            observed.append(observations[chef])
            labels.append(cook.act(kitchen, chef))
        observations, *_ = env.step({chef: players[chef](kitchen, chef, observations[chef]) for chef in (0, 1)})
    return np.array(observed, np.float32), np.array(labels), 100 * (soups + env.soups) / steps


def train(rounds: int, steps: int, seed: int, layout: str = CRAMPED) -> Network:
    chance, dice = np.random.default_rng(seed), random.Random(seed)
    teacher = by_rules(dice, astray=0.15)
    others = [teacher, idle, at_random(dice)]
    sets = [play((teacher, other), steps, seed + 1000 * number, layout)[:2] for number, other in enumerate(others)]
    network = Network.new(sets[0][0], chance)
    for number in range(rounds):
        observations, labels = (np.concatenate(parts) for parts in zip(*sets, strict=True))
        right = network.learn(observations, labels, chance, epochs=8 if number < rounds - 1 else 25)
        print(f"round {number + 1}: {right:.1%} of {len(labels)} actions are the cook's", flush=True)
        if number == rounds - 1:
            break
        # It plays in either place, with each partner in turn.
        partner: Player = [*others, network.act][(number + 1) % 4]
        mine = by_network(network, dice, astray=0.05)
        pair = (mine, partner) if number % 2 else (partner, mine)
        found = play(pair, steps, seed + 100_000 * (number + 1), layout)
        sets.append(found[:2])
        print(f"  {found[2]:.2f} soups in 100 steps", flush=True)
    return network


def by_network(network: Network, chance: random.Random, astray: float) -> Player:
    return lambda kitchen, chef, observation: (
        chance.randrange(len(ACTIONS)) if chance.random() < astray else network.act(kitchen, chef, observation)
    )


def export(network: Network, path: Path, about: str) -> None:
    """Write the network as ONNX: observation (batch, numbers) to the values of the actions (batch, 6)."""
    first, bias, second, last = network.weights
    # The scaling is part of the first layer.
    scaled = first / network.deviation[:, None]
    weights = {
        "first": scaled,
        "first_bias": bias - network.mean @ scaled,
        "second": second,
        "second_bias": last,
    }
    graph = helper.make_graph(
        [
            helper.make_node("Gemm", ["observation", "first", "first_bias"], ["sum"]),
            helper.make_node("Relu", ["sum"], ["hidden"]),
            helper.make_node("Gemm", ["hidden", "second", "second_bias"], ["logits"]),
        ],
        "overcooked",
        [helper.make_tensor_value_info("observation", TensorProto.FLOAT, ["batch", len(network.mean)])],
        [helper.make_tensor_value_info("logits", TensorProto.FLOAT, ["batch", len(ACTIONS)])],
        [numpy_helper.from_array(values.astype(np.float32), name) for name, values in weights.items()],
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9, doc_string=about)
    onnx.checker.check_model(model)
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(model.SerializeToString())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=9, help="how often the network learns")
    parser.add_argument("--steps", type=int, default=1500, help="steps that are played before the network learns again")
    parser.add_argument("--layout", default=CRAMPED, help="the kitchen, by the package's name for it")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--into", type=Path, default=Path(__file__).parent / "policies")
    given = parser.parse_args()
    began = time.monotonic()
    network = train(given.rounds, given.steps, given.seed, given.layout)
    export(
        network,
        given.into / "cook.onnx",
        f"train.py --rounds {given.rounds} --steps {given.steps} --layout {given.layout} --seed {given.seed}",
    )
    print(f"{given.into / 'cook.onnx'}, after {time.monotonic() - began:.0f} s")


if __name__ == "__main__":
    main()
