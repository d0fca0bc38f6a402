"""examples/coach: the robot learns from a teacher who judges its moves by what it usually does."""

from __future__ import annotations

import heapq
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

EPISODES = 10
RATE = 2
"""Steps per second."""


class Teacher:
    """A teacher who says, 0.2 to 0.8 seconds after every second move, whether it was better or worse than the policy.

    A word is the sign of the advantage, as in the paper. This teacher says nothing about a move that is about as good
    as the learner's average one. One word in twenty is wrong.
    """

    def __init__(self, garden: Any, seed: int) -> None:
        self._garden, self._chance = garden, np.random.default_rng(seed)
        self._away = dict(distances(garden))
        self._words: list[tuple[float, str]] = []
        self.said = 0

    def value_of(self, place: Any, move: int) -> float:
        there = self._garden.beside(place, move)
        return -self._away[there] - 3 * (there in self._garden.FLOWERS)

    def watch(self, step: int, place: Any, move: int, probabilities: np.ndarray) -> None:
        if self._chance.random() > 0.5:
            return
        usual = sum(share * self.value_of(place, other) for other, share in enumerate(probabilities))
        better = self.value_of(place, move) - usual
        if abs(better) < 0.3:
            return
        good = (better > 0) != (self._chance.random() < 0.05)
        heapq.heappush(self._words, (step + self._chance.uniform(0.2, 0.8) * RATE, "good" if good else "bad"))

    def speak(self, agent: Any, step: float) -> None:
        while self._words and self._words[0][0] <= step:
            agent.feedback(heapq.heappop(self._words)[1])
            self.said += 1


def distances(garden: Any) -> Iterator[tuple[Any, int]]:
    """Yield each place with the number of moves from there to the station, around the flowers."""
    reached, edge, length = {garden.STATION}, [garden.STATION], 0
    while edge:
        yield from ((place, length) for place in edge)
        onward = [place for place in edge if place not in garden.FLOWERS]
        edge = [
            (column, row)
            for column in range(garden.WIDTH)
            for row in range(garden.HEIGHT)
            if (column, row) not in reached
            and any(garden.beside((column, row), move) in onward for move in range(len(garden.MOVES)))
        ]
        reached.update(edge)
        length += 1


def play_episodes(agent: Any, garden: Any, seed: int, teacher: Teacher | None) -> list[tuple[float, bool]]:
    """Play the episodes; return each one's score, and whether the robot reached its station."""
    agent.start("garden")
    found, clock = [], 0
    for episode in range(EPISODES):
        place, _ = agent.reset(1000 * seed + episode)
        score, over = 0.0, False
        while not over:
            clock += 1
            if teacher:
                teacher.speak(agent, clock)  # what is said between two steps is heard before the second
            here = place
            place, reward, terminated, truncated, info = agent.step(0)
            score, over = score + reward, terminated or truncated
            if teacher:
                teacher.watch(clock, here, info["action"] - 1, info["probabilities"])
        if teacher:
            teacher.speak(agent, float("inf"))  # before the next reset
        found.append((score, place == garden.STATION))
    return found


def last_three(load_module: Any, *, with_teacher: bool) -> tuple[float, float]:
    """Return the mean score of ten robots' last three episodes, and the share of these in which a robot came home."""
    garden, module = load_module("coach", "garden"), load_module("coach", "agent")
    found = []
    for seed in range(1, 11):
        teacher = Teacher(garden, seed) if with_teacher else None
        found += play_episodes(module.Agent(), garden, seed, teacher)[-3:]
        assert teacher is None or teacher.said < 150  # fewer than one word in two steps
    scores, home = zip(*found, strict=True)
    return float(np.mean(scores)), float(np.mean(home))


def test_with_a_teacher_the_robot_learns_to_come_home_around_the_flowers(load_module: Any) -> None:
    score, home = last_three(load_module, with_teacher=True)
    assert score > 2.5  # 5 is the best
    assert home >= 0.8


def test_without_a_teacher_the_robot_learns_nothing(load_module: Any) -> None:
    score, home = last_three(load_module, with_teacher=False)
    assert score < -4
    assert home <= 0.2


def learner(load_module: Any, **more: Any) -> tuple[Any, np.ndarray]:
    settings = {"features": 3, "actions": 2, "rate": 1.0, "decay": 0.5, "delay": 0, **more}
    return load_module("coach", "coach").Coach(**settings), np.eye(3)


def test_a_word_makes_the_move_before_it_more_or_less_likely(load_module: Any) -> None:
    for word, more in ((1.0, True), (-1.0, False)):
        coach, states = learner(load_module)
        coach.took(states[0], 1)
        coach.hear(word)
        assert (coach.probabilities(states[0])[1] > 0.5) == more
        assert coach.probabilities(states[1]).tolist() == [0.5, 0.5]


def test_a_word_moves_along_the_gradient_of_the_policy(load_module: Any) -> None:
    coach, states = learner(load_module)
    coach.took(states[0], 1)
    by_differences = np.zeros((2, 3))
    for place in np.ndindex(2, 3):
        moved, _ = learner(load_module)
        moved._weights[place] += 1e-6
        by_differences[place] = (np.log(moved.probabilities(states[0])[1]) - np.log(0.5)) / 1e-6
    assert coach._trace == pytest.approx(by_differences, abs=1e-5)


def test_a_word_counts_less_for_earlier_moves(load_module: Any) -> None:
    coach, states = learner(load_module)
    for state in states:
        coach.took(state, 1)
    coach.hear(1.0)
    weights = [coach._weights[1] @ state for state in states]
    assert weights == pytest.approx([0.125, 0.25, 0.5])


def test_a_word_does_not_count_for_a_move_that_the_person_cannot_have_judged_yet(load_module: Any) -> None:
    coach, states = learner(load_module, delay=1, decay=0.0)
    coach.took(states[0], 1)
    coach.took(states[1], 1)
    coach.hear(1.0)
    assert coach.probabilities(states[0])[1] > 0.5
    assert coach.probabilities(states[1])[1] == 0.5


def test_a_word_in_a_new_episode_does_not_count_for_the_moves_of_the_last_one(load_module: Any) -> None:
    coach, states = learner(load_module)
    coach.took(states[0], 1)
    coach.begin()
    coach.hear(1.0)
    assert coach.probabilities(states[0]).tolist() == [0.5, 0.5]


def test_the_seed_repeats_an_episode(load_module: Any) -> None:
    agent = load_module("coach", "agent").Agent()
    agent.start("garden")
    played = []
    for _ in range(2):
        agent.reset(7)
        played.append([agent.step(0)[4]["action"] for _ in range(20)])
    assert played[0] == played[1]


def test_every_scene_can_be_drawn(load_module: Any) -> None:
    from hippodrome.trial.pictures.scene import as_scene

    agent = load_module("coach", "agent").Agent()
    agent.start("garden")
    agent.reset(1)
    for step in range(30):
        scene = as_scene(agent.render())
        assert scene.problems == ()
        agent.feedback("good" if step % 2 else "bad")
        agent.step(0)


def test_a_bot_plays_the_example_to_the_end(play_example: Any) -> None:
    played = play_example("coach", startingFrameRate=60, maxEpisodes=3, betweenEpisodes=0)
    assert [lines[-1]["kind"] for lines in played.recordings] == ["end", "end", "end"]
    assert {step["by"] for step in played.steps()} == {"agent"}
    assert {step["actionName"] for step in played.steps()} == {"up", "right", "down", "left"}
