"""The example study on moto, and a participant with a browser. The test says when messages are delivered.

The test goes step by step.
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

from hippodrome.control.config import read_project
from hippodrome.control.model import ids, server
from hippodrome.functions import (
    installed,
    next_step,
    start_server,
    stop_server,
    task_changed,
    update_project_master_list,
)
from hippodrome.protocol.keys import membership_key
from testing import aws_events
from testing.moto_world import MotoWorld
from testing.visitors import body_of, hidden

ROOT = Path(__file__).resolve().parents[1]
PROJECT = "ms-pacman"
FUNCTIONS = {"start": start_server, "stop": stop_server, "task": task_changed}
GAME, AFTER = "3", "4"


class StudyOnMoto:
    """An account with the example study, and what AWS does between the functions: queues, ECS's events, delays.

    `changes` replaces keys of the registration. With `disorder`, which draws the order, every message comes twice, late
    and in any order, and changes of the zone are not in sync at once.
    """

    def __init__(self, world: MotoWorld, disorder: random.Random | None = None, **changes: Any) -> None:
        self.world, self.disorder = world, disorder
        self.waiting: list[tuple[str, str]] = []  # queue and body
        self.begun: set[str] = set()  # ARNs of tasks whose start was told to `task_changed`
        self.ended: set[str] = set()  # ARNs of tasks whose end was told
        installed.use(world.platform)
        registration = {**read_project(ROOT).registration(), **changes}
        for file in (ROOT / "steps").iterdir():
            self.put(f"{PROJECT}/steps/{file.name}", file.read_bytes())
        answer = update_project_master_list.handler({"project": registration}, None)
        assert answer.get("registered") == PROJECT, answer

    # Documents

    def put(self, key: str, body: bytes) -> None:
        self.world.client("s3").put_object(Bucket=self.world.env["BUCKET"], Key=key, Body=body)

    def stored(self, key: str) -> Any:
        """Return the JSON of a document; None if there is none."""
        s3 = self.world.client("s3")
        try:
            return json.loads(s3.get_object(Bucket=self.world.env["BUCKET"], Key=key)["Body"].read())
        except s3.exceptions.NoSuchKey:
            return None

    def record(self, user: str) -> Any:
        """Return the record of the participant's server; None if there is none."""
        return self.stored(server.key(ids.server_label(PROJECT, user)))

    # What AWS does

    def happen(self, *events: dict[str, Any]) -> None:
        """Send ECS events to the queue of `task_changed`."""
        self._send("task", *[json.dumps(event) for event in events])

    def deliver(self, queue: str | None = None) -> None:
        """Deliver all messages, and those that follow from them, until none is left.

        With `queue`, deliver one batch of that queue. Raises AssertionError if there are always more messages.
        """
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
        raise AssertionError(f"there are always more messages: {len(self.waiting)}, such as {self.waiting[0]}")

    def deliver_some(self) -> None:
        """Deliver one batch of one queue, if any message waits."""
        self._collect()
        if self.disorder:
            # A look that finds a change not in sync sends a message for the next look, and here that message comes twice.
            # So more than half of the looks must find it in sync, or there would be more and more messages.
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
        assert self.disorder or not again, "a message failed although all came in order"
        self.waiting += [m for m, r in zip(batch, event["Records"], strict=True) if r["messageId"] in again]

    def lose(self, task: str, stop_code: str = "SpotInterruption", exit_code: int | None = 143) -> None:
        """Let a task end that no function has stopped, and send both events of its end."""
        self.end(task, "DEPROVISIONING", stop_code, exit_code)
        self.end(task, "STOPPED", stop_code, exit_code)

    def end(self, task: str, status: str, stop_code: str = "SpotInterruption", exit_code: int | None = 143) -> None:
        """Send one event of the end of a task that no function has stopped."""
        self.ended.add(task)
        self.happen(self.world.task_event(task, status, stop_code=stop_code, exit_code=exit_code, desired="STOPPED"))

    # What is left

    def living(self) -> list[str]:
        """Return the ARNs of the tasks that were not told to stop."""
        return [arn for arn in self.world.task_arns() if self.world.task(arn).desired_status == "RUNNING"]

    def settle(self) -> None:
        """Deliver all messages. Raises AssertionError if a task, a DNS record or a timer is left."""
        self.deliver()
        self.assert_nothing_left()

    def assert_nothing_left(self) -> None:
        """Raise AssertionError if a task, a DNS record or a timer is left."""
        assert self.living() == []
        assert self.world.records() == {}
        assert self.world.timers() == {}


class Person:
    """A participant with a browser."""

    def __init__(self, study: StudyOnMoto, user: str) -> None:
        self.study, self.user = study, user
        self.page = ""

    def send(self, payload: str, query: str = "", body: str | None = None, **changes: Any) -> dict[str, Any]:
        """Send the request in `tests/events/{payload}.json`, and return the function's answer.

        `query` is added to the participant's query; `changes` replaces keys of the event.
        """
        event = aws_events.load(payload)
        event["rawQueryString"] = urlencode({"projectId": PROJECT, "userId": self.user}) + query
        if body is not None:
            event |= {"body": base64.b64encode(body.encode()).decode(), "isBase64Encoded": True}
        return next_step.handler({**event, **changes}, None)

    def look(self) -> str:
        """Load the page, remember it in `page`, and return it. Raises AssertionError unless the status is 200."""
        answer = self.send("http_get")
        assert answer["statusCode"] == 200, answer
        self.page = html.unescape(body_of(answer).decode())
        return self.page

    @property
    def hidden(self) -> dict[str, str]:
        """The hidden fields of the page that is open."""
        return hidden(self.page)

    def answer(self, **fields: str) -> None:
        """Submit the page that is open, and load the next one."""
        answer = self.send("http_post_form", body=urlencode({**self.hidden, **fields}))
        assert answer["statusCode"] == 303, answer
        self.look()

    @property
    def at(self) -> str:
        """The step whose page is open."""
        return str(re.findall(r'data-step="([^"]+)"', self.page)[0])

    def poll(self) -> Any:
        """Return the state of the server, as the waiting page asks for it."""
        answer = self.send("http_get", f"&poll={GAME}", headers={"accept": "application/json"})
        assert answer["statusCode"] == 200
        return json.loads(body_of(answer))

    def play(self, score: int = 120) -> None:
        """Store the answer of the game, as the trial does, and load the next page."""
        body = json.dumps({"step": GAME, "answers": {"score": score}}).encode()
        self.study.put(f"{PROJECT}/users/{self.user}/answers/{GAME}.json", body)
        self.look()

    def to_the_game(self) -> None:
        """Answer the pages before the game."""
        self.look()
        self.answer(consent="yes")
        self.answer(age="33")
        assert self.at == GAME

    def act(self) -> bool:
        """Answer the page that is open, or play if the server is ready. Return False at the last page."""
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
"""Changes of the registration with which participants play the example study in pairs."""


class MotoMember(Person):
    """A participant of a study whose participants play together."""

    def poll(self) -> Any:
        """Return the state of the lobby or the server, as the page asks for it: with its ticket in the address."""
        query = f"&poll={GAME}&ticket={self.hidden['hippodrome-ticket']}"
        answer = self.send("http_get", query, headers={"accept": "application/json"})
        assert answer["statusCode"] == 200
        return json.loads(body_of(answer))

    def leave(self) -> None:
        """Close the lobby's page."""
        body = urlencode({**self.hidden, "hippodrome-action": "leave"})
        assert self.send("http_post_form", body=body)["statusCode"] == 204

    @property
    def membership(self) -> Any:
        """The document that says in which session they play; None before they are matched."""
        return self.study.stored(membership_key(PROJECT, self.user))


def come(study: StudyOnMoto, *members: MotoMember) -> None:
    """Bring these members to the game. Their servers are started ahead, while they read the page before it."""
    for member in members:
        member.look()
        member.answer(consent="yes")
    study.deliver()
    for member in members:
        member.answer(age="33")


def meet(*members: MotoMember, polls: int = 6) -> list[Any]:
    """Let these members poll in turn until none of them is in the lobby any more; return the last state of each.

    Raises AssertionError if a member is still there after so many polls.
    """
    states: list[Any] = []
    for _ in range(polls):
        states = [member.poll() for member in members]
        if all(state["state"] != "lobby" for state in states):
            return states
    raise AssertionError(f"not matched: {states}")


def play_together(study: StudyOnMoto, *members: MotoMember, score: int = 120) -> None:
    """Store each member's answer of the game, as the trial does, and load their next pages."""
    session = members[0].membership["session"]
    for member in members:
        answers = {"score": score, "session": session, "player": member.membership["seat"], "outcome": "finished"}
        body = json.dumps({"step": GAME, "answers": answers}).encode()
        study.put(f"{PROJECT}/users/{member.user}/answers/{GAME}.json", body)
    for member in members:
        member.look()
