"""The methods of a researcher's agent: the callbacks' names, and which arguments each method takes.

HIPPO's documentation has `step(env, action)`, its sample agents have `step(action)`, and its first version has
functions of a module. The parameters of a method are read once, by `inspect.signature`, when the agent is loaded.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

SESSION_START = "on_session_start"
SESSION_END = "on_session_end"
EPISODE_START = "on_episode_start"
EPISODE_END = "on_episode_end"
TICK = "on_tick"
FEEDBACK = "on_feedback"
JOIN = "on_join"
LEAVE = "on_leave"
RETURN = "on_return"
FORM = "on_form"
NAMES = (SESSION_START, SESSION_END, EPISODE_START, EPISODE_END, TICK, FEEDBACK, JOIN, LEAVE, RETURN, FORM)
"""The callbacks, which are methods of the agent (`callbacks.py`)."""
REPLY = "reply"
MODERATE = "moderate"
TALK_METHODS = (REPLY, MODERATE)
"""Methods for what is said (`replies.py`). They run on threads of their own."""

GAME, ENV, ACTION, WORD, SEED, OPTIONS, MODE = "game", "env", "action", "word", "seed", "options", "mode"
CONFIG, PLAYER, ANSWERS = "config", "player", "answers"
"""The kinds of arguments. CONFIG is the section `trial` in HIPPO's form (`loading.hippo_config`). PLAYER is the player
whose view `render` draws, ANSWERS the answers to earlier steps that the game's key `answers` names. WORD is the newest
word of feedback since the last step, or NO_WORD."""

NO_WORD = "None"
"""The text that HIPPO's TAMER and COACH agents get if there was no feedback."""

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
"""The positional arguments of each method, its usual form first. `reset` gets the arguments of `_BY_NAME` by name."""
_BY_NAME = (SEED, OPTIONS, ANSWERS)

_SHOWN = {
    "start": "start(game)",
    "step": "step(action) or step(env, action)",
    "render": "render(), render(env) or render(player)",
    "reset": "reset(), reset(seed) or reset(env)",
    "close": "close() or close(env)",
}


class UnfitSignature(ValueError):
    """A method of the agent cannot be called. The message is for the researcher."""


@dataclass(frozen=True, slots=True)
class Signature:
    """The kinds of a method's arguments, such as GAME or SEED."""

    order: tuple[str, ...]
    """The kinds of the positional arguments."""
    named: tuple[str, ...] = ()
    """The kinds of the arguments that are given by name. The name is the kind, such as `seed`."""
    optional: tuple[str, ...] = ()
    """Those of `named` with a default of their own, which stays if there is no value."""

    def call(self, function: Callable[..., Any], given: Mapping[str, Any]) -> Any:
        """Call the function with its arguments; `given` has a value for each kind."""
        by_name = {kind: given[kind] for kind in self.named if kind not in self.optional or given[kind] is not None}
        return function(*[given[kind] for kind in self.order], **by_name)


def usual(method: str) -> Signature:
    """Return the usual signature of a method. It also counts if the method's parameters cannot be read."""
    return Signature(_FORMS[method][0])


def read(method: str, function: Callable[..., Any]) -> Signature:
    """Read the signature of `function`, which is the agent's `start`, `step`, `render`, `reset` or `close`.

    Raises UnfitSignature if the function needs an argument that no form of the method has.
    """
    try:
        parameters = list(inspect.signature(function).parameters.values())
    except (TypeError, ValueError):  # a function in C may have no signature
        return usual(method)
    named, optional, rest = _by_name(method, parameters)
    needed, possible = _positional(rest)
    order = _order(method, needed, possible)
    if order is None or any(p.kind is p.KEYWORD_ONLY and p.default is p.empty for p in rest):
        plain = inspect.Signature([p.replace(annotation=p.empty) for p in parameters])
        raise UnfitSignature(f"{method}{plain} cannot be called; write {_SHOWN[method]}")
    return Signature(order, named, optional)


def names(function: Callable[..., Any], parameter: str) -> bool:
    """Whether the function has a parameter of this name."""
    try:
        return parameter in inspect.signature(function).parameters
    except (TypeError, ValueError):
        return False


def _by_name(
    method: str, parameters: list[inspect.Parameter]
) -> tuple[tuple[str, ...], tuple[str, ...], list[inspect.Parameter]]:
    """Return the kinds of the arguments that `reset` takes by name, those with a default, and the other parameters."""
    if method != "reset":
        return (), (), parameters
    named: set[str] = set()
    optional: list[str] = []
    rest: list[inspect.Parameter] = []
    for p in parameters:
        if p.kind is p.VAR_KEYWORD:
            named.add(SEED)
        elif p.name in _BY_NAME and p.kind is not p.POSITIONAL_ONLY:
            named.add(p.name)
            if p.name != SEED and p.default is not p.empty:
                optional.append(p.name)
        else:
            rest.append(p)
    return tuple(sorted(named)), tuple(optional), rest


def _positional(parameters: list[inspect.Parameter]) -> tuple[list[str], list[str]]:
    """Return the names of the positional parameters without a default, and the names of all positional parameters.

    If there is only `*args`, the action stands for it.
    """
    in_order = [p for p in parameters if p.kind in (p.POSITIONAL_ONLY, p.POSITIONAL_OR_KEYWORD)]
    possible = [p.name.lower() for p in in_order]
    if not possible and any(p.kind is p.VAR_POSITIONAL for p in parameters):
        possible = [ACTION]
    return [p.name.lower() for p in in_order if p.default is p.empty], possible


def _order(method: str, needed: list[str], possible: list[str]) -> tuple[str, ...] | None:
    """Choose the form of the method that has as many arguments as `needed`, and most of them under the same names.

    `possible` are the names of all positional parameters. Return None if no form has as many arguments.
    """
    if not needed and method in ("start", "step"):
        needed = possible[:1]
    if method == "step" and [_NAMES.get(name) for name in needed] == [ENV]:
        needed = possible[:2]
    kinds = tuple(_NAMES.get(name, "") for name in needed)
    if kinds == (ACTION, ENV):
        return kinds
    fitting = [form for form in _FORMS[method] if len(form) == len(needed)]
    if len(needed) == 3:
        fitting = [form for form in fitting if form[-1] == kinds[-1]]
    return max(fitting, key=lambda form: sum(map(str.__eq__, form, kinds)), default=None)
