"""TAMER: an agent that learns from a person's "good" and "bad" alone.

The algorithm is that of W. Bradley Knox and Peter Stone, "Interactively shaping agents via human reinforcement: the
TAMER framework" (K-CAP 2009). Three of its ideas are here:

* The agent learns a model of the teacher: how much reinforcement H(state, action) the person will give. The game's own
  reward plays no part.
* It is greedy: it takes the action with the highest H. What a person says judges an action with all its consequences,
  so the agent need not look ahead.
* People are slow. A word is shared among the steps that it may be about: the share of a step is the probability that
  the word was about that step (credit assignment).

H is linear in features of the state, with weights of its own for each action.
"""

from __future__ import annotations

from collections import deque

import numpy as np

FASTEST, SLOWEST = 0.2, 0.8
"""The least and the most seconds in which a person reacts. All delays between them are taken as equally likely."""


class Bumps:
    """Features of a state: Gaussian bumps on a grid over the state space, which sum to 1.

    What the agent learns in a state also counts in states near it.
    """

    def __init__(self, low: np.ndarray, high: np.ndarray, each: int) -> None:
        self._low, self._span, self._each = low, high - low, each
        axes = np.meshgrid(*[np.linspace(0, 1, each)] * len(low), indexing="ij")
        self._centres = np.stack([axis.ravel() for axis in axes], axis=1)
        self.count = len(self._centres)

    def __call__(self, state: np.ndarray) -> np.ndarray:
        place = (np.asarray(state, float) - self._low) / self._span
        distances = ((self._centres - place) ** 2).sum(axis=1) * (self._each - 1) ** 2
        bumps = np.exp(-distances)
        return bumps / bumps.sum()


class Tamer:
    """The learner. `step_seconds` is the time for which a step is seen; `rate` is how much one word changes."""

    def __init__(self, features: Bumps, actions: int, step_seconds: float, rate: float) -> None:
        self._features, self._step_seconds, self._rate = features, step_seconds, rate
        self._weights = np.zeros((actions, features.count))
        self._recent: deque[tuple[int, np.ndarray]] = deque(maxlen=int(SLOWEST / step_seconds) + 1)  # newest first

    def predict(self, state: np.ndarray) -> np.ndarray:
        """Return H of each action: what the teacher would say, from -1 (bad) to 1 (good)."""
        return self._weights @ self._features(state)

    def choose(self, state: np.ndarray, last: int) -> int:
        """Return the action with the highest H; of equal ones the `last` action, so that a teacher can follow."""
        predicted = self.predict(state)
        best = np.flatnonzero(predicted >= predicted.max() - 1e-9)
        return last if last in best else int(best[0])

    def took(self, state: np.ndarray, action: int) -> None:
        """Remember the action, so that the next words can be about it."""
        self._recent.appendleft((action, self._features(state)))

    def begin(self) -> None:
        """Begin an episode: words are no longer about the previous episode."""
        self._recent.clear()

    def hear(self, word: float) -> None:
        """Learn from a word: 1 is good, -1 is bad."""
        credited = np.zeros_like(self._weights)
        for age, (action, features) in enumerate(self._recent):
            credited[action] += self._credit(age) * features
        error = word - (self._weights * credited).sum()
        self._weights += self._rate * error * credited

    def _credit(self, age: int) -> float:
        """Return the share of a word that belongs to a step after which `age` other steps were taken.

        The person saw that step from `age` to `age + 1` steps ago. The share is the probability of such a delay.
        """
        since, until = age * self._step_seconds, (age + 1) * self._step_seconds
        return max(0.0, min(until, SLOWEST) - max(since, FASTEST)) / (SLOWEST - FASTEST)
