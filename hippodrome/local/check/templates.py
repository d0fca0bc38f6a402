"""Checks a page's Jinja: whether it can be parsed, and shown to participants with few or many answers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import islice
from typing import Any, NamedTuple

from jinja2 import meta, nodes
from jinja2.exceptions import SecurityError, TemplateRuntimeError, TemplateSyntaxError, UndefinedError

from hippodrome.bots import forms
from hippodrome.control.config import Config, Diagnostic
from hippodrome.control.participants import fragments, sandbox
from hippodrome.control.participants.sandbox import FragmentError
from hippodrome.local.check.earlier_answers import EarlierAnswers, Variant
from hippodrome.local.check.wording import short
from hippodrome.protocol.answer import UNMATCHED
from hippodrome.protocol.similar import did_you_mean

VALUES = (
    "answers",
    "completion_code",
    "condition",
    "group",
    "order",
    "participant",
    "project",
    "run",
    "shuffle",
    "wrong",
)
"""The values that a page may use (docs/pages.md)."""


MOST_SHOWN = 300
"""How many sets of answers a page is shown with, for each group."""


class Visitors(NamedTuple):
    """Who sees a page: participants of these groups, with these answers."""

    groups: list[int | None]
    earlier: EarlierAnswers
    send_it: bool  # whether they have to send the page to go on


def check_template(label: str, source: str, config: Config | None, visitors: Visitors) -> Iterator[Diagnostic]:
    """Yield the problems of the page: in parsing it, and in showing it to participants with different answers."""
    page = fragments.prepare(source)
    if not sandbox.uses_jinja(page.text):
        if visitors.send_it and _cannot_be_sent(page.fill({})):
            yield Diagnostic(label, None, "", f"{_NO_BUTTON}, so nobody can go on{_HIDDEN}")
        return
    environment = sandbox.environment()
    try:
        parsed = environment.parse(page.text)
    except TemplateSyntaxError as error:
        yield Diagnostic(label, error.lineno, "", _unread(error))
        return
    except Exception as error:  # noqa: BLE001 - such as a page that is nested too deeply
        yield Diagnostic(label, None, "", f"Jinja cannot read this page: {short(str(error))}")
        return
    unknown = [*_unknown(label, parsed, environment)]
    if unknown:  # rendering would fail at the first of them
        yield from unknown
        return
    undefined = meta.find_undeclared_variables(parsed) - {*VALUES, *environment.globals}
    for name in parsed.find_all(nodes.Name):
        if name.name in undefined:
            undefined.remove(name.name)
            message = f"nothing is shown: there is no value {short(name.name)}{did_you_mean(name.name, VALUES)}"
            yield Diagnostic(label, name.lineno, "", message, remark=True)
    yield from _group_of_nobody(label, parsed, config)
    yield from _answers_named(label, parsed, visitors.earlier)
    yield from _shown(label, page, parsed, config, visitors)


def _answers_named(label: str, parsed: nodes.Template, earlier: EarlierAnswers) -> Iterator[Diagnostic]:
    """Yield remarks on steps that the study does not have, and on fields that an earlier step does not have."""
    called = {id(call.node) for call in parsed.find_all(nodes.Call)}  # `answers["2"].items()` is a method
    lookups: list[nodes.Getitem | nodes.Getattr] = [*parsed.find_all(nodes.Getitem), *parsed.find_all(nodes.Getattr)]
    for node in lookups:
        if id(node) in called:
            continue
        inner, key = node.node, _key(node)
        if _is_answers(inner) and isinstance(key, int) and not isinstance(key, bool):
            yield _nothing_shown(label, node, f'write answers["{key}"], with quotes')
        if _is_answers(inner) and isinstance(key, str) and (why := earlier.why_no_step(key)):
            yield _nothing_shown(label, node, why)
        if not isinstance(inner, nodes.Getitem | nodes.Getattr) or not _is_answers(inner.node):
            continue
        if not isinstance(key, str):
            continue
        step = _key(inner)
        fields = earlier.fields_of(step) if isinstance(step, str) else None
        if fields is not None and key not in fields:
            has = ", ".join(fields) or "no fields"
            message = f"step {step} has no answer {short(key)}{did_you_mean(key, fields)} (it has {short(has)})"
            yield _nothing_shown(label, node, message)


def _nothing_shown(label: str, node: nodes.Node, why: str) -> Diagnostic:
    return Diagnostic(label, node.lineno, "", f"nothing is shown: {why}", remark=True)


def _is_answers(node: nodes.Node) -> bool:
    return isinstance(node, nodes.Name) and node.name == "answers"


def _key(node: nodes.Getitem | nodes.Getattr) -> object:
    return node.attr if isinstance(node, nodes.Getattr) else getattr(node.arg, "value", None)


def _group_of_nobody(label: str, parsed: nodes.Template, config: Config | None) -> Iterator[Diagnostic]:
    """A remark if the page compares `group` with a number in a study without groups: all see the same branch."""
    if config is None or config.groups:
        return
    for comparison in parsed.find_all(nodes.Compare):
        with_number = any(
            isinstance(operand.expr, nodes.Const) and isinstance(operand.expr.value, int) for operand in comparison.ops
        )
        if isinstance(comparison.expr, nodes.Name) and comparison.expr.name == "group" and with_number:
            message = (
                "the study has no groups, so all participants see the same branch; groups come from versions of a "
            )
            message += "page, such as consent-0.html and consent-1.html (docs/pages.md#groups)"
            yield Diagnostic(label, comparison.lineno, "", message, remark=True)
            return


def _shown(
    label: str,
    page: fragments.Fragment,
    parsed: nodes.Template,
    config: Config | None,
    visitors: Visitors,
) -> Iterator[Diagnostic]:
    """Problems in showing the page to participants with different answers: it fails, or they cannot send it."""
    constants = [node.value for node in parsed.find_all(nodes.Const) if isinstance(node.value, str | int | float)]
    names_shown = {*constants, *(node.attr for node in parsed.find_all(nodes.Getattr))}
    stuck: list[Variant] = []
    others: set[str] = set()  # the special answers of those who can go on
    for group in visitors.groups:
        for variant in islice(visitors.earlier.variants(group, constants, names_shown), MOST_SHOWN):
            values = _values(config, group)
            if config:
                values["participant"] |= _company(variant.answers, config)
            try:
                content = page.fill({**values, "answers": variant.answers})
            except FragmentError as error:
                yield _failing(label, error, variant, may_depend=bool(sandbox.records_mentioned(page.text)))
                return
            if visitors.send_it and _cannot_be_sent(content):
                stuck.append(variant)
            else:
                others.add(variant.field)
    if stuck and others:
        special = max(stuck, key=lambda variant: (bool(variant.field), variant.field in others, bool(variant.words)))
        words = special.words or "some answers"
        message = f"with {short(words)} {_NO_BUTTON}, so these participants end here"
        yield Diagnostic(label, None, "", message, remark=True)
    elif stuck:
        yield Diagnostic(label, None, "", f"{_NO_BUTTON}, so nobody can go on{_HIDDEN}")


_NO_BUTTON = "the page has no button that can be pressed"
_HIDDEN = "; show its button, or take it out: then the page has the button Continue"


def _cannot_be_sent(content: fragments.Content) -> bool:
    """Whether the page in its frame, which adds a button to a page without one, has none that can be pressed."""
    button = "" if content.has_submit else "<button>Continue</button>"
    return not forms.read(f"<form>{content.html}{button}</form>")[0].can_be_sent


def _unread(error: TemplateSyntaxError) -> str:
    """The message for a page that Jinja cannot parse."""
    comment = (
        '; {# begins a comment, also in a style: write "{ #" there' if "end of comment" in str(error.message) else ""
    )
    return f"Jinja cannot read this: {short(error.message or '')}{comment}"


def _unknown(label: str, parsed: nodes.Template, environment: Any) -> Iterator[Diagnostic]:
    """Filters and tests that do not exist. Jinja itself finds them inside an {% if %} only if its condition is true."""
    for kind, node_type, names in (
        ("filter", nodes.Filter, environment.filters),
        ("test", nodes.Test, environment.tests),
    ):
        for node in parsed.find_all(node_type):
            if node.name not in names:
                message = f"there is no {kind} {short(node.name)} in Jinja{did_you_mean(node.name, names)}"
                yield Diagnostic(label, node.lineno, "", message)


def _values(config: Config | None, group: int | None) -> dict[str, Any]:
    """The values that a page may use, for a participant without answers."""
    project = config.project if config else None
    return {
        "project": {
            "id": project.id if project else "",
            "name": (project.name or project.id) if project else "",
            "researcher": project.researcher if project else "",
        },
        "participant": {"userId": "P1"},
        "group": group,
        "completion_code": "ABCDEF",
        "answers": {},
        "wrong": [],
        "shuffle": sandbox.shuffler("check"),
        **_levels(config),
    }


def _levels(config: Config | None) -> dict[str, Any]:
    """`condition`, `order` and `run`, for a participant with the first level of each factor."""
    conditions, blocks = (config.design.conditions, config.design.blocks) if config else ((), ())
    within = [factor for block in blocks for factor in block.factors]
    return {
        "condition": {factor.name: next(iter(factor.levels)) for factor in (*conditions, *within)},
        "order": {factor.name: list(factor.levels) for factor in within},
        "run": {"position": 1},
    }


def _company(answers: Mapping[str, Mapping[str, Any]], config: Config) -> dict[str, Any]:
    """What `participant` has after a game of several: whether they found others, and how many they were together."""
    played = [answers[step.key] for step in config.game_steps if step.key in answers]
    if not config.project.has_sessions or not played:
        return {}
    alone = played[0].get("outcome") == UNMATCHED
    return {"unmatched": alone, "members": 0 if alone else config.project.players}


def _failing(label: str, error: FragmentError, variant: Variant, *, may_depend: bool) -> Diagnostic:
    """The mistake of a page that cannot be shown; a remark if that may depend on the participant's answers."""
    cause, why = error.__cause__, short(error.message)
    if isinstance(cause, TypeError) and "no loader" in str(cause):
        why = "include, import and extends do not work: a page is one file"
    elif isinstance(cause, TemplateSyntaxError):
        why = _unread(cause)
    elif may_depend and cause is not None and not _certain(cause):
        who, helps = "without the answer", "; |default(…) helps"
        if variant.field:
            who, helps = f"with {short(variant.words)}", ""
        why = f"a participant {who} gets an error page here ({why}){helps}"
        return Diagnostic(label, error.line, "", why, remark=True)
    else:
        why = f"the page cannot be shown: {why}"
    return Diagnostic(label, error.line, "", why)


def _certain(cause: BaseException) -> bool:
    """Whether the page fails for every participant, whatever they have answered."""
    return isinstance(cause, SecurityError) or (
        isinstance(cause, TemplateRuntimeError) and not isinstance(cause, UndefinedError)
    )
