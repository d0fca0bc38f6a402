"""Who plays with whom (`matching` in config.yml): its values. Pure."""

from __future__ import annotations

from collections.abc import Mapping

MATCH = "match"
MATCHINGS = ("arrival", "group", "mixed", MATCH)
"""Who came first, people of one group, of different groups, or as the function `match` of agent.py says."""
MATCHED_BY = ("same", "different")
"""By what they answered in a field of an earlier page."""

SEATS = ("lot", "group", "match")
"""Who of a session plays which player: by lot, by the number of the group, or in the order in which `match` names
the members."""


def field_of(matching: str | Mapping[str, str]) -> str | None:
    """The field of an earlier page whose answers decide; None if none does."""
    return None if isinstance(matching, str) else next(iter(matching.values()), None)
