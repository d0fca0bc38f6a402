"""What the core of a trial (`trial/core/trial.py`) asks its shell to do. Pure records.

A connection is whatever the shell uses to name one; the core only compares it. A line is whatever it writes of a step
or a reset; the core passes it on. Texts are messages of docs/wire.md.
Records that are made at each step are named tuples, since frozen dataclasses take several times as long to make.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from trial.core.actions import Action
from trial.core.ended import Break, Episode
from trial.core.message_log import Word
from trial.core.players import Player, View
from trial.core.policies import AskPolicy, Observed
from trial.core.unfinished import UnfinishedEpisode
from trial.pictures.picture import Picture

Pictures = Picture | dict[str, Picture]
"""One picture for all, or one for each human."""

# ---- to a client


@dataclass(frozen=True, slots=True)
class SendMessage:
    """Send this text to a client."""

    connection: Hashable
    text: str


@dataclass(frozen=True, slots=True)
class SendState:
    """Send the trial's state. It replaces a state that has not been sent yet."""

    connection: Hashable
    text: str
    frame_rate: int


class SendPicture(NamedTuple):
    """Send a picture. It replaces a picture that has not been sent yet."""

    connection: Hashable
    picture: Picture
    frame_id: int


@dataclass(frozen=True, slots=True)
class SendDone:
    """Say that the trial is over and stored, then close the connection (1000)."""

    connection: Hashable
    episodes: int
    score: float
    outcome: str | None = None
    """In a session: how the trial has ended for this member."""


@dataclass(frozen=True, slots=True)
class Close:
    """Send a last message, then close the connection with this code."""

    connection: Hashable
    code: int
    text: str


# ---- to the agent: one call at a time, answered with `call_returned` or `call_failed`


class AgentTimeout(Exception):
    """The researcher's code has not returned in time. It still runs, so its thread can do nothing else."""


@dataclass(slots=True, eq=False, kw_only=True)
class Call:
    """A call of the researcher's code. It fails with AgentTimeout after `limit` seconds."""

    limit: float


@dataclass(slots=True, eq=False, kw_only=True)
class ResetCall(Call):
    """Reset the environment. Returns a `Begun`."""

    episode: int
    seed: int
    asked: frozenset[str] = frozenset()
    """Players whose policies begin the episode too."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """More for the line of the recording, if there are several players."""


@dataclass(slots=True, eq=False, kw_only=True)
class ReplayCall(Call):
    """Take again all steps that an earlier server recorded of an episode. Returns a `Replayed`."""

    unfinished: UnfinishedEpisode
    default_actions: Mapping[str, int]
    """What was taken where nothing was chosen, by player."""


@dataclass(slots=True, eq=False, kw_only=True)
class FeedbackCall(Call):
    """Give the agent these words of feedback. `heard`: how many words count as heard afterwards. Returns None."""

    feedback: tuple[Word, ...]
    messages: int
    """So many of the participant's messages came before this call."""
    heard: int = 0
    over: Episode | Break | None = None
    """What has ended, for the agent's callbacks."""
    last: bool = False
    """The trial is over too."""


@dataclass(slots=True, eq=False, kw_only=True)
class StepCall(FeedbackCall):
    """Give the agent the words of feedback, then take one step. Returns a `StepTaken`."""

    actions: Mapping[str, Action]
    """By player."""
    fields: Mapping[str, Any]
    """More for the step's line of the recording."""
    truncated_by: str | None = None
    """The key of `trial` that makes this step the episode's last one: it is recorded as truncated."""


@dataclass(frozen=True, slots=True)
class TellMoved:
    """Tell the agent's callbacks that a player's participant has come, left or returned."""

    callback: Literal["on_join", "on_leave", "on_return"]
    player: str


@dataclass(frozen=True, slots=True)
class Begun:
    """The result of a reset: the line of the recording, the first picture, and what the players see.

    `view` is None if all players act and may do everything.
    """

    line: Any
    pictures: Pictures
    view: View | None = None


class StepTaken(NamedTuple):
    """The result of a step: rewards by player, whether the episode is over, the picture, the line of the recording.

    `view` is as in `Begun`.
    """

    rewards: Mapping[str, float]
    terminated: bool
    truncated: bool
    pictures: Pictures
    line: Any
    view: View | None = None


@dataclass(frozen=True, slots=True)
class Replayed:
    """The result of a replay: the present picture, and what the players see.

    `observed` is what each policy acted upon in the steps that were taken again, in their order.
    """

    pictures: Pictures
    view: View | None = None
    observed: Mapping[str, Sequence[Observed]] = field(default_factory=dict)


# ---- to the policies of players that are no humans


@dataclass(frozen=True, slots=True)
class ResetPolicy:
    """Begin an episode for the player's policy. It observes again what it acted upon, and its actions are dropped."""

    player: str
    seed: int
    observed: Sequence[Observed] = ()


# ---- recordings and the answer


@dataclass(frozen=True, slots=True)
class OpenRecording:
    """Open a new recording; answered with `recording_opened` or `recording_failed`."""

    episode: int
    seed: int
    frame_rate: int
    action_space: tuple[str, ...]
    players: tuple[Player, ...] = ()
    """Who plays whom, if there are several players."""


class WriteLine(NamedTuple):
    """Add a finished line to the recording."""

    line: Any


@dataclass(frozen=True, slots=True)
class RecordLine:
    """Add a line of this kind to the recording, stamped with the time."""

    kind: Literal["resume", "error", "end", "break", "presence", "ping"]
    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class CloseRecording:
    """Close the recording and store it."""


@dataclass(frozen=True, slots=True)
class SaveAnswer:
    """Wait until all recordings are stored, then store the answers, if there are some.

    Answered with `member_saved` for each member's, and with `answer_saved` when all are stored, also those of earlier
    `SaveMember`.
    """

    answers: Mapping[str, Any] | None
    """The participant's; None in a session."""
    by_human: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """In a session: the answers of each member, by their id."""


@dataclass(frozen=True, slots=True)
class SaveMember:
    """Store a member's answer; answered with `member_saved`. For a member who is out while the others play."""

    human: str
    answers: Mapping[str, Any]
    later: Mapping[str, Any] | None = None
    """The answer of each later game step, in which they do not play either; None: they do."""


# ---- the log


@dataclass(frozen=True, slots=True)
class WriteLog:
    """Write a line into the log, at a level of `logging`."""

    level: int
    text: str


@dataclass(frozen=True, slots=True)
class LogAgentError:
    """Write an error of the researcher's code into the log, with its traceback unless that was logged already."""

    error: Exception


Effect = (
    SendMessage
    | SendState
    | SendPicture
    | SendDone
    | Close
    | Call
    | TellMoved
    | AskPolicy
    | ResetPolicy
    | OpenRecording
    | WriteLine
    | RecordLine
    | CloseRecording
    | SaveAnswer
    | SaveMember
    | WriteLog
    | LogAgentError
)
