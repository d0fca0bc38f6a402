"""What a bot reports: what it has sent and received, and what went wrong."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class PlayedStep:
    """One game step of the study, as a bot has played it."""

    step: str
    addresses: list[str] = field(default_factory=list)
    waited: float = 0.0  # seconds on the waiting page
    lobby: float | None = None  # seconds in the lobby, until the bot was matched or unmatched; None: no lobby
    members: int = 1  # participants who play together, with this bot
    unmatched: bool = False  # the lobby found no other participants, so the bot did not play
    outcome: str = ""  # `outcome` of the server's last message in a game of several participants, or "unmatched"
    frames: int = 0  # frames received, without the first of each connection
    frame_rate: int = 0  # the frame rate that the server announced
    seconds: float = 0.0  # seconds of playing: the times between two frames, added up
    timed_frames: int = 0  # received in `seconds`
    bytes: int = 0  # the bytes of frames, scenes and images
    lines: int = 0  # lines that the bot has said and read
    score: float = 0
    episodes: int = 0
    done: bool = False
    stopped: bool = False  # the bot stopped the game after as many seconds as it plays

    @property
    def received_rate(self) -> float | None:
        """Frames per second while playing; None if the bot played for less than a second."""
        return self.timed_frames / self.seconds if self.seconds >= 1 else None


@dataclass
class BotReport:
    """What one bot has sent and received, and what went wrong."""

    user_id: str
    stage: str = "waits for its turn"  # what the bot is doing now
    finished: bool = False  # the bot came to the study's last page
    ended: str = ""  # the step on whose page the bot ended, since no button there can be pressed
    end: str = ""  # the end before the last step that the bot reached
    answers: dict[str, dict[str, str | list[str]]] = field(default_factory=dict)  # by step: the fields that it has sent
    plays: list[PlayedStep] = field(default_factory=list)
    final_page: str = ""  # the HTML of the last page
    code: str | None = None  # the completion code on the last page
    errors: list[str] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)  # troubles such as lost connections, after which the bot went on
    seconds: float = 0.0  # from the bot's start to its end
