"""Chooses the answers of a bot so that it reaches one end of the study, or none before the last page. Pure.

The rules of ends ask about answers, about the cell, and about the participant's link and device. A bot tries the values
that the fields of its page offer, and for what comes later those that the rules name, until it finds values with which
the rules say what it wants. What happens in a game is not chosen: bots play by chance.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from random import Random
from typing import Any

from hippodrome.bots.form_filling import Pairs, decimal_of
from hippodrome.bots.forms import PRESSED, Control, Form
from hippodrome.control.model import rules
from hippodrome.control.model.design import Block, End, Factor, Levels, Step, cells, run_key
from hippodrome.control.model.place import wrong_fields

MOST_TRIED = 3000
"""The most combinations of values that are tried for one page."""
BROWSERS = {
    "desktop": "rehearsal",
    "phone": "rehearsal (iPhone; Mobile)",
    "tablet": "rehearsal (Android; Tablet)",
}
"""What a bot calls its browser so that it is taken for this device."""

Variable = tuple[str, str]
"""A step and a field of its answers; or "condition" or "participant" and the name of what it has."""
Choice = Mapping[Variable, Any]


@dataclass(frozen=True)
class Design:
    """What steering needs to know of a study: its steps as in the file, blocks, conditions and ends."""

    steps: Sequence[Step]
    blocks: Sequence[Block] = ()
    conditions: Sequence[Factor] = ()
    ends: Sequence[End] = ()

    def runs(self, step: Step) -> dict[str, str]:
        """Return the name of the level of each run of a step in a block, by the run's key."""
        if step.block is None:
            return {}
        levels = [self.blocks[step.block].levels(run) for run in self.blocks[step.block].runs]
        return {run_key(step.key, run): "-".join(run.values()) for run in levels}

    def step_of(self, key: str) -> Step | None:
        """Return the step with this key, or with a run of this key."""
        return next((step for step in self.steps if key == step.key or key in self.runs(step)), None)

    @property
    def mentioned(self) -> set[tuple[str, ...]]:
        """What the rules of all ends ask about."""
        return {names for end in self.ends for rule in end.when for names in rules.mentioned(rule)}

    def constants(self, *names: str) -> list[Any]:
        """Return the texts and numbers in the rules that ask about what begins with these names, each once."""
        asking = (
            rule
            for end in self.ends
            for rule in end.when
            if any(mention[: len(names)] == names for mention in rules.mentioned(rule))
        )
        return list(dict.fromkeys(value for rule in asking for value in rules.constants(rule)))

    def fields(self, step: str) -> set[str]:
        """Return the fields of a step's answers that a rule asks about."""
        return {names[-1] for names in self.mentioned if names[0] == "answers" and names[1] == step and len(names) > 2}


@dataclass
class Steering:
    """Answers for one participant, who is to reach the end `target`; None: the last page.

    `condition` has the levels of the participant's cell; None if they are not known.
    """

    design: Design
    target: End | None
    random: Random
    condition: Levels | None = None
    participant: dict[str, str] = field(default_factory=dict)
    answers: dict[str, dict[str, Any]] = field(default_factory=dict)  # by run key

    def set_out(self) -> None:
        """Choose what a participant has before the first page: the device, and the fields of the link."""
        chosen = {name: value for (what, name), value in self._search({}).items() if what == "participant"}
        self.participant = {name: _text(value) for name, value in chosen.items() if value != ""}

    def fill(self, key: str, form: Form, pairs: Pairs) -> Pairs:
        """Return the pairs of a filled form with the values that lead to the target."""
        step = self.design.step_of(key)
        if step is None:
            return pairs
        self.answers.pop(key, None)
        fields = sorted(self.design.fields(step.key) | set(step.right))
        constants = [*self.design.constants("answers", step.key), *step.right.values()]
        here = {(step.key, name): values for name in fields if (values := offered(form, name, constants))}
        here |= {(step.key, name): [right] for name, right in step.right.items() if (step.key, name) not in here}
        choice = {name: value for (_, name), value in self._search(here, key).items()} if here else {}
        chosen = with_values(form, pairs, choice)
        self.answers[key] = {**dict(chosen), **_judged(step, dict(chosen))}
        return chosen

    def _search(self, here: Mapping[Variable, Sequence[Any]], key: str = "") -> Choice:
        """Return the values of `here` with which the rules come closest to what is wanted, and of all that is open."""
        open_values = {**dict(self._later(here, key)), **here}
        best: Choice = {}
        most = -1
        for values in self._combinations(list(open_values.values())):
            choice = dict(zip(open_values, values, strict=True))
            score = self._score(choice, here, key)
            if score > most:
                best, most = choice, score
            if most == _PERFECT:
                break
        return {variable: value for variable, value in best.items() if not key or variable in here}

    def _combinations(self, values: Sequence[Sequence[Any]]) -> Iterator[Sequence[Any]]:
        """Yield combinations in a random order; if there are very many, only some of them."""
        if math.prod(map(len, values)) <= MOST_TRIED:
            every = list(itertools.product(*values))
            self.random.shuffle(every)
            yield from every
        else:
            for _ in range(MOST_TRIED):
                yield [self.random.choice(offers) for offers in values]

    def _score(self, choice: Choice, here: Mapping[Variable, Any], key: str) -> int:
        """How well a choice leads to the target: _PERFECT if it does, and no other rule would be true, too."""
        step = self.design.step_of(key) if key else None
        choices = {variable[1]: value for variable, value in choice.items() if variable in here}
        if step is not None and step.right and not step.tries and wrong_fields(step, choices):
            return 0  # it is asked until it is right
        facts = self._facts(choice, key, choices)
        holding = [end for end in self.design.ends if any(rules.holds(rule, facts) for rule in end.when)]
        others = sum(end is not self.target for end in holding)
        reached = self.target is None or self.target in holding
        return _PERFECT - others if reached else _PERFECT // 2 - others

    def _facts(self, choice: Choice, key: str, given: Mapping[str, Any]) -> Mapping[str, Any]:
        answers: dict[str, Any] = {}
        for name in {names[1] for names in self.design.mentioned if names[0] == "answers"}:
            step = next((step for step in self.design.steps if step.key == name), None)
            if step is None:
                continue
            later = {field_: value for (of, field_), value in choice.items() if of == name}
            now = {**given, **_judged(step, given)}
            if step.block is None:
                answers[name] = now if key == name else self.answers.get(name, later)
                continue
            answers[name] = rules.Runs(
                {
                    level: now if run == key else self.answers.get(run, later)
                    for run, level in self.design.runs(step).items()
                }
            )
        condition = self.condition if self.condition is not None else choice.get(("condition", ""), {})
        chosen = {name: value for (what, name), value in choice.items() if what == "participant"}
        return {
            "answers": answers,
            "condition": condition,
            "participant": {**chosen, **self.participant},
            "order": {},
            "run": {},
        }

    def _later(self, here: Mapping[Variable, Any], key: str) -> Iterator[tuple[Variable, list[Any]]]:
        """What is not known yet, with the values that it may have."""
        for names in sorted(self.design.mentioned):
            values = [value for constant in self.design.constants(*names) for value in _around(constant)]
            match names:
                case "condition", *_ if self.condition is None:
                    yield ("condition", ""), list(cells(self.design.conditions))
                case "participant", "device" if not key:
                    yield ("participant", "device"), list(BROWSERS)
                case "participant", name if not key:
                    yield ("participant", name), ["", *values]
                case "answers", name, *_, field_ if (name, field_) not in here and self._is_open(name, key):
                    step = self.design.step_of(name)
                    check = [True, False] if step and step.tries else [True]
                    yield (name, field_), check if field_ == "passed" else ["", True, *values]

    def _is_open(self, name: str, key: str) -> bool:
        """Whether some run of a step is neither answered nor the present one."""
        step = self.design.step_of(name)
        runs = (self.design.runs(step) if step else {}) or {name: ""}
        return any(run not in self.answers and run != key for run in runs)


_PERFECT = 100_000


def _judged(step: Step, answers: Mapping[str, Any]) -> dict[str, Any]:
    return {"passed": not wrong_fields(step, answers)} if step.right else {}


def offered(form: Form, name: str, constants: Sequence[Any]) -> list[str]:
    """Return the values that a participant may give to the field `name`; "" stands for no answer.

    Of a number or a text, they are those in `constants` and close to them, within the limits of the field.
    """
    values: list[str] = []
    for control in form.controls:
        if control.name != name:
            continue
        if control.kind in PRESSED:
            values += [control.value] if control in form.buttons else []
        elif control.kind in ("radio", "checkbox"):
            values.append(control.attributes.get("value", "on"))
            values += [""] if control.kind == "checkbox" and not control.required else []
        elif control.kind == "select":
            values += [option.value for option in control.options if not option.disabled and option.value]
        elif control.kind in ("number", "range"):
            values += _numbers(control, constants)
        elif control.kind in ("text", "textarea", "search"):
            values += [*map(_text, constants), "x"]
    return list(dict.fromkeys(values))


def with_values(form: Form, pairs: Pairs, choice: Mapping[str, str]) -> Pairs:
    """Return the pairs of a filled form with these values. Only one button is pressed."""
    buttons = {control.name for control in form.buttons if control.name}
    replaced = set(choice) | (buttons if buttons & set(choice) else set())
    unchanged = [(name, value) for name, value in pairs if name not in replaced]
    return unchanged + [(name, value) for name, value in choice.items() if value != ""]


def _numbers(control: Control, constants: Sequence[Any]) -> Iterator[str]:
    low, high, step = (decimal_of(control.attributes.get(name)) for name in ("min", "max", "step"))
    step = step if step is not None and step > 0 else Decimal(1)
    near = [
        number for value in constants for number in map(decimal_of, map(_text, _around(value))) if number is not None
    ]
    for number in (low, high, *near):
        if number is None or (low is not None and number < low) or (high is not None and number > high):
            continue
        if (number - (low or 0)) % step == 0:
            yield f"{number.normalize():f}"


def _around(value: Any) -> list[Any]:
    """The value, and for a number one less and one more: the rule may compare by <, <=, > or >=."""
    number = decimal_of(_text(value))
    if number is None or isinstance(value, bool):
        return [value]
    return [value, *(_text(float(number) + by) for by in (-1, 1))]


def _text(value: Any) -> str:
    return f"{value:g}" if isinstance(value, float) else str(value)
