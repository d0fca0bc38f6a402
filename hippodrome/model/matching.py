"""The values of `matching` and `seats` in config.yml, which say who plays with whom, and which player. Pure."""

from __future__ import annotations

from collections.abc import Mapping

MATCH = "match"
MATCHINGS = ("arrival", "group", "mixed", MATCH)
"""In the order of arrival; people of one group; people of different groups; as the function `match` has chosen."""
MATCHED_BY = ("same", "different")
"""The keys of a `matching` that is a map: people with the same answer, or with different ones, in a field of a page."""

SEATS = ("lot", "group", "match")
"""Which member of a session plays which player: by lot; by the number of the group; in the order in which `match` names
the members."""


def field_of(matching: str | Mapping[str, str]) -> str | None:
    """Return the field of an earlier page by whose answers participants are matched.

    The result is None if they are not matched by answers.
    """
    return None if isinstance(matching, str) else next(iter(matching.values()), None)
