"""COACH: an agent that takes "good" and "bad" as advice on how to behave better than it does now.

The algorithm is the real-time form of Convergent Actor-Critic by Humans: James MacGlashan, Mark K. Ho, Robert Loftin,
Bei Peng, Guan Wang, David L. Roberts, Matthew E. Taylor and Michael L. Littman, "Interactive Learning from
Policy-Dependent Human Feedback" (ICML 2017, arXiv:1701.06049). Its ideas that are here:

* What people say depends on what the learner usually does: they praise an action of a beginner, and do not praise the
  same action later. Such feedback is an advantage: how much better an action is than the present policy. So it takes
  the critic's place in an actor-critic, and no reward is needed.
* The policy climbs its gradient: after a word, each parameter moves along the gradient of log(policy), times the word.
* An eligibility trace keeps the gradients of the steps before, so that a word also counts for the steps that led there.
* People are slow: a step enters the trace `delay` steps later, when the person has had time to judge it.

The policy is a softmax of preferences, which are linear in features of the state.
"""

from __future__ import annotations

from collections import deque

import numpy as np


class Coach:
    """The learner.

    `rate` is how much one word changes the policy. At each step the trace is multiplied by `decay`. A step enters it
    `delay` steps later.
    """

    def __init__(self, features: int, actions: int, rate: float, decay: float, delay: int) -> None:
        self._rate, self._decay = rate, decay
        self._weights = np.zeros((actions, features))
        self._trace = np.zeros_like(self._weights)
        self._unjudged: deque[tuple[np.ndarray, int]] = deque()
        self._delay = delay

    def probabilities(self, features: np.ndarray) -> np.ndarray:
        """Return the probability of each action in a state with these features."""
        preferences = self._weights @ features
        weights = np.exp(preferences - preferences.max())
        return weights / weights.sum()

    def choose(self, features: np.ndarray, chance: np.random.Generator) -> int:
        """Draw an action from the policy, and return it."""
        return int(chance.choice(len(self._weights), p=self.probabilities(features)))

    def took(self, features: np.ndarray, action: int) -> None:
        """Remember the action. It enters the trace when the person has had time to judge it."""
        self._trace *= self._decay
        self._unjudged.append((features, action))
        if len(self._unjudged) > self._delay:
            self._trace += self._gradient(*self._unjudged.popleft())

    def begin(self) -> None:
        """Begin an episode: words are no longer about the previous episode."""
        self._trace[:] = 0
        self._unjudged.clear()

    def hear(self, word: float) -> None:
        """Learn from a word: 1 is good, -1 is bad."""
        self._weights += self._rate * word * self._trace

    def _gradient(self, features: np.ndarray, action: int) -> np.ndarray:
        """Return the gradient of log(probability of the action) by the weights, under the present policy."""
        towards = -self.probabilities(features)
        towards[action] += 1
        return np.outer(towards, features)
