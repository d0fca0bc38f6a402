"""The example study on moto, and a participant with a browser: the test says when messages are delivered.

On `testing/clocked_moto.py` time passes and faults are injected; here the test goes step by step.
"""

from __future__ import annotations

import base64
import html
import json
import random
import re
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

from hippodrome.config import read_project
from hippodrome.model import ids, server
from lambdas import installed, next_step, start_server, stop_server, task_changed, update_project_master_list
from protocol.keys import membership_key
from testing import aws_events
from testing.moto_world import MotoWorld
from testing.visitors import body_of, hidden

ROOT = Path(__file__).resolve().parents[1]
PROJECT = "ms-pacman"
FUNCTIONS = {"start": start_server, "stop": stop_server, "task": task_changed}
GAME, AFTER = "3", "4"


class StudyOnMoto:
    """An account with the example study, and what AWS does between the functions: queues, ECS's events, delays.

    With `disorder`, every message comes twice, late and in any order, and names take their time to get known.
    """

    def __init__(self, world: MotoWorld, disorder: random.Random | None = None, **changes: Any) -> None:
        self.world, self.disorder = world, disorder
        self.waiting: list[tuple[str, str]] = []  # queue and body
        self.begun: set[str] = set()
        self.ended: set[str] = set()
        installed.use(world.platform)
        registration = {**read_project(ROOT).registration(), **changes}
        for file in (ROOT / "steps").iterdir():
            self.put(f"{PROJECT}/steps/{file.name}", file.read_bytes())
        answer = update_project_master_list.handler({"project": registration}, None)
        assert answer.get("registered") == PROJECT, answer

    # S3 as others see it

    def put(self, key: str, body: bytes) -> None:
        self.world.client("s3").put_object(Bucket=self.world.env["BUCKET"], Key=key, Body=body)

    def stored(self, key: str) -> Any:
        s3 = self.world.client("s3")
        try:
            return json.loads(s3.get_object(Bucket=self.world.env["BUCKET"], Key=key)["Body"].read())
        except s3.exceptions.NoSuchKey:
            return None

    def record(self, user: str) -> Any:
        return self.stored(server.key(ids.server_label(PROJECT, user)))

    # What AWS does

    def happen(self, *events: dict[str, Any]) -> None:
        """ECS events on their way to `task_changed`."""
        self._send("task", *[json.dumps(event) for event in events])

    def deliver(self, queue: str | None = None) -> None:
        """Hand on what waits, and what follows from it, until all is quiet. With `queue`, only what waits there."""
        for _ in range(1000):
            if self.disorder:
                self.world.in_sync = True
            self._collect()
            here = [(q, body) for q, body in self.waiting if queue in (None, q)]
            if not here:
                return
            self._hand_over(here)
            if queue:
                return
        raise AssertionError(f"no quiet: {len(self.waiting)} messages, such as {self.waiting[0]}")

    def deliver_some(self) -> None:
        self._collect()
        if self.disorder:
            # Each look at a change that is not in sync is followed by another, and here by two: more than half of them
            # must find it in sync, or there would be ever more.
            self.world.in_sync = self.disorder.random() < 0.7
        if self.waiting:
            self._hand_over(self.waiting)

    def _send(self, queue: str, *bodies: str) -> None:
        self.waiting += [(queue, body) for body in bodies for _ in range(2 if self.disorder else 1)]

    def _collect(self) -> None:
        self.world.skip_delays()
        for queue in FUNCTIONS:
            self._send(queue, *[record["body"] for record in self.world.receive(queue)["Records"]])
        for arn in self.world.task_arns():
            task = self.world.task(arn)
            if arn not in self.begun and task.desired_status == "RUNNING":
                self.begun.add(arn)
                self.happen(*[self.world.task_event(arn, status) for status in ("PROVISIONING", "PENDING", "RUNNING")])
            if arn not in self.ended and task.desired_status == "STOPPED":
                self.ended.add(arn)
                reason = task.stopped_reason
                self.happen(self.world.task_event(arn, "STOPPED", stop_code="UserInitiated", reason=reason))

    def _hand_over(self, messages: list[tuple[str, str]]) -> None:
        if self.disorder:
            self.disorder.shuffle(messages)
        queue = messages[0][0]
        batch = [message for message in messages if message[0] == queue][
            : self.disorder.randint(1, 4) if self.disorder else 10
        ]
        event = self.world.sqs_event(queue, [body for _, body in batch])
        for message in batch:
            self.waiting.remove(message)
        failed = FUNCTIONS[queue].handler(event, None)["batchItemFailures"]
        again = {failure["itemIdentifier"] for failure in failed}
        assert self.disorder or not again, "something failed in good order"
        self.waiting += [m for m, r in zip(batch, event["Records"], strict=True) if r["messageId"] in again]

    def lose(self, task: str, stop_code: str = "SpotInterruption", exit_code: int | None = 143) -> None:
        """The task ends without our asking, which is told twice."""
        self.end(task, "DEPROVISIONING", stop_code, exit_code)
        self.end(task, "STOPPED", stop_code, exit_code)

    def end(self, task: str, status: str, stop_code: str = "SpotInterruption", exit_code: int | None = 143) -> None:
        """One step of the end of a task that we did not ask for."""
        self.ended.add(task)
        self.happen(self.world.task_event(task, status, stop_code=stop_code, exit_code=exit_code, desired="STOPPED"))

    # What is left

    def living(self) -> list[str]:
        return [arn for arn in self.world.task_arns() if self.world.task(arn).desired_status == "RUNNING"]

    def assert_nothing_left(self) -> None:
        assert self.living() == []
        assert self.world.records() == {}
        assert self.world.timers() == {}


class Person:
    """A participant with a browser."""

    def __init__(self, study: StudyOnMoto, user: str) -> None:
        self.study, self.user = study, user
        self.page = ""

    def send(self, payload: str, query: str = "", body: str | None = None, **changes: Any) -> dict[str, Any]:
        event = aws_events.load(payload)
        event["rawQueryString"] = urlencode({"projectId": PROJECT, "userId": self.user}) + query
        if body is not None:
            event |= {"body": base64.b64encode(body.encode()).decode(), "isBase64Encoded": True}
        return next_step.handler({**event, **changes}, None)

    def look(self) -> str:
        answer = self.send("http_get")
        assert answer["statusCode"] == 200, answer
        self.page = html.unescape(body_of(answer).decode())
        return self.page

    @property
    def hidden(self) -> dict[str, str]:
        return hidden(self.page)

    def answer(self, **fields: str) -> None:
        """Submit the page that is open, and see the next."""
        answer = self.send("http_post_form", body=urlencode({**self.hidden, **fields}))
        assert answer["statusCode"] == 303, answer
        self.look()

    @property
    def at(self) -> str:
        """The step whose page is open."""
        return str(re.findall(r'data-step="([^"]+)"', self.page)[0])

    def poll(self) -> Any:
        answer = self.send("http_get", f"&poll={GAME}", headers={"accept": "application/json"})
        assert answer["statusCode"] == 200
        return json.loads(body_of(answer))

    def play(self, score: int = 120) -> None:
        """The trial writes down that it is done, and the browser comes back."""
        body = json.dumps({"step": GAME, "answers": {"score": score}}).encode()
        self.study.put(f"{PROJECT}/users/{self.user}/answers/{GAME}.json", body)
        self.look()

    def to_the_game(self) -> None:
        self.look()
        self.answer(consent="yes")
        self.answer(age="33")
        assert self.at == GAME

    def act(self) -> bool:
        """Do the next thing there is to do, if it can be done now; False at the end."""
        self.look()
        if self.at == "finalStep":
            return False
        if self.at != GAME:
            self.answer(said=f"at {self.at}")
        elif self.poll()["state"] == "ready":
            self.play()
        return True


PAIRS: dict[str, Any] = {
    "players": 2,
    "trial": {**read_project(ROOT).registration()["trial"], "players": {"first_0": "human", "second_0": "human"}},
}
"""What makes the example study one that participants play in pairs."""


class MotoMember(Person):
    """A participant of a study that several play together."""

    def poll(self) -> Any:
        """Ask as the page does, with the ticket that it has in its address."""
        query = f"&poll={GAME}&ticket={self.hidden['hippodrome-ticket']}"
        answer = self.send("http_get", query, headers={"accept": "application/json"})
        assert answer["statusCode"] == 200
        return json.loads(body_of(answer))

    def leave(self) -> None:
        """They close the lobby's page."""
        body = urlencode({**self.hidden, "hippodrome-action": "leave"})
        assert self.send("http_post_form", body=body)["statusCode"] == 204

    @property
    def membership(self) -> Any:
        """The document that says in which session they play; None if it is not decided."""
        return self.study.stored(membership_key(PROJECT, self.user))


def come(study: StudyOnMoto, *members: MotoMember) -> None:
    """They come to the game. Their servers are started ahead, while they answer the page before it."""
    for member in members:
        member.look()
        member.answer(consent="yes")
    study.deliver()
    for member in members:
        member.answer(age="33")


def meet(*members: MotoMember, polls: int = 6) -> list[Any]:
    """They wait in the lobby together, and ask in turn until none of them is in it any more; their last states."""
    states: list[Any] = []
    for _ in range(polls):
        states = [member.poll() for member in members]
        if all(state["state"] != "lobby" for state in states):
            return states
    raise AssertionError(f"not matched: {states}")


def play_together(study: StudyOnMoto, *members: MotoMember, score: int = 120) -> None:
    """The trial writes each member's answer, and their browsers come back."""
    session = members[0].membership["session"]
    for member in members:
        answers = {"score": score, "session": session, "player": member.membership["seat"], "outcome": "finished"}
        body = json.dumps({"step": GAME, "answers": answers}).encode()
        study.put(f"{PROJECT}/users/{member.user}/answers/{GAME}.json", body)
    for member in members:
        member.look()
