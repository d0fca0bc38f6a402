"""Interactive Gym's function that draws an action by a model's output."""

from __future__ import annotations

from typing import Any

import numpy as np


def sample_action_via_softmax(logits: Any) -> int:
    """Draw the number of an action, with the probabilities of the softmax of `logits`."""
    weights = np.exp(np.asarray(logits, float).reshape(-1) - np.max(logits))
    return int(np.random.choice(len(weights), p=weights / weights.sum()))
