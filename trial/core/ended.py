"""What is over: an episode or a break. Pure records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

PARTNER_LEFT = "partnerLeft"
"""The outcome of a trial that has ended because a member of the session stays away."""


@dataclass(frozen=True, slots=True)
class Episode:
    """An episode that is over. `why`: terminated, truncated, reset, stopped, failed, turnSeconds (a turn's), or
    partnerLeft (a member of the session).

    `score` is that of the first human; `scores` are those of all players, if there are several.
    """

    number: int
    steps: int
    score: float
    why: str
    scores: Mapping[str, float] = field(default_factory=dict)
    limit: str | None = None
    """The key of `trial` whose limit truncated it: maxSteps or episodeSeconds."""


@dataclass(frozen=True, slots=True)
class Break:
    """A break that is over. `after`: the number of the episode before it.

    `why`: over (its time), start, pause or stop (the player's command), left (the player), failed, partnerLeft.
    """

    after: int
    why: str
