"""Finds answers that a page names but no participant can have given: the page shows nothing there."""

from __future__ import annotations

from collections.abc import Iterator

from jinja2 import nodes

from hippodrome.control.config import Diagnostic
from hippodrome.local.check.earlier_answers import EarlierAnswers
from hippodrome.local.check.wording import short
from hippodrome.protocol.similar import did_you_mean


def check_answers_named(label: str, parsed: nodes.Template, earlier: EarlierAnswers) -> Iterator[Diagnostic]:
    """Yield remarks on steps that the study does not have, and on fields that an earlier step does not have."""
    called = {id(call.node) for call in parsed.find_all(nodes.Call)}  # `answers["2"].items()` is a method
    for node in _lookups(parsed):
        if id(node) in called:
            continue
        inner, key = node.node, _key(node)
        if _is_answers(inner) and isinstance(key, int) and not isinstance(key, bool):
            yield _remark(label, node, f'write answers["{key}"], with quotes')
        if _is_answers(inner) and isinstance(key, str) and (why := earlier.why_no_step(key)):
            yield _remark(label, node, why)
        if not isinstance(inner, nodes.Getitem | nodes.Getattr) or not _is_answers(inner.node):
            continue
        if not isinstance(key, str):
            continue
        step = _key(inner)
        fields = earlier.fields_of(step) if isinstance(step, str) else None
        if fields is not None and key not in fields:
            has = ", ".join(fields) or "no fields"
            message = f"step {step} has no answer {short(key)}{did_you_mean(key, fields)} (it has {short(has)})"
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
