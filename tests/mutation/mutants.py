"""The mutants of a module: its source with one small change each, made on the syntax tree.

Annotations, decorators, docstrings, log calls (`failure` is one), f-strings and strings of several words stay as they
are: no test should judge wording.

No package does this well. mutmut 3.8 leaves out every property, and all code outside of functions (tables, regular
expressions). cosmic-ray 8.7 never leaves a statement out, changes the sources in their own folder, and a fifth of its
mutants change an annotation, which nothing evaluates. Neither takes a sample.
"""

from __future__ import annotations

import ast
import difflib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

COMPARISONS: dict[type, tuple[type, ...]] = {
    ast.Lt: (ast.LtE, ast.GtE),
    ast.LtE: (ast.Lt, ast.Gt),
    ast.Gt: (ast.GtE, ast.LtE),
    ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq,),
    ast.Is: (ast.IsNot,),
    ast.IsNot: (ast.Is,),
    ast.In: (ast.NotIn,),
    ast.NotIn: (ast.In,),
}
OPERATORS: dict[type, type] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Mod: ast.Mult,
    ast.BitOr: ast.BitAnd,
    ast.BitAnd: ast.BitOr,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.Break: ast.Continue,
    ast.Continue: ast.Break,
}
UNTOUCHED = ("annotation", "returns", "decorator_list", "type_params")


@dataclass(frozen=True)
class Mutant:
    """A module with one change. `was` and `becomes` are the lines that differ, as `ast.unparse` writes them."""

    module: str
    line: int
    was: str
    becomes: str
    source: str

    @property
    def key(self) -> tuple[str, str, str]:
        return self.module, self.was, self.becomes


@dataclass(frozen=True)
class Change:
    """A place in a syntax tree (an attribute of a node, or an entry of a list), and a node that can replace it."""

    holder: Any
    place: str | int
    line: int
    new: Any

    def swap(self, value: Any) -> Any:
        """Put `value` at the place, and return what was there."""
        if isinstance(self.holder, list):
            self.holder[self.place], before = value, self.holder[self.place]  # type: ignore[index]
        else:
            before = getattr(self.holder, str(self.place))
            setattr(self.holder, str(self.place), value)
        return before


class Mutants:
    """All mutants of a module, as a sequence. The source of each is written only when it is asked for."""

    def __init__(self, module: str, source: str) -> None:
        self.module = module
        self._tree = ast.parse(source)
        self._before = ast.unparse(self._tree)
        self._changes = list(_changes(self._tree))

    def __len__(self) -> int:
        return len(self._changes)

    def __getitem__(self, index: int) -> Mutant:
        change = self._changes[index]
        before = change.swap(change.new)
        source = ast.unparse(self._tree)
        change.swap(before)
        lines = list(difflib.unified_diff(self._before.splitlines(), source.splitlines(), lineterm="", n=0))[3:]
        was = "\n".join(line[1:].strip() for line in lines if line.startswith("-"))
        becomes = "\n".join(line[1:].strip() for line in lines if line.startswith("+"))
        return Mutant(self.module, change.line, was, becomes, source)


def _changes(node: ast.AST) -> Iterator[Change]:
    for name, value in ast.iter_fields(node):
        if name in UNTOUCHED:
            continue
        if isinstance(node, ast.ClassDef) and name == "keywords":
            continue
        places: list[tuple[Any, str | int, Any]] = [(node, name, value)]
        if isinstance(value, list):
            places = [(value, index, child) for index, child in enumerate(value)]
        for holder, place, child in places:
            if isinstance(child, ast.AST) and not _is_wording(child):
                line = getattr(child, "lineno", getattr(node, "lineno", 0))
                tests = name in ("test", "ifs")
                yield from (Change(holder, place, line, new) for new in _instead(child, tests=tests))
                yield from _changes(child)


def _is_wording(node: ast.AST) -> bool:
    """Return whether a node is a docstring, a log call, or something that only readers and type checkers use."""
    if isinstance(node, ast.Assign):
        name = ast.unparse(node.targets[0])
        return ast.unparse(node).startswith(("__all__ =", f"{name} = TypeVar(", f"{name} = Literal["))
    if not isinstance(node, ast.Expr):
        return isinstance(node, ast.JoinedStr | ast.Import | ast.ImportFrom)
    call = node.value
    logs = isinstance(call, ast.Call) and ast.unparse(call).startswith(
        ("logger.", "log(", "failure(", "self._emit(WriteLog(")
    )
    return logs or isinstance(call, ast.Constant)


def _instead(node: ast.AST, *, tests: bool) -> Iterator[ast.AST]:
    """Yield the nodes that can replace a node. `tests`: the node is a condition, which can be negated."""
    if tests and not isinstance(node, ast.Compare | ast.UnaryOp):  # those are turned round below
        yield ast.UnaryOp(ast.Not(), node)  # type: ignore[arg-type]
    match node:
        case ast.cmpop():
            yield from (kind() for kind in COMPARISONS[type(node)])
        case ast.operator() | ast.boolop() | ast.Break() | ast.Continue():
            yield from (kind() for kind in [OPERATORS.get(type(node))] if kind)
        case ast.UnaryOp(op=ast.Not()):
            yield node.operand
        case ast.Constant():
            yield from (ast.Constant(value) for value in _other_values(node.value))
        case ast.Return(value=ast.expr()) if not (isinstance(node.value, ast.Constant) and not node.value.value):
            yield ast.Return(ast.Constant(None))
        case ast.Expr(value=ast.Call() | ast.Await()) | ast.Raise() | ast.Delete() | ast.AugAssign():
            yield ast.Pass()
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            yield ast.Pass()
        case ast.Call() if len(node.keywords) > 0:
            for left_out in node.keywords:
                yield ast.Call(node.func, node.args, [keyword for keyword in node.keywords if keyword is not left_out])


def _other_values(value: Any) -> Iterator[Any]:
    match value:
        case bool():
            yield not value
        case int() | float():
            yield value + 1
        case str() if not any(map(str.isspace, value)):
            yield value + "XX"
        case bytes():
            yield value + b"XX"
