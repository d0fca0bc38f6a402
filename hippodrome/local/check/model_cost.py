"""What a study's language model can cost at most, by the caps and the price in config.yml."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from hippodrome.control.config import Config


def sentence(config: Config) -> str | None:
    """Return what the language model can cost; None if there is none, or config.yml gives no price."""
    games = [cost for step in config.game_steps if (cost := _of_game(config, step.key)) is not None]
    if not games:
        return None
    place, people = f"{config.project.players} participants together", config.project.max_participants
    person = sum(games)
    words = f"The language model costs at most {_money(person)} for each participant"
    if config.project.has_sessions:
        words = f"The language model costs at most {_money(person)} for {place}"
        person /= config.project.players
    if people:
        words += f", and {_money(person * people)} for {people} participants (maxParticipants)"
    return f"{words}: llm.maxTokens in each game, at the higher of the two prices."


def _of_game(config: Config, key: str) -> float | None:
    """What one participant's games of a step can cost; None if it has no model with a price."""
    step = next((one for one in config.design.steps if one.key == key), None)
    own = [section.trial.get("llm") for section in step.sections] if step else []
    costs = [_cost(section) for section in (*own, config.trial.registered().get("llm")) if section]
    known_costs = [cost for cost in costs if cost is not None]
    if not known_costs:
        return None
    runs = config.design.blocks[step.block].length if step is not None and step.block is not None else 1
    return max(known_costs) * runs


def _cost(section: Mapping[str, Any]) -> float | None:
    price = section.get("price")
    return None if not price else section["maxTokens"] * max(price.values()) / 1_000_000


def _money(amount: float) -> str:
    return f"{amount:,.2f}" if amount >= 0.1 else f"{amount:.2g}"
