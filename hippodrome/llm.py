"""The language model of a study, for agent.py: `ask` and what may go wrong (docs/talk.md)."""

from hippodrome.trial.llm.client import CapReached, ModelError, ModelRefused, ModelUnavailable, ask

__all__ = ["CapReached", "ModelError", "ModelRefused", "ModelUnavailable", "ask"]
