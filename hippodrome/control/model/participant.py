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
from hippodrome.control.model.project import Project, Step
from hippodrome.control.model.records import Record
from hippodrome.control.ports import Entry
from hippodrome.protocol.answer import FAILED, Answer
from hippodrome.protocol.keys import participant_folder

REPEAT_WINDOW = timedelta(seconds=60)  # a form that names no step is ignored if it repeats an answer younger than this
MAX_HEADER = 512  # characters of a header's value
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


@dataclass(frozen=True)
class Progress:
    """A participant's progress: whether `participant.json` exists, and when each step was answered."""

    has_arrived: bool = False
    answered: Mapping[str, datetime] = field(default_factory=dict)

    @classmethod
    def from_listing(cls, folder: str, entries: Iterable[Entry]) -> Progress:
        """Read a listing of `folder` in the order of keys. Answers come before participant.json, recordings after."""
        has_arrived, answered = False, {}
        for entry in entries:
            name = entry.key.removeprefix(folder)
            if name > "participant.json":
                break
            if name == "participant.json":
                has_arrived = True
            elif name.startswith("answers/") and name.endswith(".json"):
                answered[name.removeprefix("answers/").removesuffix(".json")] = entry.modified
        return cls(has_arrived, answered)

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


def participant_key(project_id: str, user_id: str) -> str:
    """Return the key of a participant's record."""
    return f"{participant_folder(project_id, user_id)}participant.json"


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


def same_answers(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two forms hold the same answers, in whatever order their fields are."""
    return msgspec.json.encode(one, order="sorted") == msgspec.json.encode(other, order="sorted")


def following_step(project: Project, step: Step) -> Step | None:
    """Return the next step; None after the last."""
    at = project.index(step.key)
    return project.steps[at + 1] if at is not None and at + 1 < len(project.steps) else None


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


def reached_without_post(project: Project, step: Step) -> bool:
    """Return whether this step follows a game step.

    The trial stores the answer to a game step, so no POST has published the messages of the step after it.
    """
    at = project.index(step.key)
    return project.steps[at - 1].type.on_server if at else False
