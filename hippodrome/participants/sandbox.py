"""Fills values into researchers' pages (`fragments.py`) in Jinja's sandbox. Jinja is imported once it is needed."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache, lru_cache, wraps
from string import Formatter
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Template, nodes
    from jinja2.sandbox import ImmutableSandboxedEnvironment

LIMIT = 2_000_000  # characters of a rendered page
VALUES_READ = frozenset({"participant", "answers"})  # the values that cost reads of the participant's documents
MAX_MADE = 10 * LIMIT  # characters that an operator, a filter or a method may make of shorter texts
MULTIPLYING = (
    "batch", "center", "format", "indent", "join", "replace", "round", "slice", "tojson", "truncate", "urlize",
    "wordwrap",
)  # fmt: skip
"""The filters of Jinja whose result may be much longer than all that they are given."""
_WIDTHS = re.compile(r"[%)][-#0 +]*([0-9]*)(?:\.([0-9]*))?")  # of placeholders such as %9d and %(name)9.2f
_GIVEN_WIDTH = re.compile(r"%[-#0 +]*[0-9]*\.?\*")  # such as %*d, whose width is among the values


class FragmentError(Exception):
    """Jinja cannot render a step page. `line` is the line in the researcher's file; None if it is not known."""

    def __init__(self, message: str, line: int | None = None) -> None:
        super().__init__(message)
        self.message = message
        self.line = line


def uses_jinja(text: str) -> bool:
    """Return whether Jinja has to render this text.

    `{#` alone does not count: style sheets have `@media print{#menu{…}}`.
    """
    return "{{" in text or "{%" in text or ("{#" in text and "#}" in text)


@lru_cache(maxsize=64)
def records_mentioned(source: str) -> frozenset[str]:
    """Return the names of the participant's documents that a step page uses.

    They are `participant`, `answers`, or single steps such as `answers.3`; none for a page that Jinja cannot parse.
    """
    if not uses_jinja(source):
        return frozenset()
    from jinja2 import meta  # noqa: PLC0415 - most pages need no Jinja, and its import costs cold starts

    try:
        parsed = environment().parse(source)
        mentioned = meta.find_undeclared_variables(parsed) & VALUES_READ
    except Exception:  # noqa: BLE001 - the parser fails in many ways; rendering will tell which
        return frozenset()
    if "answers" not in mentioned:
        return frozenset(mentioned)
    return frozenset(mentioned - {"answers"} | _answers(parsed))


def _answers(parsed: Any) -> set[str]:
    """`answers.{step}` for each step that the page names in this way; `answers` if it uses answers in another way."""
    from jinja2 import nodes  # noqa: PLC0415 - as above

    steps = set()
    for node in parsed.find_all((nodes.Getitem, nodes.Getattr)):
        if isinstance(node.node, nodes.Name) and node.node.name == "answers":
            key = node.attr if isinstance(node, nodes.Getattr) else getattr(node.arg, "value", None)
            if isinstance(key, str):
                steps.add((id(node.node), key))
    whole = {id(node) for node in parsed.find_all(nodes.Name) if node.name == "answers"} - {one for one, _ in steps}
    return {"answers"} if whole else {f"answers.{key}" for _, key in steps}


def render(text: str, values: Mapping[str, Any]) -> str:
    """Return the page with these values. Raises FragmentError."""
    parts: list[str] = []
    length = 0
    try:
        for part in _compile(text).generate(values):
            parts.append(part)
            length += len(part)
            if length > LIMIT:
                raise FragmentError(
                    "the page is larger than 2 MB with its values filled in; look for a loop that repeats too much"
                )
    except FragmentError:
        raise
    except Exception as error:  # a template can fail in any way
        raise FragmentError(f"{type(error).__name__}: {error}", _line(error)) from error
    return "".join(parts)


@lru_cache(maxsize=64)
def _compile(text: str) -> Template:
    return environment().from_string(text)


def _line(error: Exception) -> int | None:
    """The line of the template at which it failed, from Jinja's syntax error or from the traceback."""
    line: int | None = getattr(error, "lineno", None)
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == "<template>":
            line = trace.tb_lineno
        trace = trace.tb_next
    return line


def _size(value: object) -> int:
    """Return about how many characters the value has as a text; beyond `MAX_MADE` only that it is more.

    What is in lists in lists counts more, since `tojson` may indent it.
    """
    size, rest = 0, [iter([value])]
    while rest and size <= MAX_MADE:
        for one in rest[-1]:
            size += len(one) if isinstance(one, str | bytes) else len(rest)
            if isinstance(one, Mapping):
                rest.append(iter([*one.items()]))
                break
            if isinstance(one, list | tuple | set | frozenset):
                rest.append(iter(one))
                break
            if size > MAX_MADE:  # a long list without others in it
                break
        else:
            rest.pop()
    return size


def _refuse_growth(name: str, text: object, others: Iterable[object]) -> None:
    """Raise SecurityError if an operation could make more than `MAX_MADE` characters of a text or list.

    It makes at most as many as the text has, times the longest of the other texts, or times the greatest number.
    """
    from jinja2.exceptions import SecurityError  # noqa: PLC0415 - as above

    times = max((abs(one) if isinstance(one, int) else _size(one) for one in others), default=1)
    if max(_size(text), 1) * max(times, 1) > MAX_MADE:
        raise SecurityError(f"the result of {name} would be too large")


def _percent_widths(text: str) -> list[int]:
    """The widths and precisions of the placeholders in a text for the operator `%`."""
    if _GIVEN_WIDTH.search(text):
        return [MAX_MADE]
    return [int(number) for found in _WIDTHS.findall(text) for number in found if number]


def _format_widths(text: str) -> list[int]:
    """The widths and precisions of the placeholders in a text for `format`."""
    specs = [spec for _, _, spec, _ in Formatter().parse(text) if spec]
    if any("{" in spec for spec in specs):  # the width is among the values
        return [MAX_MADE]
    return [int(number) for spec in specs for number in re.findall("[0-9]+", spec)]


def _listed(values: Iterator[object]) -> list[object]:
    """Return the items of an iterator. Raises SecurityError if they have more than `MAX_MADE` characters together."""
    found: list[object] = []
    size = 0
    for one in values:
        size += _size(one)
        _refuse_growth("a filter", "", [size])
        found.append(one)
    return found


def _limited(name: str, apply: Callable[..., Any]) -> Callable[..., Any]:
    """Return the filter of Jinja with this name, but it raises SecurityError before it makes a text too long."""
    begin = 1 if hasattr(apply, "jinja_pass_arg") else 0  # the context of the evaluation comes first

    @wraps(apply)  # with jinja_pass_arg
    def limited(*args: Any, **kwargs: Any) -> Any:
        context, (value, *others) = args[:begin], args[begin:]
        value = _listed(value) if isinstance(value, Iterator) else value
        widths = _percent_widths(str(value)) if name == "format" else []
        _refuse_growth(name, value, [*others, *kwargs.values(), *widths])
        return apply(*context, value, *others, **kwargs)

    return limited


def _join(texts: Iterable[str]) -> str:
    """Join the parts of a macro's result, or of a `{% set %}` with an end, as Jinja does, but only up to `MAX_MADE`."""
    parts = [*texts]
    _refuse_growth("a block", "", [sum(map(len, parts))])
    return "".join(parts)


@cache
def environment() -> ImmutableSandboxedEnvironment:
    """Return the sandbox of all pages, which is made once."""
    from jinja2 import ChainableUndefined, nodes  # noqa: PLC0415 - as above
    from jinja2.exceptions import SecurityError  # noqa: PLC0415
    from jinja2.sandbox import ImmutableSandboxedEnvironment  # noqa: PLC0415
    from jinja2.visitor import NodeTransformer  # noqa: PLC0415

    class Concatenation(NodeTransformer):
        """Writes `a ~ b` as `[a, b]|join`, which is the same and limited."""

        def visit_Concat(self, node: nodes.Concat) -> nodes.Filter:  # noqa: N802 - Jinja's name
            self.generic_visit(node)
            return nodes.Filter(nodes.List(node.nodes), "join", [], [], None, None, lineno=node.lineno)

    class Environment(ImmutableSandboxedEnvironment):
        """The sandbox, which also refuses to multiply a small text into a huge one."""

        intercepted_binops = frozenset({"+", "*", "**", "%"})
        concat = staticmethod(_join)

        def _parse(self, source: str, name: str | None, filename: str | None) -> nodes.Template:
            found: nodes.Template = Concatenation().visit(super()._parse(source, name, filename))
            return found

        def call_binop(self, context: Any, operator: str, left: Any, right: Any) -> Any:
            call: Callable[[Any, Any], Any] = self.binop_table[operator]
            parts = [side for side in (left, right) if isinstance(side, str | bytes | list | tuple)]
            counts = [abs(side) for side in (left, right) if isinstance(side, int)]
            too_long = operator == "*" and any(len(part) * count > LIMIT for part in parts for count in counts)
            too_long = too_long or (operator == "+" and sum(map(len, parts)) > LIMIT)
            too_large = operator == "**" and isinstance(right, int) and abs(right) > 64
            if too_long or too_large:
                raise SecurityError(f"the result of {operator} would be too large")
            if operator == "*" and parts:
                _refuse_growth("*", parts[0], counts)  # a list may have long texts
            if operator == "%" and isinstance(left, str | bytes):
                text = left if isinstance(left, str) else left.decode("latin-1")
                _refuse_growth("%", text, [_size(right), *_percent_widths(text)])
            return call(left, right)

        def call(self, context: Any, called: Any, /, *args: Any, **kwargs: Any) -> Any:
            text = getattr(called, "__self__", None)
            given = [*args, *kwargs.values()]
            if isinstance(text, str | bytes | int):  # a method, such as center
                _refuse_growth(called.__name__, text, given)
            if called is self.globals["lipsum"]:  # up to so many paragraphs and words in each, of 100 unless it is said
                numbers = [one for one in given if isinstance(one, int) and one > 0]
                _refuse_growth("lipsum", "", [math.prod(numbers) * 1000])
            return super().call(context, called, *args, **kwargs)

        def wrap_str_format(self, value: Any) -> Callable[..., str] | None:
            wrapped = super().wrap_str_format(value)
            if wrapped is None:
                return None

            def format_text(*args: Any, **kwargs: Any) -> str:
                text = value.__self__
                _refuse_growth("format", text, [_size([args, kwargs]), *_format_widths(text)])
                return wrapped(*args, **kwargs)

            return format_text

    def empty(value: object) -> None:
        """Make a missing value null in JSON; in a text it is empty."""
        if not isinstance(value, ChainableUndefined):
            raise TypeError(f"{type(value).__name__} is not JSON serializable")

    made = Environment(autoescape=True, undefined=ChainableUndefined, keep_trailing_newline=True)
    made.filters |= {name: _limited(name, made.filters[name]) for name in MULTIPLYING}
    made.policies["json.dumps_kwargs"] = {"sort_keys": True, "default": empty}
    return made
