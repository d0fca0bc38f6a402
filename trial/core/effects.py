"""What the core of a trial (`trial/core/trial.py`) asks its shell to do. Pure records.

A connection is whatever the shell uses to name one; the core only compares it. Texts are messages of docs/wire.md.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from trial.core.progress import Action, Break, Episode
from trial.core.unfinished import UnfinishedEpisode
from trial.pictures.frames import Frame

# ---- to a client


@dataclass(frozen=True, slots=True)
class SendMessage:
    """Send a message."""

    connection: Hashable
    text: str


@dataclass(frozen=True, slots=True)
class SendState:
    """Send the trial's state. It replaces a state that has not been sent yet."""

    connection: Hashable
    text: str
    frame_rate: int


@dataclass(frozen=True, slots=True)
class SendFrame:
    """Send a frame. It replaces a frame that has not been sent yet."""

    connection: Hashable
    frame: Frame
    frame_id: int


@dataclass(frozen=True, slots=True)
class SendDone:
    """Say that the trial is over and stored, then close the connection (1000)."""

    connection: Hashable
    episodes: int
    score: float


@dataclass(frozen=True, slots=True)
class Close:
    """Send a last message, then close the connection with this code."""

    connection: Hashable
    code: int
    text: str


# ---- to the agent: one call at a time, answered with `call_returned` or `call_failed`


class AgentTimeout(Exception):
    """The researcher's code has not come back in time. It still runs, and its thread can run nothing else."""


@dataclass(slots=True, eq=False, kw_only=True)
class Call:
    """A call of the researcher's code. After `limit` seconds it has failed with AgentTimeout."""

    limit: float


@dataclass(slots=True, eq=False, kw_only=True)
class ResetCall(Call):
    """Reset the environment. Returns `(line of the recording, frame)`."""

    episode: int
    seed: int


@dataclass(slots=True, eq=False, kw_only=True)
class ReplayCall(Call):
    """Take again all steps that an earlier server recorded of an episode. Returns the frame after the last of them."""

    unfinished: UnfinishedEpisode
    default_action: int
    """What was taken where no key acted."""


@dataclass(slots=True, eq=False, kw_only=True)
class FeedbackCall(Call):
    """Give the agent these words of feedback. `heard` counts those it was given. Returns None."""

    feedback: tuple[str, ...]
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

    action: Action
    fields: Mapping[str, Any]
    """More for the step's line of the recording."""


@dataclass(frozen=True, slots=True)
class TellMoved:
    """Tell the agent's callbacks that a player's participant has come, gone or come back."""

    callback: Literal["on_join", "on_leave", "on_return"]
    player: str


@dataclass(frozen=True, slots=True)
class StepTaken:
    """What came of a step: Gymnasium's reward, terminated and truncated, the new frame, the line of the recording."""

    reward: float
    terminated: bool
    truncated: bool
    frame: Frame
    line: bytes


# ---- recordings and the answer


@dataclass(frozen=True, slots=True)
class OpenRecording:
    """Open a new recording; answered with `recording_opened` or `recording_failed`."""

    episode: int
    seed: int
    frame_rate: int
    action_space: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class WriteLine:
    """Add a finished line to the recording."""

    line: bytes


@dataclass(frozen=True, slots=True)
class RecordLine:
    """Add a line of this kind to the recording, stamped with the time."""

    kind: Literal["resume", "error", "end", "break"]
    fields: Mapping[str, Any]


@dataclass(frozen=True, slots=True)
class CloseRecording:
    """Close the recording and store it."""


@dataclass(frozen=True, slots=True)
class SaveAnswer:
    """Wait until all recordings are stored, then store the answer, if there is one; answered with `answer_saved`."""

    answers: Mapping[str, Any] | None


# ---- the log


@dataclass(frozen=True, slots=True)
class Log:
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
    | SendFrame
    | SendDone
    | Close
    | Call
    | TellMoved
    | OpenRecording
    | WriteLine
    | RecordLine
    | CloseRecording
    | SaveAnswer
    | Log
    | LogAgentError
)
