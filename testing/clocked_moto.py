"""An installation on moto where time passes: queues deliver again, tasks start and end, timers fire, the sweep runs.

The functions are the real handlers on the real adapters. Each has a platform of its own, and its calls are judged by
its role (see `testing/iam/enforcement.py`). This module does what AWS does between them, on a clock that jumps from one
event to the next, always in the same order, so that the n-th call of a journey is the same call in every run.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import math
from collections.abc import Callable, Generator, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Self
from unittest import mock

import moto.s3.models
import msgspec
from moto.ec2.models import ec2_backends
from moto.ecs.models import ecs_backends
from moto.route53.models import route53_backends
from moto.s3.models import s3_backends
from moto.scheduler.models import scheduler_backends
from moto.sqs.models import sqs_backends

from deploy.aws.account import Account, Installation
from deploy.core.stages import Executor
from deploy.operate.eraser import Eraser, FoundOfParticipant
from hippodrome.aws import AwsPlatform
from hippodrome.config import read_project
from hippodrome.model import ids, participant, server
from hippodrome.model.project import Project
from hippodrome.model.records import from_data, to_json
from hippodrome.storage.secret import KEY as SECRET
from lambdas import (
    installed,
    next_step,
    send_start_server_message,
    send_stop_server_message,
    start_server,
    stop_server,
    sweep,
    task_changed,
    update_project_master_list,
)
from testing import aws_events, derived, template
from testing.aws_events import ACCOUNT
from testing.aws_faults import AwsFault, AwsFaultInjector
from testing.clock import Clock
from testing.moto_world import MotoWorld

ROOT = Path(__file__).resolve().parents[1]
PROJECT = "ms-pacman"
GAME, AFTER, FINAL = "3", "4", "finalStep"

MODULES = {
    "next_step": next_step,
    "send_start_server_message": send_start_server_message,
    "send_stop_server_message": send_stop_server_message,
    "start_server": start_server,
    "stop_server": stop_server,
    "sweep": sweep,
    "task_changed": task_changed,
    "update_project_master_list": update_project_master_list,
}
QUEUES = {"start": ("start_server", 1), "stop": ("stop_server", 100), "task": ("task_changed", 100)}  # batch sizes
HOP = 0.2  # seconds from a topic to its queue
AGAIN = 90.0  # seconds until a message that failed is visible again; `VisibilityTimeout` in the template
RECEIVES = 8  # deliveries until a message is a dead letter; `maxReceiveCount`
SWEEP_EVERY = 300.0  # seconds
STARTS = 25.0  # seconds from RunTask to RUNNING
ENDS = 4.0  # seconds from StopTask until the containers have ended: DEPROVISIONING
GONE = 15.0  # seconds from DEPROVISIONING until the network interface is gone: STOPPED
HORIZON = 4 * 3600.0  # seconds until everything must be over


class ClockedPlatform(AwsPlatform):
    """The AWS adapters with the installation's clock.

    Functions share clients: making some takes longer than a journey.
    """

    def __init__(self, env: Any, clock: Clock, session: Any, clients: dict[str, Any]) -> None:
        super().__init__(env, session)
        self._clients, self._clock = clients, clock

    def now(self) -> datetime:
        return self._clock.now()

    def run_all(self, acts: Any) -> Any:
        """Run `acts` one after the other, so that the n-th call is the same in every run."""
        return [act() for act in acts]


def outputs(world: MotoWorld) -> dict[str, str]:
    """Return the stack outputs that `erase` needs, with the values of this account."""
    names = {
        "Bucket": "BUCKET", "Cluster": "CLUSTER", "ScheduleGroup": "SCHEDULE_GROUP", "HostedZoneId": "HOSTED_ZONE_ID",
    }  # fmt: skip
    return {output: world.env[variable] for output, variable in names.items()}


class Mail(NamedTuple):
    """A message in a queue: the second at which it becomes visible, and how often it was received before."""

    at: float
    body: str
    receives: int


class TimedInstallation:
    """The installation. `begin` starts a run; `live` lets time pass until nothing is left that could still happen."""

    def __init__(self) -> None:
        self.clock = Clock(datetime.now(UTC).replace(microsecond=0))
        self.world = MotoWorld()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> Self:
        world = self._stack.enter_context(self.world)
        self.injector = AwsFaultInjector()
        self._stack.enter_context(self.injector.installed())
        # Gap: moto stamps documents with the machine's time. Bridge: stamp them with the installation's.
        naive = lambda: self.clock.now().replace(tzinfo=None)  # noqa: E731
        self._stack.enter_context(mock.patch.object(moto.s3.models, "utcnow", naive))
        self._clients: dict[str, Any] = {}
        self._rooms: dict[str, Any] = {name: (self._platform(self._env(name)), {}) for name in MODULES}
        self._timeouts = {
            name: template.resources("AWS::Lambda::Function")[resource]["Timeout"]
            for name, resource in template.functions().items()
        }
        for file in (ROOT / "steps").iterdir():
            self.put(f"{PROJECT}/steps/{file.name}", file.read_bytes())
        if world.iam:
            world.iam.exists = lambda bucket, key: key in self._keys  # type: ignore[method-assign]  # without a call
        self._account = Account(self.injector.session, world.region)
        self._installation = Installation("hippodrome", world.region, "CREATE_COMPLETE", outputs(world))
        assert self._account.id  # looked up now, so that no run makes this call
        platform = self._platform(world.env)
        self._stack.enter_context(mock.patch.object(self._account, "platform", return_value=platform))
        self._pages = self._contents()
        self.hold_study()
        return self

    def __exit__(self, *error: Any) -> None:
        installed.use(None)
        self._stack.__exit__(*error)

    def _platform(self, env: Any) -> ClockedPlatform:
        return ClockedPlatform(env, self.clock, self.injector.session, self._clients)

    def _env(self, function: str) -> dict[str, str]:
        iam = self.world.iam
        return iam.environment(function) if iam else self.world.env

    def hold_study(self, **changes: Any) -> None:
        """Register the example study with these changes of its registration, and forget the study before it."""
        self._s3_before = self._pages
        self.begin()
        self.registration = {**read_project(ROOT).registration(), **changes}
        answer = self.invoke("update_project_master_list", {"project": self.registration})
        assert answer.get("registered") == PROJECT, answer
        self.project = self.stored("project_master_list.json")["projects"][0]
        self.project["secret"] = derived.project_secret(self._keys[SECRET].value, self.project)
        self._s3_before = self._contents()

    # A run

    def begin(self, fault: AwsFault | None = None) -> None:
        """Start a new run with this fault and cold functions, without participants, tasks and documents of the last one."""
        now = self._contents()
        for key in now.keys() - self._s3_before.keys():
            self._keys.pop(key)
        for key, body in self._s3_before.items():
            if now.get(key) != body:
                self.put(key, body)
        ecs = self._ecs
        for tasks in ecs.tasks.values():
            tasks.clear()
        for name in [name for name in ecs.clusters if name != "hippodrome"]:
            del ecs.clusters[name]
        self.world._tokens.clear()
        self.world._versions.clear()
        self.world.calls.clear()
        ec2 = ec2_backends[ACCOUNT][self.world.region]
        ec2.enis.clear()
        ec2.addresses = []
        self._zone.rrsets = [record for record in self._zone.rrsets if record.type != "A"]
        self._zone.rr_changes.clear()
        self._schedules.clear()
        for queue in self._queues.values():
            queue._messages.clear()
        self._fresh()
        self.injector.begin(fault)

    def _fresh(self) -> None:
        self.clock.forget()
        self.clock.seconds = math.ceil(self.clock.seconds) + 60
        self.waiting: dict[str, list[Mail]] = {queue: [] for queue in QUEUES}
        self.dead: list[str] = []
        self.people: list[Any] = []
        self.promised: dict[str, dict[str, Any]] = {}  # by key: the answers that a participant was told are stored
        self.begun: dict[str, float] = {}  # by task: the second of its RunTask
        self.running: set[str] = set()
        self.ended: set[str] = set()
        self.failures: list[str] = []  # visible failures: messages that came again, pages that did not come
        self.too_long: list[str] = []  # invocations beyond the timeout of their function
        self.delays: dict[str, float] = {}  # by queue: additional seconds until a message is visible
        self.sweeps_from = 0.0  # the sweep does not run before this second
        self.on_running: Callable[[str], None] = lambda task: None  # called with each task that has started
        for _, cache in self._rooms.values():
            cache.clear()
        self.clock.after(SWEEP_EVERY, self._sweep)

    def live(self) -> None:
        """Let time pass until no participant and no resource is left, for at most HORIZON seconds."""
        end = self.clock.seconds + HORIZON
        self._collect()
        while not self._quiet() and self.clock.seconds < end:
            self._step()

    def live_for(self, seconds: float) -> None:
        """Let so many seconds pass."""
        done: list[int] = []
        self.clock.after(seconds, lambda: done.append(1))
        while not done:
            self._step()

    def _step(self) -> None:
        timers = {name: self.clock.seconds_at(at) for name, (at, _) in self.world.timers().items()}
        first = min(timers, key=lambda name: timers[name], default=None)
        if first is not None and timers[first] < self.clock.next():
            self.clock.seconds = max(self.clock.seconds, timers[first])
            self.world.fire_timer(first)
        else:
            self.clock.step()
        self._collect()

    def _quiet(self) -> bool:
        return not (self.people or any(self.left().values()) or self.begun.keys() - self.ended)

    def left(self) -> dict[str, int]:
        """Count what is left of each kind: resources, records, messages that wait."""
        records = [self.stored(key) for key in list(self._keys) if key.startswith("_servers/")]
        places = [self.stored(key) for key in list(self._keys) if key.startswith("_places/")]
        return {
            "tasks": len(self.living()),
            "names": len(self.world.records()),
            "timers": len(self._schedules),
            "clusters": sum(c.status == "ACTIVE" for c in self._ecs.clusters.values()) - 1,
            "open records": sum(record["state"] != "closed" for record in records),
            "places": sum(len(place.get("held", ())) for place in places),
            "messages": sum(map(len, self.waiting.values())),
            "dead letters": len(self.dead),
        }

    def lost(self) -> list[str]:
        """Return the keys of answers that a participant was told are stored, and that are missing or differ now."""
        return [key for key, answers in self.promised.items() if (self.stored(key) or {}).get("answers") != answers]

    def go_on(self, walk: Iterator[float]) -> None:
        """Start a participant's walk: a generator that yields the seconds until its next step."""
        self.people.append(walk)

        def step() -> None:
            try:
                self.clock.after(next(walk), step)
            except StopIteration:
                self.people.remove(walk)

        self.clock.after(0, step)

    # Functions

    def invoke(self, function: str, event: dict[str, Any]) -> Any:
        """Invoke a function with its own platform and cache; return its answer. Raises what the handler raises."""
        self.injector.invocation(function)
        installed._platform, installed._made = self._rooms[function]
        try:
            answer = MODULES[function].handler(event, None)
        finally:
            installed._platform, installed._made = None, {}
            if self.injector.waited > self._timeouts[function]:
                self.too_long.append(f"{function}: {self.injector.waited:.0f} s")
        self._collect()
        return answer

    def ask(self, function: str, method: str, query: dict[str, str], form: dict[str, str] | None = None) -> Any:
        """Send a request as a program does. Return its JSON with its `status`; None for a status of 500 or more."""
        answer = self.invoke(function, aws_events.program_event(method, query, form or {}))
        if answer["statusCode"] >= 500:
            self.failures.append(f"{function} answered {answer['statusCode']}")
            return None
        return json.loads(answer["body"]) | {"status": answer["statusCode"]}

    def _sweep(self) -> None:
        self.clock.after(SWEEP_EVERY, self._sweep)
        if self.clock.seconds < self.sweeps_from:
            return
        try:
            swept = self.invoke("sweep", {})
        except Exception as error:  # noqa: BLE001 - Lambda does not try again, but the next sweep comes
            self.failures.append(f"the sweep failed: {type(error).__name__}")
        else:
            if swept["failed"]:
                self.failures.append("the sweep could not finish everything")

    # Queues

    def publish(self, topic: str, message: dict[str, Any]) -> None:
        """Publish a message to the topic, as an administrator may."""
        arn = self.world.env[f"{topic.upper()}_SERVER_TOPIC_ARN"]
        self.world.client("sns").publish(TopicArn=arn, Message=json.dumps(message))
        self._collect()

    def _send(self, queue: str, body: str, delay: float, receives: int = 0) -> None:
        seconds = math.ceil(delay + HOP + self.delays.get(queue, 0))  # messages of the same second are one batch
        self.waiting[queue].append(Mail(self.clock.seconds + seconds, body, receives))
        self.clock.after(seconds, partial(self._deliver, queue))

    def _deliver(self, queue: str) -> None:
        function, size = QUEUES[queue]
        while batch := [mail for mail in self.waiting[queue] if mail.at <= self.clock.seconds][:size]:
            for mail in batch:
                self.waiting[queue].remove(mail)
            event = self.world.sqs_event(queue, [mail.body for mail in batch])
            answer = self.invoke(function, event)
            again = {failure["itemIdentifier"] for failure in answer["batchItemFailures"]}
            for mail, record in zip(batch, event["Records"], strict=True):
                if record["messageId"] not in again:
                    continue
                self.failures.append(f"{function} wants a message again")
                if mail.receives + 1 == RECEIVES:
                    self.dead.append(mail.body)
                else:
                    self._send(queue, mail.body, AGAIN, mail.receives + 1)

    def _collect(self) -> None:
        """Schedule what the functions' calls have caused: messages that were sent, tasks that were run or stopped."""
        for name, url in (("start", "start_queue"), ("stop", "stop_queue"), ("task", "task_queue")):
            messages = self._queues[self.world.ids[url].rpartition("/")[2]]._messages
            for message in messages:
                held = (message.delayed_until - message.sent_timestamp) / 1000 if message.delayed_until else 0
                self._send(name, message.body, round(held))
            messages.clear()
        for arn in self.world.task_arns():
            task = self.world.task(arn)
            if arn not in self.begun:
                self.begun[arn] = self.clock.seconds
                self.clock.after(STARTS, partial(self._run, arn))
            if task.desired_status == "STOPPED" and arn not in self.ended:
                self.ended.add(arn)
                self.clock.after(ENDS, partial(self._tell_end, arn))

    # The administrator

    def erase(self, project: str, user: str) -> FoundOfParticipant:
        """Do what `deploy erase` does; time passes while it waits. Return what its last look found."""
        self.injector.invocation("erase")
        eraser = Eraser(
            self._account,
            self._installation,
            project,
            user,
            executor=Executor(self.live_for, lambda: self.clock.seconds),
        )
        return eraser.run()

    # Tasks

    def living(self) -> list[str]:
        """Return the ARNs of the tasks that are not STOPPED."""
        return [arn for arn in self.world.task_arns() if self.world.task(arn).last_status != "STOPPED"]

    def task_with(self, token: str) -> str | None:
        """Return the running task whose trial has this token; None if there is none."""
        for arn in self.world.task_arns():
            environment = self.world.task(arn).overrides["containerOverrides"][0]["environment"]
            if {"name": "TOKEN", "value": token} in environment and arn not in self.ended and arn in self.running:
                return arn
        return None

    def end(self, arn: str, stop_code: str = "EssentialContainerExited", exit_code: int | None = 0) -> None:
        """Let a task end that no function has stopped."""
        if arn not in self.ended:
            self.ended.add(arn)
            self._tell_end(arn, stop_code=stop_code, exit_code=exit_code)

    def _run(self, arn: str) -> None:
        if arn not in self.ended:
            self.running.add(arn)
            self._tell(arn, "RUNNING")
            self.on_running(arn)

    def _tell_end(self, arn: str, **more: Any) -> None:
        """Send the events DEPROVISIONING and, `GONE` seconds later, STOPPED, as ECS does."""
        self._tell(arn, "DEPROVISIONING", desired="STOPPED", **more)
        self.clock.after(GONE, lambda: self._tell(arn, "STOPPED", desired="STOPPED", **more))

    def _tell(self, arn: str, status: str, **more: Any) -> None:
        self._send("task", json.dumps(self.world.task_event(arn, status, **more)), 0)

    # Documents

    def put(self, key: str, body: bytes) -> None:
        self.world.client("s3").put_object(Bucket=self.world.env["BUCKET"], Key=key, Body=body)

    def stored(self, key: str) -> Any:
        """Return the JSON of a document; None if there is none."""
        found = self._keys.get(key)
        return json.loads(found.value) if found else None

    def _contents(self) -> dict[str, bytes]:
        return {key: found.value for key, found in self._keys.items()}

    def stored_keys(self) -> list[str]:
        """Return the keys of all documents."""
        return list(self._keys)

    def token(self, user: str) -> str:
        """Return the token of the participant's server."""
        return derived.token(self._keys[SECRET].value, self.record(user))

    def record(self, user: str) -> Any:
        """Return the record of the participant's server; None if there is none."""
        return self.stored(server.key(ids.server_label(PROJECT, user)))

    # moto's own objects

    @property
    def _keys(self) -> Any:
        return s3_backends[ACCOUNT]["aws"].buckets[self.world.env["BUCKET"]].keys

    @property
    def _ecs(self) -> Any:
        return ecs_backends[ACCOUNT][self.world.region]

    @property
    def _zone(self) -> Any:
        return route53_backends[ACCOUNT]["aws"].get_hosted_zone(self.world.ids["zone"])

    @property
    def _schedules(self) -> Any:
        return scheduler_backends[ACCOUNT][self.world.region].schedule_groups["hippodrome"].schedules

    @property
    def _queues(self) -> Any:
        return sqs_backends[ACCOUNT][self.world.region].queues


class VisitorOnMoto:
    """A participant who reads, answers, waits and plays, and who comes back after a fault.

    At the end `finished` is true, or `reason` is why the study was over for them.
    """

    READS, PLAYS, POLLS, UNREACHABLE = 15, 20, 45, 180  # seconds; UNREACHABLE: at an address where no server answers
    TRIES, PATIENCE = 5, 1800  # requests of one page; seconds at the waiting page

    def __init__(
        self,
        installation: TimedInstallation,
        user: str,
        *,
        at_game: bool = False,
        leaves: bool = False,
        comes: float = 0,
    ) -> None:
        """`at_game`: they begin at the game, with all answers before it stored and the start message just sent.

        With `at_game` they have finished after the game. `leaves`: they close the page of the game for good. `comes`:
        they come after so many seconds.
        """
        self.installation, self.user, self.leaves = installation, user, leaves
        self.goal = AFTER if at_game else FINAL
        self.finished, self.reason = False, ""
        if at_game:
            self._has_come_to_the_game()
        installation.go_on(itertools.chain([comes], self.walk()))

    @property
    def served_or_told(self) -> bool:
        """Whether they have finished, or were told why they cannot."""
        return self.finished or bool(self.reason)

    def _has_come_to_the_game(self) -> None:
        project = from_data(self.installation.project, Project)
        arrived = participant.new_participant(project, self.user, {}, self.installation.clock.now())
        self.installation.put(participant.participant_key(PROJECT, self.user), to_json(arrived))
        for step in project.steps:
            if step.type.on_server:
                break
            record = participant.new_answer(project, self.user, step, {"said": "before"}, self.installation.clock.now())
            self.installation.put(self._answer(step.key), msgspec.json.encode(record))
            self.installation.promised[self._answer(step.key)] = {"said": "before"}
        self.installation.publish("start", {"projectId": PROJECT, "userId": self.user})

    def walk(self) -> Iterator[float]:
        """Take part, from the link to the end; yield the seconds until each next step."""
        page = yield from self.ask("GET")
        while page and not self.served_or_told:
            if "state" in page:
                if self.leaves:
                    self.reason = "left by themselves"
                    return
                yield from self._game(page)
                if self.reason:
                    return
                page = yield from self.ask("GET")
            elif page.get("step") == self.goal:
                self.finished = True
            elif "step" not in page:
                self.reason = page["message"]
            else:
                yield self.READS
                step, said = page["step"], {"said": f"at {page['step']}"}
                form = {"hippodrome-step": step, "hippodrome-ticket": page["ticket"], **said}
                page = yield from self.ask("POST", form)
                if page and page.get("step") != step:
                    self.installation.promised[self._answer(step)] = said

    def ask(self, method: str, form: dict[str, str] | None = None, **more: str) -> Generator[float, None, Any]:
        """Request a page, up to `TRIES` times, 4 seconds apart; return its JSON, or None if none came."""
        for _ in range(self.TRIES):
            query = {"projectId": PROJECT, "userId": self.user, **more}
            if (page := self.installation.ask("next_step", method, query, form)) is not None:
                return page
            yield 4
        return None

    def _game(self, page: dict[str, Any]) -> Iterator[float]:
        until = self.installation.clock.seconds + self.PATIENCE
        state, restarts = page, 0
        for look in itertools.count(1):
            if self.installation.clock.seconds > until:
                return
            if state["state"] == "ready":
                task = self.installation.task_with(state["token"])
                yield self.PLAYS if task else self.UNREACHABLE
                if task and task not in self.installation.ended:
                    score = {"score": 120}
                    body = json.dumps({"step": GAME, "answers": score}).encode()
                    self.installation.put(self._answer(GAME), body)
                    self.installation.promised[self._answer(GAME)] = score
                    return
            elif state["state"] in ("failed", "ended"):
                if not state["again"] or restarts == 2:
                    self.reason = f"{state['state']}: {state['reason']}"
                    return
                restarts += 1
                yield from self.ask("POST", {"hippodrome-step": GAME, "hippodrome-action": "restart"})
            yield self.POLLS
            if look % 4:
                state = (yield from self.ask("GET", poll=GAME)) or state
            else:  # people reload
                state = (yield from self.ask("GET")) or state
                if "state" not in state:
                    return

    def _answer(self, step: str) -> str:
        return f"{PROJECT}/users/{self.user}/answers/{step}.json"
