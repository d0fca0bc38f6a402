"""Finds out from ECS's words why a server failed, and explains it to researchers and administrators. Pure.

Wordings (ECS Developer Guide, "Stopped task error messages" and "API failure reasons", API Reference, `Task`, and
events of real tasks; read November 2026). `stopCode` is one of TaskFailedToStart, EssentialContainerExited,
UserInitiated, ServiceSchedulerInitiated, SpotInterruption, TerminationNotice and InfrastructureHealth; if an event
lacks it, `messages.parse_task_changed` derives it from the words. If the container never ran, `stoppedReason` begins
with the name of an error, such as CannotPullContainerError. If it ran, `stoppedReason` only says that it exited, and
the container's own `reason` may say more (OutOfMemoryError). Only AWS's words are examined, and none of them is stored:
they may quote ids.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import NamedTuple

from hippodrome.control.model.server import TaskStopped
from hippodrome.control.ports import NoCapacity, Refused
from hippodrome.protocol import exits

_KILLED = 137  # the exit code of a container that SIGKILL has ended


class FailureCategory(StrEnum):
    """A group of causes, counted by one metric and watched by one alarm."""

    IMAGE = "image"
    INITIALISATION = "initialisation"
    PROGRAM = "program"
    MEMORY = "memory"
    REFUSED = "refused"
    AWS = "aws"  # something on AWS's side, worth attention only if it happens often


class Cause(StrEnum):
    """The cause of a server's failure, as it is written in the server's record."""

    IMAGE = "image"
    INITIALISATION = "initialisation"
    CANNOT_BEGIN = "cannot begin"
    ENDED_AT_ONCE = "ended at once"
    NEVER_READY = "never ready"
    NO_PORT = "no port"
    NO_CERTIFICATE = "no certificate"
    CRASHED = "crashed"
    OUT_OF_MEMORY = "out of memory"
    KILLED = "killed"
    DEFINITION = "no task definition"
    PERMISSION = "no permission"
    SIZE = "impossible size"
    QUOTA = "quota"
    REFUSED = "refused"
    CAPACITY = "no capacity"
    SPOT = "spot"
    MACHINE = "machine"
    VANISHED = "vanished"
    UNKNOWN = "unknown"

    @property
    def category(self) -> FailureCategory:
        return _EXPLANATIONS[self].category

    @property
    def sentence(self) -> str:
        """What happened, and what to do about it."""
        return f"{_EXPLANATIONS[self].event} {_EXPLANATIONS[self].remedy}"


class _Explanation(NamedTuple):
    category: FailureCategory
    event: str
    remedy: str


_LOGS = "The last lines of its log are in `hippodrome logs --all --function trial`."
_EXPLANATIONS = {
    Cause.IMAGE: _Explanation(
        FailureCategory.IMAGE,
        "The image cannot be pulled: it is gone, was never pushed, or its registry cannot be reached.",
        "Register the project again, which builds and pushes it; `hippodrome doctor --all` says whether it exists.",
    ),
    Cause.INITIALISATION: _Explanation(
        FailureCategory.INITIALISATION,
        "ECS could not prepare the container: its log group, its secrets, or the login to the image's registry.",
        "`hippodrome deploy --plan` shows what is missing and `deploy` puts it back; `hippodrome doctor --all` says "
        "whether a study's LLM_KEY is missing. With a network of your own, see whether its subnets reach the Internet.",
    ),
    Cause.CANNOT_BEGIN: _Explanation(
        FailureCategory.PROGRAM,
        "The image cannot be run: it is for another kind of processor, or lacks the program that it should run.",
        "Build it as the project's `image` says and register the project again.",
    ),
    Cause.ENDED_AT_ONCE: _Explanation(
        FailureCategory.PROGRAM,
        "The program ended with an error before a participant could play: mostly the agent or the environment fails.",
        f"{_LOGS} `hippodrome run` shows the same on your machine.",
    ),
    Cause.NEVER_READY: _Explanation(
        FailureCategory.PROGRAM,
        "The program ran but was never ready: the agent was not loaded within five minutes.",
        f"{_LOGS} Put what it downloads into the image, or choose a larger size in config.yml.",
    ),
    Cause.NO_PORT: _Explanation(
        FailureCategory.REFUSED,
        "The server is not allowed to listen on its port.",
        "Register the project again, which makes a task definition that allows it; if it stays, "
        "`hippodrome deploy --port 5000` in the project's folder, which registers it, too.",
    ),
    Cause.NO_CERTIFICATE: _Explanation(
        FailureCategory.REFUSED,
        "The server got no certificate for its address from Let's Encrypt, in three tries.",
        "`hippodrome doctor --all` says how many orders are left; letsencrypt.status.io says whether it works. "
        "With a domain (`hippodrome deploy --no-study --domain …`) servers need no certificates of their own.",
    ),
    Cause.CRASHED: _Explanation(
        FailureCategory.PROGRAM,
        "The program ended with an error, perhaps while a participant was playing.",
        f"{_LOGS} `hippodrome run` may show the same on your machine.",
    ),
    Cause.OUT_OF_MEMORY: _Explanation(
        FailureCategory.MEMORY,
        "The program needed more memory than its server has.",
        "Choose more memory in config.yml and register the project again.",
    ),
    Cause.KILLED: _Explanation(
        FailureCategory.PROGRAM,
        "The process was killed, on one machine: by hand, or by the system because the memory was full.",
        "If it was not by hand, close other programs, and run the study again.",
    ),
    Cause.DEFINITION: _Explanation(
        FailureCategory.REFUSED,
        "The project's task definition is gone.",
        "Register the project again, which makes one.",
    ),
    Cause.PERMISSION: _Explanation(
        FailureCategory.REFUSED,
        "AWS does not allow the installation to run servers.",
        "`hippodrome deploy --plan` shows which role has changed and `deploy` puts it back. AWS blocks Fargate in some "
        "new accounts: start the smallest EC2 instance, end it, and try again after some hours, or ask its Support "
        "Center.",
    ),
    Cause.SIZE: _Explanation(
        FailureCategory.REFUSED,
        "Fargate has no servers with this number of CPUs and this much memory.",
        "Choose a size in config.yml that `hippodrome register` accepts, and register the project again.",
    ),
    Cause.QUOTA: _Explanation(
        FailureCategory.REFUSED,
        "A limit of the AWS account is reached: of CPUs or memory, or of addresses in the subnets.",
        "`hippodrome doctor --all` says how much there is and how to ask AWS for more.",
    ),
    Cause.REFUSED: _Explanation(
        FailureCategory.REFUSED,
        "AWS refuses to run the server as it is configured.",
        "`hippodrome doctor STUDY` checks the project's task definition and image; register it again.",
    ),
    Cause.CAPACITY: _Explanation(
        FailureCategory.AWS,
        "Fargate had no room, neither on Spot nor on demand.",
        "This usually passes; with subnets in more zones there is room more often.",
    ),
    Cause.SPOT: _Explanation(
        FailureCategory.AWS,
        "AWS took the server back, as it may with Spot; the participant got another one.",
        "Nothing needs to be done.",
    ),
    Cause.MACHINE: _Explanation(
        FailureCategory.AWS,
        "AWS could not start the server, or its machine failed.",
        "This usually passes; if not, the AWS Health Dashboard may know more.",
    ),
    Cause.VANISHED: _Explanation(
        FailureCategory.AWS,
        "The server had ended, no event of ECS was handled, and a sweep noticed it.",
        "`hippodrome logs --all --function task_changed --errors` shows whether an event came and could not be "
        "handled.",
    ),
    Cause.UNKNOWN: _Explanation(
        FailureCategory.AWS,
        "AWS ended the server for a reason that Hippodrome does not know.",
        "For an hour the console of ECS shows it, among the cluster's stopped tasks.",
    ),
}

_TASK_PATTERNS = (  # the first match counts
    (Cause.KILLED, re.compile(r"process was killed")),  # written by hippodrome/local/backend/task_record.py, not by AWS
    (Cause.OUT_OF_MEMORY, re.compile(r"OutOfMemory", re.IGNORECASE)),
    (Cause.IMAGE, re.compile(r"CannotPull|pull image manifest", re.IGNORECASE)),
    (Cause.CANNOT_BEGIN, re.compile(r"exec:|exec format|executable file|exec user process", re.IGNORECASE)),
    (Cause.INITIALISATION, re.compile(r"ResourceInitialization|CannotCreateVolume|logg(er|ing)", re.IGNORECASE)),
    (Cause.QUOTA, re.compile(r"(reached the|above your) limit|InsufficientFreeAddresses|LimitExceeded", re.IGNORECASE)),
    (Cause.CAPACITY, re.compile(r"capacity is unavailable|insufficient capacity|RESOURCE:", re.IGNORECASE)),
    (Cause.CANNOT_BEGIN, re.compile(r"CannotStartContainer|CannotCreateContainer", re.IGNORECASE)),
)
_BY_EXIT_CODE = {
    _KILLED: Cause.OUT_OF_MEMORY,  # Fargate does not always name OutOfMemoryError
    exits.LATE_AGENT: Cause.NEVER_READY,
    exits.NO_PORT: Cause.NO_PORT,
    exits.NO_CERTIFICATE: Cause.NO_CERTIFICATE,
}
_REFUSAL_PATTERNS = (
    (Cause.QUOTA, re.compile(r"reached the limit|quota", re.IGNORECASE)),
    (Cause.PERMISSION, re.compile(r"AccessDenied|not authorized|PassRole|Blocked", re.IGNORECASE)),
    (Cause.DEFINITION, re.compile(r"task ?definition", re.IGNORECASE)),
    (Cause.SIZE, re.compile(r"Fargate configuration|\b(cpu|memory)\b", re.IGNORECASE)),
)


def cause_of_task(stopped: TaskStopped, *, was_ready: bool) -> Cause:
    """Return the cause for which a task failed. `was_ready`: whether its server was ready for its participant."""
    if stopped.code in ("SpotInterruption", "TerminationNotice"):
        return Cause.SPOT
    if matched := _first_match(_TASK_PATTERNS, stopped.words):
        return matched
    if stopped.code in ("TaskFailedToStart", "InfrastructureHealth", "ServiceSchedulerInitiated"):
        return Cause.MACHINE
    if stopped.exit_code is None:
        return Cause.UNKNOWN
    if cause := _BY_EXIT_CODE.get(stopped.exit_code):
        return cause
    return Cause.CRASHED if was_ready and stopped.exit_code != exits.NO_AGENT else Cause.ENDED_AT_ONCE


def cause_of_refusal(error: NoCapacity | Refused) -> Cause:
    """Return the cause for which RunTask ran no task."""
    if isinstance(error, NoCapacity):
        return Cause.QUOTA if _first_match(_TASK_PATTERNS, str(error)) is Cause.QUOTA else Cause.CAPACITY
    return _first_match(_REFUSAL_PATTERNS, str(error)) or Cause.REFUSED


def parse_cause(written: str) -> Cause | None:
    """Return the cause that a server's record names.

    The result is None if the record names no cause, or a cause that this version does not know.
    """
    return Cause(written) if written in set(Cause) else None


def _first_match(table: tuple[tuple[Cause, re.Pattern[str]], ...], words: str) -> Cause | None:
    return next((cause for cause, pattern in table if pattern.search(words)), None)
