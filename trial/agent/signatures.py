"""How the methods of a researcher's agent are to be called: with or without the environment, a seed, a game.

HIPPO's documentation has `step(env, action)`, its sample agents `step(action)`, and its first version functions of a
module. What a method takes is read once, by `inspect.signature`, when the agent is loaded.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

GAME, ENV, ACTION, WORD, SEED, OPTIONS, MODE = "game", "env", "action", "word", "seed", "options", "mode"
CONFIG, PLAYER = "config", "player"
"""What a parameter is given. CONFIG: the section `trial` as HIPPO's trial has it. PLAYER: whose picture is to be drawn.
WORD: the newest word of feedback since the last step, or the text None."""

NO_WORD = "None"
"""What HIPPO's TAMER and COACH agents take for no feedback."""

_NAMES = {
    "env": ENV, "environment": ENV, "gym_env": ENV,
    "action": ACTION,
    "reward": WORD, "feedback": WORD, "human_feedback": WORD, "humanfeedback": WORD,
    "seed": SEED, "options": OPTIONS, "mode": MODE, "game": GAME,
    "player": PLAYER, "player_id": PLAYER, "agent": PLAYER, "agent_id": PLAYER,
    "config": CONFIG,
}  # fmt: skip

_FORMS: dict[str, tuple[tuple[str, ...], ...]] = {
    "start": ((GAME,), (CONFIG,), ()),
    "step": ((ACTION,), (ENV, ACTION), (ACTION, WORD), (ENV, ACTION, WORD)),
    "render": ((), (ENV,), (MODE,), (PLAYER,), (ENV, MODE), (ENV, PLAYER)),
    "reset": ((), (ENV,)),
    "close": ((), (ENV,)),
}
"""What each method may take in this order, the usual form first. `seed` and `options` of `reset` go by their names."""

_SHOWN = {
    "start": "start(game)",
    "step": "step(action) or step(env, action)",
    "render": "render(), render(env) or render(player)",
    "reset": "reset(), reset(seed) or reset(env)",
    "close": "close() or close(env)",
}


class UnfitSignature(ValueError):
    """A method that cannot be called. The message is for the researcher."""


@dataclass(frozen=True, slots=True)
class Signature:
    """What to give to a method: in its order, and by name. Each value is one of the constants above."""

    order: tuple[str, ...]
    named: Mapping[str, str] = field(default_factory=dict)

    @property
    def needs_env(self) -> bool:
        return ENV in self.order

    def call(self, function: Callable[..., Any], given: Mapping[str, Any]) -> Any:
        """Call it with what it takes of `given`."""
        return function(
            *[given[what] for what in self.order], **{name: given[what] for name, what in self.named.items()}
        )


def usual(method: str) -> Signature:
    """How a method is called whose parameters cannot be read."""
    return Signature(_FORMS[method][0])


def read(method: str, function: Callable[..., Any]) -> Signature:
    """How to call `function`, which is the agent's `start`, `step`, `render`, `reset` or `close`.

    Raises UnfitSignature if it needs a value that cannot be given.
    """
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # such as one written in C
        return usual(method)
    named, rest = _by_name(method, parameters)
    needed, possible = _positional(rest)
    order = _order(method, needed, possible)
    if order is None or any(p.kind is p.KEYWORD_ONLY and p.default is p.empty for p in rest):
        plain = inspect.Signature([p.replace(annotation=p.empty) for p in parameters])
        raise UnfitSignature(f"{method}{plain} cannot be called; write {_SHOWN[method]}")
    return Signature(order, named)


def names(function: Callable[..., Any], parameter: str) -> bool:
    """Whether the function has a parameter of this name."""
    try:
        return parameter in inspect.signature(function).parameters
    except (TypeError, ValueError):
        return False


def _by_name(method: str, parameters: list[inspect.Parameter]) -> tuple[dict[str, str], list[inspect.Parameter]]:
    """What `reset` takes by name, and the other parameters."""
    if method != "reset":
        return {}, parameters
    named: dict[str, str] = {}
    rest: list[inspect.Parameter] = []
    for p in parameters:
        if p.kind is p.VAR_KEYWORD or (p.name == SEED and p.kind is not p.POSITIONAL_ONLY):
            named[SEED] = SEED
        elif p.name == OPTIONS and p.kind is not p.POSITIONAL_ONLY:
            if p.default is p.empty:
                named[OPTIONS] = OPTIONS
        else:
            rest.append(p)
    return named, rest


def _positional(parameters: list[inspect.Parameter]) -> tuple[list[str], list[str]]:
    """The names of the parameters that must be given in order, and of all that can be."""
    in_order = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    possible = [p.name.lower() for p in in_order]
    possible += [ACTION] * any(p.kind is p.VAR_POSITIONAL for p in parameters) * (not possible)
    return [p.name.lower() for p in in_order if p.default is p.empty], possible


def _order(method: str, needed: list[str], possible: list[str]) -> tuple[str, ...] | None:
    """What to give in order; None if nothing fits. First by the parameters' names, as far as known, then by number."""
    if not needed and method in ("start", "step"):
        needed = possible[:1]
    if method == "step" and [_NAMES.get(name) for name in needed] == [ENV]:
        needed = possible[:2]
    meant = tuple(_NAMES.get(name, "") for name in needed)
    if meant == (ACTION, ENV):
        return meant
    fitting = [form for form in _FORMS[method] if len(form) == len(needed)]
    if len(needed) == 3:
        fitting = [form for form in fitting if form[-1] == meant[-1]]
    return max(fitting, key=lambda form: sum(map(str.__eq__, form, meant)), default=None)
