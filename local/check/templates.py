"""Checks a page's Jinja: whether it can be parsed, and shown to participants with few or many answers."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from jinja2 import meta, nodes
from jinja2.exceptions import SecurityError, TemplateRuntimeError, TemplateSyntaxError, UndefinedError

from hippodrome.config import Config, Diagnostic
from hippodrome.participants import fragments, sandbox
from hippodrome.participants.sandbox import FragmentError
from local.check.answers_named import check_answers_named
from local.check.earlier_answers import EarlierAnswers
from local.check.wording import short
from protocol.answer import UNMATCHED
from protocol.similar import did_you_mean

VALUES = ("answers", "completion_code", "group", "participant", "project")
"""The values that a page may use (docs/pages.md)."""


def check_template(
    label: str, source: str, config: Config | None, groups: list[int | None], earlier: EarlierAnswers
) -> Iterator[Diagnostic]:
    """Yield the problems of the page: in parsing it, and in showing it to participants with different answers."""
    page = fragments.prepare(source)
    if not sandbox.uses_jinja(page.text):
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
    yield from check_answers_named(label, parsed, earlier)
    for group in groups:
        for answers in earlier.answers(group):
            values = _values(config, group)
            if config:
                values["participant"] |= _company(answers, config)
            try:
                page.render({**values, "answers": answers})
            except FragmentError as error:
                yield _failing(label, error, may_depend=bool(sandbox.records_mentioned(page.text)))
                return


def _unread(error: TemplateSyntaxError) -> str:
    """The message for a page that Jinja cannot parse."""
    comment = (
        '; {# begins a comment, also in a style: write "{ #" there' if "end of comment" in str(error.message) else ""
    )
    return f"Jinja cannot read this: {short(error.message or '')}{comment}"


def _unknown(label: str, parsed: nodes.Template, environment: Any) -> Iterator[Diagnostic]:
    """Filters and tests that do not exist. Jinja itself finds them inside an {% if %} only if its condition is true."""
    for kind, node_type, known in (
        ("filter", nodes.Filter, environment.filters),
        ("test", nodes.Test, environment.tests),
    ):
        for node in parsed.find_all(node_type):
            if node.name not in known:
                message = f"there is no {kind} {short(node.name)} in Jinja{did_you_mean(node.name, known)}"
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
    }


def _company(answers: Mapping[str, Mapping[str, Any]], config: Config) -> dict[str, Any]:
    """What `participant` has after a game of several: whether they found others, and how many they were together."""
    played = [answers[step.key] for step in config.game_steps if step.key in answers]
    if not config.project.has_sessions or not played:
        return {}
    alone = played[0].get("outcome") == UNMATCHED
    return {"unmatched": alone, "members": 0 if alone else config.project.players}


def _failing(label: str, error: FragmentError, may_depend: bool) -> Diagnostic:
    """The mistake of a page that cannot be shown; a remark if that may depend on the participant's answers."""
    cause, why = error.__cause__, short(error.message)
    if isinstance(cause, TypeError) and "no loader" in str(cause):
        why = "include, import and extends do not work: a page is one file"
    elif isinstance(cause, TemplateSyntaxError):
        why = _unread(cause)
    elif may_depend and cause is not None and not _certain(cause):
        why = f"a participant without the answer gets an error page here ({why}); |default(…) helps"
        return Diagnostic(label, error.line, "", why, remark=True)
    else:
        why = f"the page cannot be shown: {why}"
    return Diagnostic(label, error.line, "", why)


def _certain(cause: BaseException) -> bool:
    """Whether the page fails for every participant, whatever they have answered."""
    return isinstance(cause, SecurityError) or (
        isinstance(cause, TemplateRuntimeError) and not isinstance(cause, UndefinedError)
    )
