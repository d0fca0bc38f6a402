"""Episodes and breaks that are over. Pure records."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

PARTNER_LEFT = "partnerLeft"
"""The outcome of a trial that has ended because a member of the session stays away."""


@dataclass(frozen=True, slots=True)
class Episode:
    """An episode that is over. `score` is that of the first human; `scores` are those of all players, if several.

    `why`: terminated, truncated, reset or stopped (a command), failed (the researcher's code), turnSeconds (the time of
    a turn was over) or partnerLeft (a member of the session stays away).
    """

    number: int
    steps: int
    score: float
    why: str
    scores: Mapping[str, float] = field(default_factory=dict)
    limit: str | None = None
    """The key of `trial` whose limit truncated it, maxSteps or episodeSeconds; None if no limit did."""
    success: bool = False
    """Whether the info of its last step has a true `success`."""


@dataclass(frozen=True, slots=True)
class Break:
    """A break that is over. `after` is the number of the episode before it.

    `why`: over (its time), start, pause or stop (a participant's command), left (the participant has left), failed,
    shutdown (the server had to end) or partnerLeft (a member of the session stays away).
    """

    after: int
    why: str
