"""examples/tamer: the car learns from a teacher who is slow and sometimes wrong, and learns nothing without one."""

from __future__ import annotations

import heapq
from typing import Any

import numpy as np
import pytest

EPISODES = 8
TO_THE_END = 200
"""Steps of an episode in which the car does not reach the flag."""


class Teacher:
    """A teacher who judges one step in twelve, 0.2 to 0.8 seconds later: did the car push the way that it rolled?"""

    def __init__(self, seed: int, rate: int, *, wrong: float = 0.1) -> None:
        self._chance, self._rate, self._wrong = np.random.default_rng(seed), rate, wrong
        self._words: list[tuple[float, str]] = []
        self.said = 0

    def watch(self, step: int, velocity: float, action: int) -> None:
        if abs(velocity) < 0.005 or self._chance.random() > 1 / 12:
            return
        right = (action == 2) == (velocity > 0) and action != 1
        if self._chance.random() < self._wrong:
            right = not right
        heapq.heappush(self._words, (step + self._chance.uniform(0.2, 0.8) * self._rate, "good" if right else "bad"))

    def speak(self, agent: Any, step: int) -> None:
        while self._words and self._words[0][0] <= step:
            agent.feedback(heapq.heappop(self._words)[1])
            self.said += 1


def lengths(agent: Any, seed: int, teacher: Teacher | None) -> list[int]:
    """Play the episodes; return how many steps each one took."""
    agent.start("MountainCar-v0")
    found, clock = [], 0
    for episode in range(EPISODES):
        agent.reset(1000 * seed + episode)
        for step in range(1, TO_THE_END + 1):
            clock += 1
            if teacher:
                teacher.speak(agent, clock)  # what is said between two steps is heard before the second
            velocity = float(agent.state[1])
            _, _, terminated, truncated, info = agent.step(1)
            if teacher:
                teacher.watch(clock, velocity, info["action"])
            if terminated or truncated:
                found.append(step)
                break
    agent.close()
    return found


@pytest.mark.parametrize("seed", range(1, 6))
def test_without_a_teacher_the_car_never_reaches_the_flag(load_module: Any, seed: int) -> None:
    assert lengths(load_module("tamer", "agent").Agent(), seed, None) == [TO_THE_END] * EPISODES


def test_with_a_teacher_the_car_learns_to_reach_the_flag(load_module: Any) -> None:
    """The teacher says less than a word a second, one in ten wrong. Ten cars reach the flag in four of five last episodes."""
    module = load_module("tamer", "agent")
    last = []
    for seed in range(1, 11):
        teacher = Teacher(seed, rate=10)
        last += lengths(module.Agent(), seed, teacher)[-3:]
        assert teacher.said < 110
    assert sum(steps < TO_THE_END for steps in last) >= 0.8 * len(last)


def test_with_a_teacher_who_is_always_wrong_the_car_does_not_learn_the_way(load_module: Any) -> None:
    teacher = Teacher(1, rate=10, wrong=1.0)
    assert lengths(load_module("tamer", "agent").Agent(), 1, teacher)[-3:] == [TO_THE_END] * 3
    assert teacher.said > 20


def learner(load_module: Any, *, step_seconds: float) -> tuple[Any, Any]:
    module = load_module("tamer", "tamer")
    features = module.Bumps(np.zeros(1), np.ones(1), 5)
    return module.Tamer(features, 2, step_seconds, rate=0.5), np.linspace(0, 1, 11)[:, None]


def test_a_word_counts_for_the_steps_shortly_before_it(load_module: Any) -> None:
    """Of steps of 0.2 s, the three that were seen 0.2 to 0.8 s ago share a word. The newest gets nothing of it."""
    tamer, states = learner(load_module, step_seconds=0.2)
    credits = [tamer._credit(age) for age in range(6)]
    assert credits == pytest.approx([0, 1 / 3, 1 / 3, 1 / 3, 0, 0])
    tamer.took(states[0], 0)
    tamer.took(states[10], 1)
    tamer.hear(1.0)
    assert tamer.predict(states[0])[0] > 0
    assert tamer.predict(states[10])[1] == 0


def test_the_newest_of_slow_steps_gets_the_whole_word(load_module: Any) -> None:
    tamer, _ = learner(load_module, step_seconds=1.0)
    assert [tamer._credit(age) for age in range(3)] == pytest.approx([1, 0, 0])


def test_the_prediction_becomes_the_teachers_word_and_the_other_action_is_chosen(load_module: Any) -> None:
    tamer, states = learner(load_module, step_seconds=1.0)
    for _ in range(200):
        tamer.took(states[5], 1)
        tamer.hear(-1.0)
    assert tamer.predict(states[5])[1] == pytest.approx(-1, abs=0.01)
    assert tamer.choose(states[5], last=1) == 0


def test_a_word_in_a_new_episode_does_not_count_for_the_steps_of_the_last_one(load_module: Any) -> None:
    tamer, states = learner(load_module, step_seconds=1.0)
    tamer.took(states[5], 1)
    tamer.begin()
    tamer.hear(1.0)
    assert tamer.predict(states[5]).tolist() == [0, 0]


def test_a_bot_plays_the_example_to_the_end(play_example: Any) -> None:
    played = play_example("tamer", startingFrameRate=90, maxEpisodes=2, betweenEpisodes=0)
    assert [lines[-1]["kind"] for lines in played.recordings] == ["end", "end"]
    assert {step["by"] for step in played.steps()} == {"agent"}
    assert {step["human"] for step in played.steps()} == {None}
    assert all(len(step["info"]["predicted"]) == 3 for step in played.steps())
