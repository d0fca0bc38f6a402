"""The effects: what the core of a trial (`trial/core/trial.py`) asks its shell (`trial/server/loop.py`) to do.

`connection` is any object with which the shell identifies a connection; the core only compares it. `line` is the line
of the recording that the shell has made of a step or a reset; the core only hands it back. `text` is a message of
docs/wire.md. All are pure records. Effects of every step are named tuples: a frozen dataclass takes several times as
long to make.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

from hippodrome.trial.core.history import Break, Episode, UnfinishedEpisode, Word
from hippodrome.trial.core.players import Action, Player, View
from hippodrome.trial.core.policies import AskPolicy, Observed
from hippodrome.trial.pictures.reader import Picture

Pictures = Picture | dict[str, Picture]
"""One picture for all humans, or one for each player that a human plays, by player."""

# ---- to a client


@dataclass(frozen=True, slots=True)
class SendMessage:
    """Send this text to a client."""

    connection: Hashable
    text: str


@dataclass(frozen=True, slots=True)
class SendState:
    """Send the trial's state; it replaces a state that still waits to be sent.

    `frame_rate` is the game's frame rate from now on.
    """

    connection: Hashable
    text: str
    frame_rate: int


@dataclass(frozen=True, slots=True)
class SendTalk:
    """Send lines, or who types: the fields of a message about talk. None of them may be lost."""

    connection: Hashable
    fields: Mapping[str, Any]


class SendPicture(NamedTuple):
    """Send a picture; it replaces a picture that still waits to be sent."""

    connection: Hashable
    picture: Picture
    frame_id: int


@dataclass(frozen=True, slots=True)
class SendDone:
    """Tell a client that the trial is over and stored, then close the connection with code 1000."""

    connection: Hashable
    episodes: int
    score: float
    outcome: str | None = None
    """In a session: how the trial has ended for this member."""
    words: str | None = None
    """A sentence that the participant must be able to read at the end; None if there is nothing to say."""


@dataclass(frozen=True, slots=True)
class Close:
    """Send a last message, then close the connection with this code."""

    connection: Hashable
    code: int
    text: str


# ---- to the agent: one call at a time, answered with `call_returned` or `call_failed`


class AgentTimeout(Exception):
    """The researcher's code has not returned in time. It still runs, and its thread can do nothing else meanwhile."""


@dataclass(slots=True, eq=False, kw_only=True)
class Call:
    """Call the researcher's code. The call fails with AgentTimeout after `limit` seconds."""

    limit: float


@dataclass(slots=True, eq=False, kw_only=True)
class ResetCall(Call):
    """Reset the environment. The call returns a `Begun`."""

    episode: int
    seed: int
    asked: frozenset[str] = frozenset()
    """The players that policies play, except programs: these policies begin the episode, too."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Further fields of the reset's line in the recording, in a session."""


@dataclass(slots=True, eq=False, kw_only=True)
class ReplayCall(Call):
    """Take again all steps that an earlier server has recorded of an episode. The call returns a `Replayed`."""

    unfinished: UnfinishedEpisode
    default_actions: Mapping[str, int]
    """By player, the action for steps in which none was recorded for it."""


@dataclass(slots=True, eq=False, kw_only=True)
class FeedbackCall(Call):
    """Give the agent these words of feedback. The call returns None."""

    feedback: tuple[Word, ...]
    messages: int
    """The number of messages in the message log when the call was made. The line of this call records them."""
    heard: int = 0
    """The number of words that the agent has heard so far. Its thread counts them, also if the call fails."""
    over: Episode | Break | None = None
    """The episode or the break that has ended, for the agent's callbacks; None in a `StepCall`."""
    last: bool = False
    """Whether the trial ends with this episode or break."""


@dataclass(slots=True, eq=False, kw_only=True)
class StepCall(FeedbackCall):
    """Give the agent the words of feedback, then take one step. The call returns a `StepTaken`."""

    actions: Mapping[str, Action]
    """By player, the action of this step."""
    fields: Mapping[str, Any]
    """Further fields of the step's line in the recording."""
    truncated_by: str | None = None
    """The key of `trial` whose limit makes this step the episode's last; the line records it as truncated."""


@dataclass(frozen=True, slots=True)
class TellAgent:
    """Tell the agent's callbacks that a player's participant has come, left, returned, or filled in a form."""

    callback: Literal["on_join", "on_leave", "on_return", "on_form"]
    player: str
    fields: Mapping[str, Any] | None = None  # of the form


@dataclass(frozen=True, slots=True)
class AskReply:
    """Ask the agent's `reply`, after earlier lines. The shell answers with `Trial.reply_grows` and `reply_ended`.

    `n` is the number of the line; None if the agent is to speak first.
    """

    ask_id: int
    player: str
    text: str
    n: int | None


@dataclass(frozen=True, slots=True)
class Moderate:
    """Ask the agent's `moderate` about a line that is not said yet. The shell answers with `Trial.moderated`."""

    ask_id: int
    player: str
    text: str


@dataclass(frozen=True, slots=True)
class RecordTalk:
    """Add this record to the tape of the talk, stamped with the time."""

    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class Begun:
    """The result of a `ResetCall`: the line of the recording, the first picture, and what the players see.

    `view` is None if all players are to act and all actions are legal.
    """

    line: Any
    pictures: Pictures
    view: View | None = None


class StepTaken(NamedTuple):
    """The result of a `StepCall`: rewards by player, whether the episode is over, the picture, the recording's line.

    `view` is as in `Begun`.
    """

    rewards: Mapping[str, float]
    terminated: bool
    truncated: bool
    pictures: Pictures
    line: Any
    view: View | None = None
    success: bool = False
    """Whether the info of the step, of the first human, has a true `success`."""


@dataclass(frozen=True, slots=True)
class Replayed:
    """The result of a `ReplayCall`: the present picture, and what the players see (`view` as in `Begun`).

    `observed`: by player, what its policy was asked for the actions of these steps and what it chose, in order.
    """

    pictures: Pictures
    view: View | None = None
    observed: Mapping[str, Sequence[Observed]] = field(default_factory=dict)


# ---- to the policies


@dataclass(frozen=True, slots=True)
class ResetPolicy:
    """Begin an episode for the player's policy. `observed` is what it has chosen in the episode on an earlier server.

    The policy reaches the state that it had there (`Policy.resume`).
    """

    player: str
    seed: int
    observed: Sequence[Observed] = ()


# ---- recordings and the answer


@dataclass(frozen=True, slots=True)
class OpenRecording:
    """Open a new recording. The shell answers with `Trial.recording_opened` or `recording_failed`."""

    episode: int
    seed: int
    frame_rate: int
    action_space: tuple[str, ...]
    players: tuple[Player, ...] = ()
    """All players of the environment if it has several; else empty."""


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
    """Wait until all recordings are stored, then store the answers, if there are any.

    The shell answers with `Trial.member_saved` for each member's answer, and with `answer_saved` once all answers are
    stored, including the answers of earlier `SaveMember`.
    """

    answers: Mapping[str, Any] | None
    """The participant's answer; None in a session, or if there is none."""
    by_human: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """In a session: the answer of each member, by their id."""


@dataclass(frozen=True, slots=True)
class SaveMember:
    """Store the answer of a member who is refused while the others play on. The shell answers with `member_saved`."""

    human: str
    answers: Mapping[str, Any]
    later: Mapping[str, Any] | None = None
    """The answer of each later game step, if the member does not play the later steps either; else None."""


# ---- the log


@dataclass(frozen=True, slots=True)
class WriteLog:
    """Write a line to the log. `level` is one of the module `logging`."""

    level: int
    text: str


@dataclass(frozen=True, slots=True)
class LogAgentError:
    """Write an error of the researcher's code to the log, with its traceback unless that was logged before."""

    error: Exception


Effect = (
    SendMessage
    | SendState
    | SendTalk
    | SendPicture
    | SendDone
    | Close
    | Call
    | TellAgent
    | AskReply
    | Moderate
    | RecordTalk
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
