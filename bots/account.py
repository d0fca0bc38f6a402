"""What a bot has sent, seen and run into."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class PlayedStep:
    """One game step."""

    step: str
    addresses: list[str] = field(default_factory=list)
    waited: float = 0.0  # seconds on the waiting page
    lobby: float | None = None  # seconds until others were found to play with, or the bot went on alone; None: no lobby
    members: int = 1  # who play together
    unmatched: bool = False  # no others were found, so nothing was played
    outcome: str = ""  # as a game of several participants says at its end
    frames: int = 0  # received, after the first picture of each connection
    frame_rate: int = 0  # as the server says
    seconds: float = 0.0  # of playing, from the first to the last frame
    seen: int = 0  # frames received in these seconds
    bytes: int = 0
    score: float = 0
    episodes: int = 0
    done: bool = False

    @property
    def received_rate(self) -> float | None:
        """Frames per second while playing; None after too short a game."""
        return self.seen / self.seconds if self.seconds >= 1 else None


@dataclass
class BotReport:
    """What one bot has sent, seen and run into."""

    user_id: str
    stage: str = "waits for its turn"
    finished: bool = False
    answers: dict[str, dict[str, str | list[str]]] = field(default_factory=dict)  # by step
    plays: list[PlayedStep] = field(default_factory=list)
    final_page: str = ""
    code: str | None = None
    errors: list[str] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)  # connections lost and the like, which it got over
    seconds: float = 0.0
