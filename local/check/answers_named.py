"""Answers that a page names and that no participant can have given: the page shows nothing in their place."""

from __future__ import annotations

from collections.abc import Iterator

from jinja2 import nodes

from hippodrome.config import Diagnostic
from local.check.earlier_answers import EarlierAnswers
from local.check.wording import short
from protocol.similar import did_you_mean

_METHODS = frozenset(dir(dict))
"""`answers["2"].items` is the method of Python's dictionary, and no field."""


def check_answers_named(label: str, parsed: nodes.Template, earlier: EarlierAnswers) -> Iterator[Diagnostic]:
    """Remarks on steps that are not named in quotes, and on fields that an earlier step does not have."""
    for node in _lookups(parsed):
        step = _key(node)
        if _is_answers(node.node) and isinstance(step, int) and not isinstance(step, bool):
            yield _remark(label, node, f'write answers["{step}"], with quotes')
        inner, field = node.node, step
        if not isinstance(inner, nodes.Getitem | nodes.Getattr) or not _is_answers(inner.node):
            continue
        if not isinstance(field, str) or (isinstance(node, nodes.Getattr) and field in _METHODS):
            continue
        key = _key(inner)
        known = earlier.fields_of(key) if isinstance(key, str) else None
        if known is not None and field not in known:
            has = ", ".join(known) or "no fields"
            message = f"step {key} has no answer {short(field)}{did_you_mean(field, known)} (it has {short(has)})"
            yield _remark(label, node, message)


def _lookups(parsed: nodes.Template) -> Iterator[nodes.Getitem | nodes.Getattr]:
    yield from parsed.find_all(nodes.Getitem)
    yield from parsed.find_all(nodes.Getattr)


def _remark(label: str, node: nodes.Node, why: str) -> Diagnostic:
    return Diagnostic(label, node.lineno, "", f"nothing is shown: {why}", remark=True)


def _is_answers(node: nodes.Node) -> bool:
    return isinstance(node, nodes.Name) and node.name == "answers"


def _key(node: nodes.Getitem | nodes.Getattr) -> object:
    return node.attr if isinstance(node, nodes.Getattr) else getattr(node.arg, "value", None)
