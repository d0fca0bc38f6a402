"""One simulated installation: the real functions on the simulated account, wired as `infra/template.yml` wires them."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple
from unittest.mock import patch

import msgspec

from hippodrome.control.limits.rules import SERVER_SLOTS
from hippodrome.control.model import ids, server
from hippodrome.control.model.design import Step
from hippodrome.control.model.messages import DnsChanged, KeepWarm, ServerAttempt, to_message
from hippodrome.control.model.project import MASTER_LIST, Events, MasterList, Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Server, ServerState
from hippodrome.control.model.warm_pool import POOLS
from hippodrome.control.participants import assigning
from hippodrome.control.ports import Message, Settings, Topic
from hippodrome.control.servers.causes import Cause
from hippodrome.control.storage.secret import KEY, Secret
from hippodrome.functions import installed, next_step, start_server, stop_server, sweep, task_changed
from hippodrome.protocol.keys import handover_key, handovers_folder, session_key
from hippodrome.protocol.session import is_session_id
from testing import aws_events, template
from testing.port_faults import Crash
from testing.simulation import functions, lobby
from testing.simulation.clock import GreenletClock
from testing.simulation.cloud import CONCURRENCY, Cloud, NoRoom
from testing.simulation.conditions import Conditions
from testing.simulation.functions import NO_LINEAGE, Lineage, SimulatedFunction, SimulatedQueue, Wire
from testing.simulation.matching import SimMatching
from testing.simulation.ports import SimBus, SimPlatform, SimTimers
from testing.simulation.tasks import TimedTask
from testing.simulation.trials import SimTrials
from testing.tasks import Life

SWEEP_EVERY = 300.0  # seconds
POLL = 1.0  # seconds between two questions of a server that waits for its certificate
WIRES = {  # the event source mappings of the template; tests/simulation/test_simulation.py compares them
    "start_server": Wire(batch=1, window=0, concurrency=20, visibility=90),
    "stop_server": Wire(batch=100, window=1, concurrency=2, visibility=90),
    "task_changed": Wire(batch=100, window=1, concurrency=2, visibility=90),
}
# Seconds, as in the template.
TIMEOUTS = {"next_step": 29, "start_server": 60, "task_changed": 60, "stop_server": 60, "sweep": 240}
_NAMED, _MADE = template.functions(), template.resources("AWS::Lambda::Function")
LOOPS = frozenset(name for name, logical in _NAMED.items() if _MADE[logical].get("RecursiveLoop") == "Allow")
WATCH_EVERY = 10.0  # seconds
HOP = (0.05, 0.4)  # seconds from a topic to its queue

SECRET = Secret("0" * 64)
PROJECT = Project(
    id="study",
    steps=[
        Step(key="1", page="consent"),
        Step(key="2", page="questionnaire"),
        Step(key="3", page="game"),
        Step(key="4", page="survey"),
        Step(key="finalStep", page="debrief"),
    ],
    live=True,
    use_a_w_s=True,
    max_runtime=30,
    events=Events(start_server_step="2", stop_server_step="4"),
    salt="0" * 16,
)


class Waiting(NamedTuple):
    """Stands for the module `time` where a function waits: its `sleep` takes virtual seconds."""

    sleep: Callable[[float], None]


class SimulatedWorld:
    """The installation and its clock. `run` lets time pass; `left` counts the resources that are left."""

    RECEIVES = 8  # deliveries of a message before it is a dead letter

    def __init__(
        self,
        seed: int,
        conditions: Conditions | None = None,
        project: Project = PROJECT,
        wires: Mapping[str, Wire] = MappingProxyType(WIRES),
        concurrency: int = CONCURRENCY,
        pages: Mapping[str, str] = MappingProxyType({}),
    ) -> None:
        """`pages`: the texts of step files that are not the usual one, by their names without `.html`."""
        self._pages = pages
        self.conditions = conditions or Conditions()
        self.project = project
        self.clock = GreenletClock(seed)
        self.clock.resumed, self.clock.ends = functions.enter, functions.ends
        self.cloud = Cloud(self.clock, concurrency, {"s3": self.conditions.s3})
        domain = "" if self.conditions.authority else "example.org"
        settings = Settings(bucket="bucket", root_domain=domain, max_runtime=120, game_sources="wss://*:*")
        self.platform = platform = SimPlatform(self.clock, self.cloud, settings, self.conditions)
        platform.timers = SimTimers(self.cloud, lambda message: self.publish(Topic.STOP, message))

        def function(name: str, handler: functions.Handler) -> SimulatedFunction:
            return SimulatedFunction(name, handler, self.cloud, platform, TIMEOUTS[name], loops=name in LOOPS)

        self.next_step = function("next_step", next_step.handler)
        self.start_server = function("start_server", start_server.handler)
        self.task_changed = function("task_changed", task_changed.handler)
        self.stop_server = function("stop_server", stop_server.handler)
        self.sweep = function("sweep", sweep.handler)
        self.start_queue, self.stop_queue, self.task_queue = (
            SimulatedQueue(function, self.clock, self.cloud, wires[function.name], self.RECEIVES)
            for function in (self.start_server, self.stop_server, self.task_changed)
        )
        platform.bus = SimBus(self.cloud, self.publish, self.task_queue.send)
        platform.tasks.changed = self.task_queue.send
        platform.tasks.started = self._started
        platform.tasks.owner = self._owner
        self._store_project()
        self.trials = SimTrials(platform, project.id, self.conditions.idle)
        self.matching = SimMatching(platform, project.id) if project.matching == "match" else None
        self.people = 0  # participants who have not come yet, or have not finished
        self.calls_until_quiet = 0  # calls of the functions when `watch` last saw something left to do
        self.clock.after(SWEEP_EVERY, self._sweep)

    @property
    def functions(self) -> list[SimulatedFunction]:
        """The functions other than `next_step`."""
        return [self.start_server, self.task_changed, self.stop_server, self.sweep]

    @property
    def queues(self) -> list[SimulatedQueue]:
        """The queues of `start_server`, `stop_server` and `task_changed`."""
        return [self.start_queue, self.stop_queue, self.task_queue]

    def publish(self, topic: Topic, message: Message, lineage: Lineage = NO_LINEAGE) -> None:
        """Deliver a message of a topic to its queue, sometimes twice."""
        queue = self.start_queue if topic is Topic.START else self.stop_queue
        chance = self.clock.random
        queue.send(message, chance.uniform(*HOP), lineage)
        if chance.random() < self.conditions.repeated:
            queue.send(message, chance.uniform(0.5, 30), lineage)

    def ask(self, method: str, query: str, body: str = "") -> tuple[int, Any]:
        """Send a request as a program does; return the status and the JSON of the answer.

        Raises what the function raises.

        The status is 429 if the site has no more requests left in this second, and 503 if the account has no
        concurrency left. AWS does not document which status an HTTP API has then (a REST API has 500); it is one of
        5xx, and the answer is none of our pages.
        """
        if not self.cloud.take("http"):
            self.cloud.throttled["http"] += 1
            return 429, None
        try:
            answer = self.next_step.invoke(aws_events.program_event(method, query, body))
        except NoRoom:
            return 503, None
        return answer["statusCode"], json.loads(answer["body"]) if answer.get("body") else None

    def run(self, until: float) -> None:
        """Let time pass until this second since the beginning."""
        before = installed._platform, installed._made
        waiting = Waiting(self.clock.sleep)
        try:
            with patch.multiple(assigning, time=waiting, _RANDOM=self.clock.random):
                self.clock.run(until)
        finally:
            installed._platform, installed._made = before

    def settle(self, until: float) -> None:
        """Let time pass until this second, or until no participant, message or resource is left.

        It waits for one more sweep, which may find leftovers that `left` does not count.
        """
        quiet = False
        while self.clock.seconds < until:
            self.run(min(until, self.clock.seconds + SWEEP_EVERY))
            quiet, before = self._quiet(), quiet
            if quiet and before:
                return

    def _quiet(self) -> bool:
        if self.people or any(queue.waiting for queue in self.queues):
            return False
        return not any(count for kind, count in self.left().items() if kind != "dead letters")

    def left(self) -> Mapping[str, int]:
        """Count what is left of each kind.

        These are tasks, DNS records, timers, servers' slots, warm servers that wait, entries and decisions of the
        lobby, handovers, open records, and dead letters.
        """
        kept = self.platform.documents.kept
        records = [json.loads(body) for key, (body, _, _) in kept.items() if key.startswith(server.RECORDS)]
        return {
            "tasks": sum(task.last is not Life.STOPPED for task in self.platform.tasks.tasks.values()),
            "names": len(self.platform.dns.records) - len(self.platform.dns.strangers),
            "timers": len(self.platform.timers.due),
            "slots": sum(
                len(json.loads(kept[key][0]).get("slots", ())) for key in kept if key.startswith(SERVER_SLOTS)
            ),
            "waiting": sum(
                len(json.loads(kept[key][0]).get("warmServers", ())) for key in kept if key.startswith(POOLS)
            ),
            "lobby": len(lobby.left_over(kept, self.project)),
            "handovers": sum(key.startswith(handovers_folder(self.project.id)) for key in kept),
            "open records": sum(record["state"] != "closed" for record in records),
            "dead letters": sum(len(queue.dead) for queue in self.queues),
        }

    def blamed(self) -> int:
        """Count the servers that Spot took back although their record names another cause."""
        kept, found = self.platform.documents.kept, 0
        for task in self.platform.tasks.tasks.values():
            label, attempt = ids.parse_server_name(task.name) or ("", 0)
            if task.interrupted and (stored := kept.get(server.key(label))):
                record = from_json(stored[0], Server)
                runs = [*record.earlier, server.past_attempt(record)]
                found += any(one.attempt == attempt and one.cause not in ("", Cause.SPOT) for one in runs)
        return found

    def story(self) -> str:
        """Return the seed and the timeline as text, for people."""
        lines = [f"{seconds:9.2f} s  {text}" for seconds, text in self.cloud.timeline]
        return "\n".join([f"seed {self.clock.seed}", *lines])

    def ask_for_warm_servers(self) -> None:
        """If the project has warm servers, send the message that its registration sends."""
        if self.project.warm_servers:
            self.clock.spawn(lambda: self.publish(Topic.START, to_message(KeepWarm(self.project.id))))

    def close(self) -> None:
        """Register the project as closed."""
        self.project = msgspec.structs.replace(self.project, live=False)
        documents = self.platform.documents
        documents.keep(MASTER_LIST, to_json(MasterList(projects=[self.project])), documents.kept[MASTER_LIST][1])
        self.ask_for_warm_servers()

    def task_at(self, url: str) -> TimedTask | None:
        """Return the task that a browser reaches at this address; None if there is none."""
        name = url.split("/")[2].split(":", maxsplit=1)[0]
        host = name if self.conditions.authority else self.platform.dns.records.get(name)
        return self.platform.tasks.at(host) if host else None

    def _started(self, name: str) -> None:
        """Without a domain, a server orders a certificate for its address at once."""
        if self.conditions.authority:
            seconds = self.clock.random.uniform(*self.conditions.authority)
            self.clock.after(seconds, lambda: self._certify(name))

    def _certify(self, name: str) -> None:
        """Do what `certify_server` does: the certificate is handed out once the server's record has its address."""
        label, attempt = ids.parse_server_name(name) or ("", 0)
        stored = self.platform.documents.kept.get(server.key(label))
        record = from_json(stored[0], Server) if stored else None
        if record is None or not record.is_open(attempt):
            return
        if record.state is ServerState.STARTING:
            self.clock.after(POLL, lambda: self._certify(name))
        elif record.state is ServerState.NAMING:
            self.task_queue.send(to_message(DnsChanged("", [ServerAttempt(label, attempt)])), 0)

    def _owner(self, task: TimedTask) -> str:
        """Return the id of the participant or session to whom this server belongs: a warm server by its handover.

        Empty for a warm server that is not assigned yet, for a session that is not formed, and for a server that was
        started for one participant.
        """
        kept, owner = self.platform.documents.kept, task.session
        if task.is_warm_server and (found := kept.get(handover_key(self.project.id, task.name))):
            owner = str(json.loads(found[0])["userId"])
        formed = not is_session_id(owner) or session_key(self.project.id, owner) in kept
        return owner if formed else ""

    def _store_project(self) -> None:
        documents = self.platform.documents
        documents.keep(KEY, to_json(SECRET))
        documents.keep(MASTER_LIST, to_json(MasterList(projects=[self.project])))
        files = {file for page in self.project.all_pages for file in page.files}
        for file in sorted(files):
            page = self._pages.get(file) or f"<h1>{file}</h1><input name=answer>"
            documents.keep(f"{self.project.id}/steps/{file}.html", page.encode())

    def watch(self) -> None:
        """Update `calls_until_quiet` every `WATCH_EVERY` seconds if anything is left. Slow with many participants."""
        if any(self.left().values()) or any(queue.waiting for queue in self.queues):
            self.calls_until_quiet = self.cloud.number
        self.clock.after(WATCH_EVERY, self.watch)

    def _sweep(self) -> None:
        def once() -> None:
            try:
                self.sweep.later({})
            except (Crash, Exception) as error:  # noqa: BLE001 - the next sweep tries again
                self.cloud.log(f"sweep failed: {type(error).__name__}")

        self.clock.spawn(once)
        self.clock.after(SWEEP_EVERY, self._sweep)
