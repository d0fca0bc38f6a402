"""Rules: the expressions of `when` and `ends`, such as `answers.consent.agree == "no"`. Pure.

A rule is written in a small part of Python's syntax, stored as its text, and read by Python's `ast`. It never runs as
Python: `evaluate` walks the tree, and knows the operators below and four functions.

Values are compared as people mean them: a text that is a number compares as a number ("17" < 18), and what is missing
is "". With a missing value, or a text that is no number, `<`, `<=`, `>` and `>=` are false.
"""

from __future__ import annotations

import ast
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

from hippodrome.protocol.similar import nearest

ROOTS = ("answers", "condition", "order", "participant", "run")
"""What a rule may ask about."""
FUNCTIONS = ("sum", "min", "max", "count")
MAX_LENGTH = 500  # characters
_EXAMPLE = 'such as answers.consent.agree == "no"'
_MORE = (
    "may hold only == != < <= > >= in, and or not, + - * /, sum() min() max() count(), "
    "answers. condition. order. participant. run."
)
_ORDERED: Mapping[type[ast.cmpop], Callable[[float, float], bool]] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
}
_ARITHMETIC: Mapping[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: lambda left, right: left / right if right else 0.0,
}
_COMPARISONS = {*_ORDERED, ast.Eq, ast.NotEq, ast.In, ast.NotIn}
_QUOTED_OR_NAMES = re.compile(r"""(?P<quoted>"[^"]*"|'[^']*')|[A-Za-z_]\w*(?:\.\w+)+""")


class Runs(dict[str, Mapping[str, Any]]):
    """The answers to a step of a block, by the levels of the run: a field of it stands for the list of all runs'."""


class BadRule(ValueError):
    """The rule cannot be read; str() says what to write."""


def mentioned(rule: str) -> set[tuple[str, ...]]:
    """Return the names that a rule asks about, such as ("answers", "consent", "agree"). Raises `BadRule`."""
    mentions: set[tuple[str, ...]] = set()
    nodes: list[ast.AST] = [_tree(rule)]
    while nodes:
        node = nodes.pop()
        names = _names(node)
        if names is None:
            nodes += ast.iter_child_nodes(node)
        else:
            mentions.add(names)
    return mentions


def constants(rule: str) -> list[Any]:
    """Return the texts and numbers that a rule compares with, in their order. Raises `BadRule`."""
    constants: list[Any] = []
    nodes: list[ast.AST] = [_tree(rule)]
    while nodes:
        node = nodes.pop(0)
        if isinstance(node, ast.Constant):
            constants.append(node.value)
        elif _names(node) is None:  # the name of a field in brackets is no constant
            nodes += ast.iter_child_nodes(node)
    return constants


def compared(rule: str) -> list[tuple[tuple[str, ...], str]]:
    """Return the names that a rule compares with texts, each with a text: by `==`, `!=` and `in`. Raises `BadRule`."""
    comparisons = []
    for node in ast.walk(_tree(rule)):
        sides = [node.left, *node.comparators] if isinstance(node, ast.Compare) else []
        texts = [text for side in sides if _names(side) is None for text in _texts(side)]
        comparisons += [(names, text) for side in sides if (names := _names(side)) for text in texts]
    return comparisons


def _texts(node: ast.expr) -> list[str]:
    constants = [constant.value for constant in ast.walk(node) if isinstance(constant, ast.Constant)]
    return [value for value in constants if isinstance(value, str)]


def steps_mentioned(rule: str) -> set[str]:
    """Return the steps whose answers a rule asks about. Raises `BadRule`."""
    return {names[1] for names in mentioned(rule) if names[0] == "answers" and len(names) > 1}


def holds(rule: str, facts: Mapping[str, Any]) -> bool:
    """Return whether the rule is true of these facts: a map for each of `ROOTS`. Raises `BadRule`."""
    return bool(evaluate(rule, facts))


def evaluate(rule: str, facts: Mapping[str, Any]) -> Any:
    """Return the value of a rule. Raises `BadRule`."""
    return _value(_tree(rule), facts)


def same(left: Any, right: Any) -> bool:
    """Return whether two values are equal: as numbers if one of them is a number, else as they are."""
    left, right = ("" if value is None else value for value in (left, right))
    if isinstance(left, bool) or isinstance(right, bool):
        return bool(left == right)
    if isinstance(left, int | float) or isinstance(right, int | float):
        number = _number(left)
        return number is not None and number == _number(right)
    return bool(left == right)


@lru_cache(maxsize=256)
def _tree(rule: str) -> ast.expr:
    """Read a rule. Raises `BadRule` if it has anything that `evaluate` does not know."""
    if len(rule) > MAX_LENGTH:
        raise BadRule(f"is longer than {MAX_LENGTH} characters")
    try:
        tree = ast.parse(_QUOTED_OR_NAMES.sub(_with_numeric_levels, rule.strip()), mode="eval").body
        _check(tree)
    except (SyntaxError, ValueError, RecursionError, MemoryError) as error:
        if isinstance(error, BadRule):
            raise
        raise BadRule(_why_unread(rule)) from None
    return tree


def _with_numeric_levels(match: re.Match[str]) -> str:
    """Write `answers.trust.60.q1` as Python can read it: a level may be a number."""
    return match[0] if match["quoted"] else re.sub(r"\.(\d\w*)", r'["\1"]', match[0])


def _why_unread(rule: str) -> str:
    if re.search(r"[^=!<>]=[^=]", rule):
        return "one = sets a value; write == to compare"
    if "&&" in rule or "||" in rule or "!" in rule.replace("!=", ""):
        return "write and, or, not"
    return f"cannot be read as a rule; write one {_EXAMPLE}"


def _check(node: ast.expr) -> None:
    """Raise `BadRule` unless `_value` knows everything in the tree."""
    if (names := _names(node)) is not None:
        _check_names(names)
        return
    match node:
        case ast.Constant(value=str() | int() | float()):
            return
        case ast.Call(func=ast.Name(id=name), args=[argument], keywords=[]) if name in FUNCTIONS:
            _check(argument)
            return
        case ast.Compare(ops=[_, _, *_]):
            raise BadRule("compares three values; write a < b and b < c")
        case ast.BinOp(op=ast.BitOr()):
            raise BadRule("filters such as | int are for pages; here a text that is a number compares as one")
        case ast.Compare(ops=[sign]) if type(sign) in _COMPARISONS:
            pass
        case ast.BinOp(op=sign) if type(sign) in _ARITHMETIC:
            pass
        case ast.UnaryOp(op=ast.Not() | ast.USub()) | ast.BoolOp() | ast.List() | ast.Tuple():
            pass
        case _:
            raise BadRule(_MORE)
    for inner in ast.iter_child_nodes(node):
        if isinstance(inner, ast.expr):
            _check(inner)


def _check_names(names: Sequence[str]) -> None:
    if names[0] in ROOTS:
        return
    if len(names) == 1:
        raise BadRule(f'{names[0]} is not a name here; put texts in quotes ("{names[0]}")')
    written = ".".join(names)
    if close := nearest(names[0], ROOTS):
        raise BadRule(f"{written} is not known here; did you mean {'.'.join([close, *names[1:]])}?")
    raise BadRule(f"{written} is not known here; write answers.{written} for the answer to a step")


def _names(node: ast.AST) -> tuple[str, ...] | None:
    """The names of `answers.consent.agree` or `answers["1"].agree`; None if the node is something else."""
    names: list[str] = []
    while isinstance(node, ast.Attribute | ast.Subscript):
        if isinstance(node, ast.Attribute):
            names.append(node.attr)
        elif isinstance(node.slice, ast.Constant):
            names.append(str(node.slice.value))
        else:
            return None
        node = node.value
    return (node.id, *reversed(names)) if isinstance(node, ast.Name) else None


def _value(node: ast.expr, facts: Mapping[str, Any]) -> Any:
    if (names := _names(node)) is not None:
        return _look_up(facts, names)
    match node:
        case ast.Constant(value=value):
            return value
        case ast.BoolOp(op=sign, values=inner):
            values = (_value(part, facts) for part in inner)
            return all(values) if isinstance(sign, ast.And) else any(values)
        case ast.UnaryOp(op=sign, operand=operand):
            value = _value(operand, facts)
            return not value if isinstance(sign, ast.Not) else -(_number(value) or 0)
        case ast.List(elts=inner) | ast.Tuple(elts=inner):
            return [_value(part, facts) for part in inner]
        case ast.Compare(ops=[sign], left=left, comparators=[right]):
            return _compare(sign, _value(left, facts), _value(right, facts))
        case ast.BinOp(op=sign, left=left, right=right):
            return _calculate(sign, _value(left, facts), _value(right, facts))
    assert isinstance(node, ast.Call)
    assert isinstance(node.func, ast.Name)
    return _over_runs(node.func.id, _value(node.args[0], facts))


def _calculate(sign: ast.operator, first: Any, right: Any) -> Any:
    numbers = _number(first), _number(right)
    return "" if numbers[0] is None or numbers[1] is None else _ARITHMETIC[type(sign)](numbers[0], numbers[1])


def _look_up(facts: Mapping[str, Any], names: Sequence[str]) -> Any:
    value: Any = facts
    for name in names:
        if isinstance(value, Runs) and name not in value:
            return [answers.get(names[-1], "") for answers in value.values()]
        value = value.get(name) if isinstance(value, Mapping) else None
    return "" if value is None else value


def _compare(sign: ast.cmpop, first: Any, right: Any) -> bool:
    if isinstance(sign, ast.Eq | ast.NotEq):
        return same(first, right) == isinstance(sign, ast.Eq)
    if isinstance(sign, ast.In | ast.NotIn):
        among = right if isinstance(right, list) else [right]
        return any(same(first, item) for item in among) == isinstance(sign, ast.In)
    numbers = _number(first), _number(right)
    return numbers[0] is not None and numbers[1] is not None and _ORDERED[type(sign)](numbers[0], numbers[1])


def _over_runs(name: str, values: Any) -> Any:
    numbers = [*_numbers(values if isinstance(values, list) else [values])]
    if name == "count":
        return len(numbers)
    if name == "sum":
        return sum(numbers)
    return (min if name == "min" else max)(numbers, default="")


def _numbers(values: Sequence[Any]) -> Iterator[float]:
    yield from (number for value in values if (number := _number(value)) is not None)


def _number(value: Any) -> float | None:
    if isinstance(value, bool) or not isinstance(value, int | float | str):
        return None
    try:
        return float(value)
    except (ValueError, OverflowError):
        return None
