"""What the log groups of an installation are called."""

from __future__ import annotations

API = "api"  # the site's access log

_OURS = "/hippodrome/{}/"
_VENDED = (
    "/aws/vendedlogs/hippodrome/{}/"  # where a service of AWS writes, by a policy that names no group of this prefix
)


def prefixes(stack: str) -> tuple[str, ...]:
    """What the names of all its groups begin with."""
    return _OURS.format(stack), _VENDED.format(stack)


def group(stack: str, source: str) -> str:
    """The group of a source: a function's name, `trial`, `image` or `api`."""
    return (_VENDED if source == API else _OURS).format(stack) + source


def source(stack: str, name: str) -> str:
    """The source of a group by its name."""
    return name.removeprefix(_OURS.format(stack)).removeprefix(_VENDED.format(stack))
