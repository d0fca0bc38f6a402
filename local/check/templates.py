"""What is wrong with a page's Jinja: whether it can be read, and shown to participants with few or many answers."""

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

VALUES = ("answers", "completion_code", "group", "participant", "project")  # what a page may mention: docs/pages.md


def check_template(
    label: str, source: str, config: Config | None, groups: list[int | None], earlier: EarlierAnswers
) -> Iterator[Diagnostic]:
    """Whether the page can be read, and can be shown to a participant who has answered the pages before it."""
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
    if unknown:  # Jinja would say the same of the first
        yield from unknown
        return
    strangers = meta.find_undeclared_variables(parsed) - {*VALUES, *environment.globals}
    for name in parsed.find_all(nodes.Name):
        if name.name in strangers:
            strangers.remove(name.name)
            message = f"nothing is shown: there is no value {short(name.name)}{did_you_mean(name.name, VALUES)}"
            yield Diagnostic(label, name.lineno, "", message, remark=True)
    yield from check_answers_named(label, parsed, earlier)
    for group in groups:
        for answers in earlier.answers(group):
            known = _nothing_known(config, group)
            if config:
                known["participant"] |= _met(answers, config)
            try:
                page.render({**known, "answers": answers})
            except FragmentError as error:
                yield _failing(label, error, may_depend=bool(sandbox.records_mentioned(page.text)))
                return


def _unread(error: TemplateSyntaxError) -> str:
    comment = (
        '; {# begins a comment, also in a style: write "{ #" there' if "end of comment" in str(error.message) else ""
    )
    return f"Jinja cannot read this: {short(error.message or '')}{comment}"


def _unknown(label: str, parsed: nodes.Template, environment: Any) -> Iterator[Diagnostic]:
    """Filters and tests that do not exist: Jinja itself finds those of a condition only when it holds."""
    for kind, node_type, known in (
        ("filter", nodes.Filter, environment.filters),
        ("test", nodes.Test, environment.tests),
    ):
        for node in parsed.find_all(node_type):
            if node.name not in known:
                message = f"there is no {kind} {short(node.name)} in Jinja{did_you_mean(node.name, known)}"
                yield Diagnostic(label, node.lineno, "", message)


def _nothing_known(config: Config | None, group: int | None) -> dict[str, Any]:
    """What a page may mention, for a participant who has not answered anything."""
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


def _met(answers: Mapping[str, Mapping[str, Any]], config: Config) -> dict[str, Any]:
    """What a page after a game of several may mention of the participant; nothing on pages before it."""
    played = [answers[step.key] for step in config.game_steps if step.key in answers]
    if not config.project.has_sessions or not played:
        return {}
    alone = played[0].get("outcome") == UNMATCHED
    return {"unmatched": alone, "members": 0 if alone else config.project.players}


def _failing(label: str, error: FragmentError, may_depend: bool) -> Diagnostic:
    """A page that cannot be shown; only a remark if it may be possible with answers."""
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
    """Whether it fails whatever the participants answer."""
    return isinstance(cause, SecurityError) or (
        isinstance(cause, TemplateRuntimeError) and not isinstance(cause, UndefinedError)
    )
