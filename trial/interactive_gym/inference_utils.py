"""Drawing an action by a model's output."""

from __future__ import annotations

from typing import Any

import numpy as np


def sample_action_via_softmax(logits: Any) -> int:
    """An action, drawn by the softmax of its logits."""
    shares = np.exp(np.asarray(logits, float).reshape(-1) - np.max(logits))
    return int(np.random.choice(len(shares), p=shares / shares.sum()))
