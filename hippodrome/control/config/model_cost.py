"""What a study's language model can cost at most, by the caps and the price in config.yml.

It is about that much: a game counts the tokens of a request when its answer is there, so the last ones may go beyond.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hippodrome.control.config.config import Config


def sentence(config: Config, participants: int | None = None) -> str | None:
    """Return what the language model can cost for each participant, and for so many; None without a price.

    If `participants` is left out, it is the project's `maxParticipants`.
    """
    games = [cost for step in config.game_steps if (cost := _of_game(config, step.key)) is not None]
    if not games:
        return None
    place, people = f"{config.project.players} participants together", participants or config.project.max_participants
    person = sum(games)
    words = f"The language model costs about {_money(person)} at most for each participant"
    if config.project.has_sessions:
        words = f"The language model costs about {_money(person)} at most for {place}"
        person /= config.project.players
    if people:
        limit = "" if participants else " (maxParticipants)"
        words += f", and {_money(person * people)} for {people} participants{limit}"
    return f"{words}: llm.maxTokens in each game, at the higher of the two prices."


def note(config: Config, participants: int) -> str | None:
    """Return a note on an estimate that counts no language model; None if the study asks none."""
    if not any(_sections(config, step.key) for step in config.game_steps):
        return None
    words = sentence(config, participants) or "What the language model costs is not known: config.yml has no llm.price."
    return f"{words} The other figures are without it."


def _sections(config: Config, key: str) -> list[Mapping[str, Any]]:
    """The `llm` sections that hold for the games of a step."""
    step = next((one for one in config.design.steps if one.key == key), None)
    own = [section.trial.get("llm") for section in step.sections] if step else []
    return [section for section in (*own, config.trial.registered().get("llm")) if section]


def _of_game(config: Config, key: str) -> float | None:
    """What one participant's games of a step can cost; None if it has no model with a price."""
    known_costs = [cost for section in _sections(config, key) if (cost := _cost(section)) is not None]
    if not known_costs:
        return None
    step = next((one for one in config.design.steps if one.key == key), None)
    runs = config.design.blocks[step.block].length if step is not None and step.block is not None else 1
    return max(known_costs) * runs


def _cost(section: Mapping[str, Any]) -> float | None:
    price = section.get("price")
    return None if not price else section["maxTokens"] * max(price.values()) / 1_000_000


def _money(amount: float) -> str:
    return f"{amount:,.2f}" if amount >= 0.1 else f"{amount:.2g}"
