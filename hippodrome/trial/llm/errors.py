"""What may go wrong when a language model is asked."""

from __future__ import annotations

OWN = "hippodrome"
"""The type of the loopback address's own errors. No error of a model's API keeps it."""


class ModelError(Exception):
    """The model has not answered. The message says why, without words of prompts and answers."""


class CapReached(ModelError):
    """The game has used up `llm.maxCalls` or `llm.maxTokens`."""


class ModelUnavailable(ModelError):
    """The model cannot be reached, is too slow, has too much to do, or has broken off."""


class ModelRefused(ModelError):
    """The model's API refuses the request, or the model has declined to answer."""
