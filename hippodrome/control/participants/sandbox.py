"""Fills values into researchers' pages (`fragments.py`) in Jinja's sandbox. Jinja is imported once it is needed.

The sandbox keeps pages from Python's internals, and ends a page that is too long or whose loops are; what a single
expression does is up to its author (docs/security.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import cache, lru_cache
from random import Random
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Template
    from jinja2.sandbox import ImmutableSandboxedEnvironment

LIMIT = 2_000_000  # characters of a rendered page
ROUNDS = 100_000  # of all loops over range() in a page
READING = frozenset({"copy", "get", "items", "keys", "values"})
"""The methods of Python's dictionaries that a page may call, unless the dictionary has a value of that name."""
VALUES_READ = frozenset({"participant", "answers", "condition", "order"})
"""The values that cost reads of the participant's documents."""


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
    whole = {id(node) for node in parsed.find_all(nodes.Name) if node.name == "answers"} - {
        name_node for name_node, _ in steps
    }
    return {"answers"} if whole else {f"answers.{key}" for _, key in steps}


def render(text: str, values: Mapping[str, Any]) -> str:
    """Return the page with these values. Raises FragmentError."""
    parts: list[str] = []
    length = 0
    try:
        for part in _compile(text).generate({"range": _counted_range(), **values}):
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


def shuffler(seed: str) -> Callable[[Iterable[Any]], list[Any]]:
    """Return the function `shuffle` of one page: it gives the same orders whenever a page with this seed is made."""
    calls = 0

    def shuffle(values: Iterable[Any]) -> list[Any]:
        nonlocal calls
        calls += 1
        shuffled = list(values)
        Random(f"{seed}/{calls}").shuffle(shuffled)  # noqa: S311 - an order is no secret
        return shuffled

    return shuffle


def _counted_range() -> Callable[..., range]:
    """Return the function `range` of one page. A page that loops for hours would hold up everything else."""
    rounds_left = ROUNDS

    def counted(*bounds: int) -> range:
        nonlocal rounds_left
        numbers = range(*bounds)
        rounds_left -= len(numbers)
        if rounds_left < 0:
            raise OverflowError(f"the page's loops over range() have more than {ROUNDS} rounds")
        return numbers

    return counted


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


@cache
def environment() -> ImmutableSandboxedEnvironment:
    """Return the sandbox of all pages, which is made once."""
    from jinja2 import ChainableUndefined  # noqa: PLC0415 - as above
    from jinja2.sandbox import ImmutableSandboxedEnvironment  # noqa: PLC0415

    class Method(ChainableUndefined):
        """A method of a dictionary. Unless it is called, it is a value that does not exist."""

        def __call__(self, *args: Any, **kwargs: Any) -> Any:
            return getattr(self._undefined_obj, str(self._undefined_name))(*args, **kwargs)

    class Environment(ImmutableSandboxedEnvironment):
        """The sandbox. In it `answers["2"].items` is the answer named `items`, as `answers["2"]["items"]` is."""

        def getattr(self, obj: Any, attribute: str) -> Any:
            return self._entry(obj, attribute) if isinstance(obj, Mapping) else super().getattr(obj, attribute)

        def getitem(self, obj: Any, argument: Any) -> Any:
            return self._entry(obj, argument) if isinstance(obj, Mapping) else super().getitem(obj, argument)

        def _entry(self, obj: Mapping[Any, Any], key: Any) -> Any:
            try:
                return obj[key]
            except (LookupError, TypeError):  # TypeError: a key that no dictionary can have
                return (Method if isinstance(key, str) and key in READING else self.undefined)(obj=obj, name=key)

    def empty(value: object) -> None:
        """Make a missing value null in JSON; in a text it is empty."""
        if not isinstance(value, ChainableUndefined):
            raise TypeError(f"{type(value).__name__} is not JSON serializable")

    sandbox = Environment(autoescape=True, undefined=ChainableUndefined, keep_trailing_newline=True, finalize=_shown)
    sandbox.policies["json.dumps_kwargs"] = {"sort_keys": True, "default": empty}
    return sandbox


def _shown(value: Any) -> Any:
    """What a page shows of a value: nothing of a function, which is never an answer."""
    return "" if callable(value) else value
