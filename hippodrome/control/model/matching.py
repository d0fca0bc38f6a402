"""The values of `matching` and `seats` in config.yml, which say who plays with whom, and which player. Pure."""

from __future__ import annotations

from collections.abc import Mapping

MATCH = "match"
MATCHINGS = ("arrival", "group", "mixed", MATCH)
"""Who plays together: participants in the order of their arrival, of one group, of different groups, or those whom the
function `match` chooses."""
MATCHED_BY = ("same", "different")
"""The keys of a `matching` that is a map. They mean participants with the same answer, or with different answers, in a
field of a page."""

SEATS = ("lot", "group", "match")
"""What decides which player a member of a session plays: the lot, the number of the member's group, or the order in
which `match` names the members."""


def field_of(matching: str | Mapping[str, str]) -> str | None:
    """Return the field of an earlier page by whose answers participants are matched.

    The result is None if they are not matched by answers.
    """
    return None if isinstance(matching, str) else next(iter(matching.values()), None)
