"""A participant's records, and the rule for the step that is due. Pure.

An answer is a document of its own, created once and never changed. The first step without an answer is due. So one
conditional write both stores an answer and moves the participant on. A second submission of the same page changes
nothing, two tabs cannot lose each other's answers, and no record grows.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from typing import Any

import msgspec

from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.model.records import Record
from hippodrome.control.ports import Entry
from hippodrome.protocol.answer import FAILED, Answer
from hippodrome.protocol.keys import answer_key, participant_folder
from hippodrome.protocol.session import ASSIGNMENT

REPEAT_WINDOW = timedelta(seconds=60)  # a form that names no step is ignored if it repeats an answer younger than this
MAX_HEADER = 512  # characters of a header's value
PARTICIPANT, END = "participant.json", "end.json"
MAX_COMPARED = 10  # the most answers with which such a form is compared; each costs a read


class Participant(Record, frozen=True):
    """`participant.json`: written at the first visit, never changed."""

    project_id: str
    user_id: str
    arrived: datetime
    group: int | None = None
    completion_code: str = ""
    link: Mapping[str, str] = msgspec.field(default_factory=dict)  # the other fields of the recruiter's link
    headers: Mapping[str, str] = msgspec.field(default_factory=dict)  # those of the first request that the study keeps


class Ended(Record, frozen=True):
    """`end.json`: the end that a participant has reached before the last step. Written once.

    `code` is the completion code that they were shown.
    """

    end: str
    ended: datetime
    code: str = ""
    link: str = ""


@dataclass(frozen=True)
class Progress:
    """A participant's progress: when they arrived, when each step was answered, and which other records exist.

    `tries` has the number of the last try of each check. `assigned` is when their assignment was written.
    """

    has_arrived: bool = False
    answered: Mapping[str, datetime] = field(default_factory=dict)
    arrived: datetime | None = None
    tries: Mapping[str, int] = field(default_factory=dict)
    assigned: datetime | None = None
    has_ended: bool = False

    @classmethod
    def from_listing(cls, folder: str, entries: Iterable[Entry]) -> Progress:
        """Read a listing of `folder` in the order of keys. Answers come before participant.json, recordings after."""
        answered: dict[str, datetime] = {}
        tries: dict[str, int] = {}
        arrived, assigned, has_ended = None, None, False
        for entry in entries:
            name = entry.key.removeprefix(folder)
            if name > PARTICIPANT:
                break
            if name == PARTICIPANT:
                arrived = entry.modified
            elif name == ASSIGNMENT:
                assigned = entry.modified
            elif name == END:
                has_ended = True
            elif name.startswith("answers/") and name.endswith(".json"):
                step, _, number = name.removeprefix("answers/").removesuffix(".json").partition(".")
                if not number:
                    answered[step] = entry.modified
                elif number.isdecimal():
                    tries[step] = max(tries.get(step, 0), int(number))
        return cls(arrived is not None, answered, arrived, tries, assigned, has_ended)

    def due_step(self, project: Project) -> Step:
        """Return the step that is due: the first without an answer, or the final one."""
        return next((step for step in project.steps[:-1] if step.key not in self.answered), project.final)

    def answered_games(self, project: Project) -> list[str]:
        """Return the keys of the game steps that are answered, in order."""
        return [key for key in project.game_steps if key in self.answered]

    def recently_answered(self, project: Project, now: datetime) -> list[str]:
        """Return the keys of the pages answered within the last `REPEAT_WINDOW`: the latest first, at most
        `MAX_COMPARED`.
        """
        keys = [step.key for step in project.steps if not step.type.on_server and step.key in self.answered]
        recent = [key for key in keys if now - self.answered[key] < REPEAT_WINDOW]
        return sorted(recent, key=self.answered.__getitem__, reverse=True)[:MAX_COMPARED]

    def reached_at(self, project: Project, step: Step) -> datetime | None:
        """Return when the participant reached `step`, that is, answered the step before it; None for the first step."""
        at = project.index(step.key)
        return self.answered.get(project.steps[at - 1].key) if at else None

    def waited(self, project: Project, step: Step, now: datetime) -> timedelta:
        """Return for how long the participant has been at `step`; at the first step since their arrival."""
        reached = self.reached_at(project, step) or self.arrived
        return max(now - reached, timedelta()) if reached else timedelta()


def participant_key(project_id: str, user_id: str) -> str:
    """Return the key of a participant's record."""
    return f"{participant_folder(project_id, user_id)}participant.json"


def end_key(project_id: str, user_id: str) -> str:
    """Return the key of the record of the end that a participant has reached."""
    return f"{participant_folder(project_id, user_id)}{END}"


def try_key(project_id: str, user_id: str, step: str, number: int) -> str:
    """Return the key of a try at a check: a document like an answer."""
    return answer_key(project_id, user_id, f"{step}.{number}")


def new_participant(
    project: Project, user_id: str, link: Mapping[str, str], now: datetime, headers: Mapping[str, str] | None = None
) -> Participant:
    """Return the record of a participant who opens the link for the first time.

    Of the request's `headers`, by their names in lower case, it has those that the study keeps, and of each
    `MAX_HEADER` characters.
    """
    sent = {name: headers[name] for name in project.record_headers if name in headers} if headers else {}
    return Participant(
        project_id=project.id,
        user_id=user_id,
        arrived=now,
        group=project.group(user_id),
        completion_code=ids.completion_code(project.secret, user_id),
        link=link,
        headers={name: text.encode("utf-8", "replace").decode()[:MAX_HEADER] for name, text in sent.items()},
    )


def device(user_agent: str) -> str:
    """Return the kind of device that a browser names itself after: desktop, tablet or phone; "" if it names none."""
    text = user_agent.lower()
    if "ipad" in text or "tablet" in text or ("android" in text and "mobile" not in text):
        return "tablet"
    if "mobi" in text or "iphone" in text:
        return "phone"
    return "desktop" if text else ""


def new_answer(project: Project, user_id: str, step: Step, answers: Mapping[str, Any], now: datetime) -> Answer:
    """Return the record of the answers to `step`."""
    return Answer(
        step=step.key,
        page=project.file(user_id, step),
        group=project.group(user_id, step),
        answered=now,
        answers=answers,
    )


def failed_game(project: Project, user_id: str) -> dict[str, Any]:
    """Return the answers of a game that no server could run: those of a trial that failed, before a step was played.

    `completionCode` is a code of its own, so that the researchers see what it stands for.
    """
    code = ids.completion_code(project.secret, user_id, FAILED)
    return {"episodes": 0, "score": 0, "frames": 0, "seconds": 0, "outcome": FAILED, "completionCode": code}


def same_answers(answers: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two forms hold the same answers, in whatever order their fields are."""
    return msgspec.json.encode(answers, order="sorted") == msgspec.json.encode(other, order="sorted")


def starts_server(project: Project, step: Step) -> bool:
    """Return whether the participant's server is started when this step is reached."""
    return step.key == project.events.start_server_step


def stops_server(project: Project, step: Step) -> bool:
    """Return whether the participant's server is stopped when this step is reached."""
    return step.key == project.events.stop_server_step


def may_have_server(project: Project, step: Step) -> bool:
    """Return whether the participant may have a server at this step.

    They may from the step at which servers start on, and before the step at which they stop.
    """
    at, first = project.index(step.key), project.index(project.events.start_server_step)
    return at is not None and first is not None and first <= at and not is_past_server(project, step)


def is_past_server(project: Project, step: Step) -> bool:
    """Return whether the participant needs no server any more at this step: it is the stop step or a later one."""
    at, last = project.index(step.key), project.index(project.events.stop_server_step)
    return at is not None and last is not None and at >= last
