"""Checks what a study's design says of its pages: the fields of checks, and those that rules ask about."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from hippodrome.control.config import Config, Diagnostic
from hippodrome.control.config.folder import ConfigSource, read_source
from hippodrome.control.model import rules
from hippodrome.control.participants.markup import MARK
from hippodrome.local.check.earlier_answers import controls_of, source_of
from hippodrome.protocol.similar import did_you_mean

OF_EVERY_STEP = frozenset({"outcome", "passed", "tries"})
"""Fields that answers may have beside those of their pages."""
OF_GAMES = ("score", "outcome", "episodes", "frames", "seconds", "trial", "completionCode")


def check_designs(folder: Path, config: Config) -> list[Diagnostic]:
    """Return a mistake for each field that a check or a rule names and that no page or game has."""
    fields = {step.key: _fields(step.files) for step in config.steps if step.files}
    games = {step.key: _fields_of_game(config, step.key) for step in config.game_steps}
    source = read_source(folder)
    diagnostics = []
    for path, step, field, why in [*_of_checks(config), *_of_rules(config)]:
        fields_of_step = fields.get(step)
        if fields_of_step and field not in fields_of_step | OF_EVERY_STEP:
            message = f"the page of {step} has no field {field}{did_you_mean(field, fields_of_step)}{why}"
            diagnostics.append(source.diagnostic(path, message, remark=not why))
        elif step in games and field not in games[step]:
            diagnostics.append(source.diagnostic(path, _no_answer_of_game(step, field, games[step])))
    return diagnostics + list(_not_offered(config, source)) + list(_never_compared(config, source))


def _no_answer_of_game(step: str, field: str, fields: list[str]) -> str:
    if field == "reached":
        remedy = f"; give {step} a criterion, such as until: {{success: 3}}"
    else:
        remedy = did_you_mean(field, fields) or f"; it has {', '.join(fields)}"
    return f"the answer of the game {step} has no {field}{remedy}"


def _fields_of_game(config: Config, key: str) -> list[str]:
    """The fields of the answer that the trial stores for a game (docs/data.md)."""
    together = ("player", "session") if config.project.has_sessions else ()
    scores = ("scores",) if len(config.trial.named_players()) > 1 else ()
    has_criterion = config.design.own_trial.get(key, {}).get("until", config.trial.until) is not None
    return [*OF_GAMES, *scores, *together, *(("reached",) if has_criterion else ())]


def _not_offered(config: Config, source: ConfigSource) -> Iterator[Diagnostic]:
    """A mistake for each right answer that none of the choices of its field has: everybody would fail the check."""
    for step in config.steps:
        for field, right in step.step.right.items() if step.step else ():
            path = (*config.design.paths.get(step.key, ("project", "steps")), "right", field)
            for file in step.files:
                choices = _choices(file, field)
                if choices and str(right).strip().casefold() not in [choice.strip().casefold() for choice in choices]:
                    message = f"{file.name} offers no {right} for {field}; it has {', '.join(choices)}"
                    yield source.diagnostic(path, message)


def _never_compared(config: Config, source: ConfigSource) -> Iterator[Diagnostic]:
    """A remark for each text in a rule that none of the choices of its field has, such as No instead of no."""
    files = {step.key: step.files for step in config.steps}
    for path, rule in _rules(config):
        for names, text in rules.compared(rule):
            if names[0] != "answers" or len(names) != 3 or not text:
                continue
            choices = [choice for file in files.get(names[1], ()) for choice in _choices(file, names[2])]
            if choices and text not in choices:
                message = f"{names[1]} offers no {text} for {names[2]}; it has {', '.join(dict.fromkeys(choices))}"
                yield source.diagnostic(path, message, remark=True)


def _rules(config: Config) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """The rules of steps and ends, each with its place in config.yml."""
    for step in config.steps:
        if step.step and step.step.when:
            yield (*config.design.paths.get(step.key, ("project", "steps")), "when"), step.step.when
    for end in config.design.ends:
        for rule in end.when:
            yield ("project", "ends", end.name), rule


def _choices(file: Path, field: str) -> list[str]:
    """The values among which participants choose for a field; none if they may type, or if Jinja fills them in."""
    controls = [control for control in controls_of(source_of(file)) if control.name == field]
    if any(control.kind not in ("radio", "select") for control in controls):
        return []
    values = [control.value or "on" for control in controls if control.kind == "radio"]
    values += [option.value for control in controls for option in control.options if option.value]
    return [] if any(MARK in value for value in values) else list(dict.fromkeys(values))


def _of_checks(config: Config) -> Iterator[tuple[tuple[str | int, ...], str, str, str]]:
    for step in config.steps:
        for field in step.step.right if step.step else ():
            path = (*config.design.paths.get(step.key, ("project", "steps")), "right", field)
            yield path, step.key, field, "; nobody who sees it could answer right"


def _of_rules(config: Config) -> Iterator[tuple[tuple[str | int, ...], str, str, str]]:
    for path, rule in _rules(config):
        for names in rules.mentioned(rule):
            if names[0] == "answers" and len(names) == 3:
                yield path, names[1], names[2], ""


def _fields(files: tuple[Path, ...]) -> set[str]:
    """The names of all fields in these files. Parts that Jinja fills in may bring others, so then there are none."""
    names = {control.name for file in files for control in controls_of(source_of(file)) if control.name}
    return set() if any(MARK in name for name in names) else names
