"""The answers that participants may have given before they see a page."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Collection, Container, Iterator, Mapping, Sequence
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

from hippodrome.bots import form_filling, forms
from hippodrome.control.config import Config
from hippodrome.control.config.config import StepFiles
from hippodrome.control.participants import fragments
from hippodrome.control.participants.markup import MARK
from hippodrome.control.participants.sandbox import FragmentError
from hippodrome.local.check.page_source import PageSource
from hippodrome.protocol.answer import UNMATCHED


class Variant(NamedTuple):
    """Answers by step. `field` and `words` say which one is special about them; "" if none is."""

    answers: dict[str, dict[str, Any]]
    field: str = ""
    words: str = ""


class EarlierAnswers:
    """The answers that a participant may have given before they see a page.

    They are answers to every question, or only to the required ones.
    """

    def __init__(self, folder: Path, config: Config | None, steps: Sequence[StepFiles], groups: int = 0) -> None:
        """`steps` are the steps before the page; `folder` holds the pages. `groups`: the number of the page's versions.

        A page without versions has as many `groups` as the study.
        """
        self._groups = groups or (config.groups if config else 0)
        self._folder = folder
        self._steps = steps
        self._all = config.steps if config else ()
        self._least_played = {"outcome": UNMATCHED} if config and config.project.has_sessions else _PLAYED

    @classmethod
    def before_the_game(cls, folder: Path, config: Config) -> EarlierAnswers:
        """Return what a participant who comes to the first game step may have answered."""
        return cls(folder, config, list(itertools.takewhile(lambda step: not step.type.on_server, config.steps)))

    @classmethod
    def before_page(cls, folder: Path, config: Config | None, name: str) -> EarlierAnswers:
        """Return what a participant who comes to the page with this file may have answered."""
        steps = list(config.steps) if config else []
        end = len(steps) - 1 if config and name in config.end_pages else 0
        in_game = [file.name for page in (config.game_pages if config else ()) for file in page.files]
        place = next(
            (
                at
                for at, step in enumerate(steps)
                if name in [file.name for file in step.files] or (step.type.on_server and name in in_game)
            ),
            end,
        )
        return cls(folder, config, steps[:place], steps[place].variants if steps else 0)

    def fields(self) -> tuple[list[str], str]:
        """Return the names of the fields of all earlier pages, and the text of these pages."""
        texts = self._texts()
        found = (name for text in texts for name in _answered(text)[0])
        return list(dict.fromkeys(found)), "\n".join(texts)

    def fields_of(self, key: str) -> list[str] | None:
        """Return the names of all fields of an earlier step; None if they are not known.

        They are not known if a script or Jinja may make fields, or if the step does not come before the page.
        """
        step = next((step for step in self._steps if step.key == key), None)
        if step is None or not (step.files or step.type.on_server):
            return None
        if step.type.on_server:
            return [*_PLAYED, *_PLAYED_TOGETHER]
        texts = [source_of(file) for file in step.files]
        names = [control.name for text in texts for control in controls_of(text) if control.name]
        may_have_more = any("<script" in text.lower() for text in texts) or any(MARK in name for name in names)
        return None if may_have_more else list(dict.fromkeys(names))

    def why_no_step(self, key: str) -> str | None:
        """Return why the study has no step with this key; None if it has one, or is not known."""
        if not self._all or key in [step.key for step in self._all]:
            return None
        for step in self._all:
            names = (file.name for file in step.files)
            if any(re.fullmatch(rf"{re.escape(key)}(-\d+)?\.html", name) for name in names):
                return f'answers have the keys of steps: write answers["{step.key}"] for the page {key}'
        return f"there is no step {key}"

    def choices(self, field: str) -> int | None:
        """Return how many different answers a field can have.

        The result is None if participants write the answer, or if a script may make it.
        """
        texts = self._texts()
        if any("<script" in text.lower() for text in texts):
            return None
        found: set[str] = set()
        for text in texts:
            controls = [control for control in controls_of(text) if control.name == field]
            if not controls:
                continue
            answers = _choices(controls)
            if answers is None:
                return None
            found |= answers
        return len(found) if found else None

    def answers(self, group: int | None, person: int = 1) -> list[dict[str, dict[str, Any]]]:
        """Return two sets of answers, by step: one to all questions, one to the required ones alone.

        `person` seeds the random choices.
        """
        most: dict[str, dict[str, Any]] = {}
        least: dict[str, dict[str, Any]] = {}
        for step in self._steps:
            if step.type.on_server:
                most[step.key], least[step.key] = dict(_PLAYED), dict(self._least_played)
                continue
            if not step.files:  # a type of step without a researcher's page: no fields to answer
                most[step.key] = least[step.key] = {}
                continue
            most[step.key], least[step.key] = _answered(self._source(step, group), person)
        return [most, least]

    def made_up(self, group: int | None) -> dict[str, dict[str, Any]]:
        """Return answers to all questions, by step, with values as participants' pages offer them.

        Loops of a page are run, so that the values that they make are known; what depends on a participant is empty.
        """
        found: dict[str, dict[str, Any]] = {}
        for step in self._steps:
            if step.type.on_server:
                found[step.key] = dict(_PLAYED)
            elif step.files:
                found[step.key] = _answers_to(_rendered(self._source(step, group)), 1)[0]
        return found

    def _source(self, step: StepFiles, group: int | None) -> str:
        """The text of the version that this group sees. If its number of versions is another one, it is any version."""
        return source_of(self._folder / step.files[(group or 0) % len(step.files)].name)

    def variants(
        self, group: int | None, constants: Collection[str | float], names: Container[object]
    ) -> Iterator[Variant]:
        """Yield sets of answers that differ in one answer, with the words for it.

        `names` are the names that a page uses, and `constants` what it may compare answers with. So this answer is one
        of the choices of a question, or a constant, or a number beside it.
        """
        most, least = self.answers(group)
        yield Variant(most)
        yield Variant(least, words="only the required answers")
        for step in self._steps:
            for number in range(step.variants if step.variants != self._groups else 0):
                answers = _answered(self._source(step, number))[0]
                yield Variant({**most, step.key: answers}, words=f"version {number} of step {step.key}")
        numbers = [n + d for n in constants if not isinstance(n, str | bool) for d in (-1, 0, 1)]
        texts = [text for text in constants if isinstance(text, str)]
        for step in self._steps:
            if step.type.on_server:
                values: Mapping[str, Sequence[str | float]] = {"score": numbers, "outcome": texts}
            elif step.files:
                values = _possible(self._source(step, group), numbers, texts)
            else:
                continue
            for name, possible in values.items():
                for value in dict.fromkeys(possible) if name in names else ():
                    words = f"{name} = {json.dumps(value, ensure_ascii=False)} at step {step.key}"
                    yield Variant({**most, step.key: {**most[step.key], name: value}}, f"{step.key}.{name}", words)

    def _texts(self) -> list[str]:
        """The texts of the earlier pages, in the versions of all groups."""
        return [source_of(file) for step in self._steps for file in step.files]


_PLAYED = {"episodes": 1, "score": 1.5, "frames": 100, "seconds": 3.5, "trial": "t", "outcome": "finished"}

_PLAYED_TOGETHER = ("scores", "session", "player")  # what an answer holds in games of several players


def every_branch(text: str) -> fragments.Content:
    """Return a page with all branches of its template, and with marks in the place of each Jinja expression."""
    unclosed = re.compile(r"\{[{%#]")  # with which Jinja would fail
    return fragments.prepare(unclosed.sub(MARK * 2, PageSource(text).text)).fill({})


def controls_of(text: str) -> list[forms.Control]:
    """Return the fields and buttons of a page, in all branches of its template."""
    return [control for form in _forms(text) for control in form.controls]


def _forms(text: str) -> list[forms.Form]:
    return forms.read(f"<form>{every_branch(text).html}</form>")


def _rendered(text: str) -> list[forms.Form]:
    """The forms of a page as it is without a participant; with all branches, if it cannot be rendered so."""
    try:
        return forms.read(f"<form>{fragments.prepare(text).fill({}).html}</form>")
    except FragmentError:
        return _forms(text)


def _answered(text: str, person: int = 1) -> tuple[dict[str, Any], dict[str, Any]]:
    """Answers to a page: to all questions, and to the required ones only."""
    return _answers_to(_forms(text), person)


def _answers_to(found: list[forms.Form], person: int) -> tuple[dict[str, Any], dict[str, Any]]:
    """Answers to the first of these forms: to all questions, and to the required ones only."""
    if not found:
        return {}, {}
    controls = found[0].controls
    filled = form_filling.gathered(form_filling.fill(found[0], Random(person)))  # noqa: S311 - nothing secret
    most = {control.name: "1" for control in controls if control.name} | filled
    boxes = {control.name for control in controls if control.kind in ("checkbox", "radio")}
    needed = {control.name for control in controls if control.required}
    least = {
        name: (value if name in needed else "") for name, value in most.items() if name in needed or name not in boxes
    }
    return most, least


def _possible(text: str, numbers: Sequence[float], texts: Sequence[str]) -> dict[str, list[str]]:
    """By field of a page, answers that it can have: its choices, or those of the given answers that it takes."""
    found: dict[str, list[str]] = {}
    for control in _forms(text)[0].controls:
        if control.kind in ("radio", "checkbox", *forms.PRESSED):
            values = [control.attributes.get("value", "on")]
        elif control.kind == "select":
            values = [option.value for option in control.options if not option.disabled]
        elif control.kind in ("number", "range"):
            values = [f"{number:g}" for number in numbers if _is_within(control, number)]
        else:
            values = [*texts, *(f"{number:g}" for number in numbers)]
        found.setdefault(control.name, []).extend(value for value in values if MARK not in value)
    return found


def _is_within(control: forms.Control, number: float) -> bool:
    """Whether a number lies within the limits of its field, as far as they are numbers."""
    low, high = control.attributes.get("min", ""), control.attributes.get("max", "")
    try:
        return float(low or "-inf") <= number <= float(high or "inf")
    except ValueError:
        return True


def _choices(controls: Sequence[forms.Control]) -> set[str] | None:
    """The possible answers to a question of one page, "" for none; None if they cannot be counted."""
    kinds = {control.kind for control in controls}
    needed = any(control.required for control in controls)
    if kinds == {"radio"} or (kinds == {"checkbox"} and len(controls) == 1):
        found = {control.attributes.get("value", "on") for control in controls}
        unanswered = not needed
    elif kinds == {"select"} and len(controls) == 1 and "multiple" not in controls[0].attributes:
        found = {option.value for option in controls[0].options if not option.disabled}
        if needed:
            found.discard("")
        unanswered = False
    else:
        return None
    if any(MARK in value for value in found):
        return None
    return {value.strip().casefold() for value in found} | ({""} if unanswered else set())


def source_of(path: Path) -> str:
    """Return the text of a page; empty if it cannot be read, which the check of the configuration reports."""
    try:
        return path.read_bytes().decode("utf-8", "replace")
    except OSError:
        return ""
