"""An installation whose messages stay in their queues until the test delivers them: now, later, again, or with others."""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from functools import partial
from typing import Any

import msgspec

from hippodrome.control.model import ids, messages, server
from hippodrome.control.model.messages import KeepWarm, StopServer, to_message
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project, step_key
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.model.warm_pool import Pool, pool_key
from hippodrome.control.ports import DnsRecord, TaskRequest
from hippodrome.control.storage.secret import KEY, Secret
from hippodrome.functions import (
    installed,
    next_step,
    send_start_server_message,
    send_stop_server_message,
    start_server,
    stop_server,
    sweep,
    task_changed,
)
from hippodrome.protocol import handover
from hippodrome.protocol.handover import Handover
from hippodrome.protocol.keys import answer_key, handover_key, handovers_folder, participant_folder
from testing import aws_events
from testing.port_faults import Crash, FaultAt
from testing.servers import Servers
from testing.slots import release_participant
from testing.studies import PAGES
from testing.tasks import Task
from tests.stateful.account import Account
from tests.stateful.functions import Functions, Invocation

QUEUES = {"start": start_server.handler, "stop": stop_server.handler, "tasks": task_changed.handler}
RELAYS = {"start": send_start_server_message.handler, "stop": send_stop_server_message.handler}
RECEIVES = 8  # failed deliveries before a message is a dead letter, when no faults are injected any more
VISIBILITY = 90  # seconds until a failed message comes again, when no faults are injected any more
STRANGER = ids.server_name(ids.server_label("maze", "of-another-installation"), 1)


@dataclass(repr=False)
class Message:
    """One message in a queue."""

    number: int
    queue: str
    body: dict[str, Any] = field(repr=False)
    visible: datetime = field(repr=False)
    text: str
    failed: int = field(default=0, repr=False)

    def __repr__(self) -> str:
        return f"<{self.number}: {self.text}>"

    def _repr_pretty_(self, printer: Any, cycle: bool) -> None:
        """Print the object in hypothesis's output."""
        printer.text(repr(self))


@dataclass
class Person:
    """A participant, with all tabs that they have opened."""

    user: str
    pages: list[dict[str, Any]] = field(default_factory=list, repr=False)
    page: dict[str, Any] = field(default_factory=dict)  # the last page that came

    @property
    def forms(self) -> list[str]:
        """The steps that they can answer, also from an old tab."""
        return list(dict.fromkeys(str(page["step"]) for page in self.pages if "ticket" in page))

    @property
    def saw_the_game(self) -> bool:
        return any("state" in page for page in self.pages)


SECRET = Secret("0" * 64)


class World:
    """The installation, its participants, and resources of others, which must not change."""

    def __init__(self, project: Project, users: Sequence[str] = ("alice", "bob", "carol")) -> None:
        self.project = project
        self.story: list[str] = []
        self.listener: Callable[[str], None] = lambda line: None
        self.wrong: list[str] = []  # violations that were noticed while they happened
        self.queued: list[Message] = []
        self.in_flight: list[Message] = []
        self.done: list[Message] = []
        self.dead: list[Message] = []
        self.kept: dict[str, bytes] = {}  # answers that participants have seen as stored
        self.given: dict[str, str] = {}  # warm servers by name, and the label of the participant who has or had it
        # Labels of erased participants, whose next servers have the names of the erased ones.
        self.erased: set[str] = set()
        self.unheard: set[str] = set()  # labels of servers about which a message was lost
        self.lost = 0  # the number of lost messages
        self.calm = True  # whether no fault has occurred so far
        # Labels of servers that an interrupted command of the administrator's has stopped only partly.
        self.excused: set[str] = set()
        self._numbers = itertools.count(1)
        self._labels = {ids.server_label(project.id, user): user for user in users}
        self.people = {user: Person(user) for user in users}
        self.account = Account(self.send, self.tell, self.who, self._call)
        self.functions = Functions(self.account.now, self.tell)
        self.functions.platform = self.account
        self.functions.watch = self._watch
        self.functions.disturbed = self._disturbed
        self._listed: set[str] = set()  # the resources that the running sweep has listed
        self._run: set[str] = set()  # the listed tasks that ran
        self.register(project)
        for file, source in PAGES.items():
            self.account.put(step_key(project.id, file), source.encode())
        self._strangers()

    def _call(self, action: str, given: Sequence[Any], effect: Callable[[], Any]) -> Any:
        return self.functions.call(action, given, effect)

    def _disturbed(self) -> None:
        self.calm = False

    def register(self, project: Project, heard: bool = True) -> None:
        """Put the project on the master list, as another version. `heard`: its warm servers are adapted at once."""
        entry = msgspec.structs.replace(project, version=str(next(self._numbers)), salt="s", secret="")
        self.project = msgspec.structs.replace(entry, secret=SECRET.project_secret(entry))
        self.account.put(KEY, to_json(SECRET))
        self.account.put(MASTER_LIST, to_json(MasterList([entry])))
        if project.warm_servers and heard:
            self.send("start", to_message(KeepWarm(project.id)))

    def tell(self, line: str) -> None:
        """Add one line to the story."""
        line = f"{self.account.now():%H:%M:%S} {line}"
        self.story.append(line)
        self.listener(line)

    def who(self, name: str) -> str:
        """Return a server's name in words."""
        label, dash, rest = name.partition("-")
        return self._labels.get(label, label) + dash + rest

    def _whose(self, user_id: str) -> str:
        """Return a participant, or a warm server by its number."""
        if not ids.is_warm_id(user_id):
            return user_id
        label = ids.server_label(self.project.id, user_id)
        return self._labels.setdefault(label, f"warm{len(self._labels)}")

    # State

    @property
    def tasks(self) -> list[Task]:
        return [task for task in self.account.fleet.tasks.values() if task.name != STRANGER]

    def records(self) -> list[Server]:
        """Return all servers' records."""
        kept = self.account.kept
        return [from_json(kept[key][0], Server) for key in sorted(kept) if key.startswith("_servers/")]

    def record(self, label: str) -> Server | None:
        found = self.account.kept.get(server.key(label))
        return from_json(found[0], Server) if found else None

    def record_of(self, user: str) -> Server | None:
        """Return the record of the server on which the participant plays."""
        return self.record(ids.server_label(self.project.id, user))

    def owner(self, name: str) -> Server | None:
        """Return the record that owns this resource name: the server's own, or after a handover the participant's."""
        record = self.record((ids.parse_server_name(name) or ("", 0))[0])
        heir = self.record(record.assigned_to) if record and record.assigned_to else None
        return heir if heir and heir.name == name else record

    def handovers(self) -> dict[str, Handover]:
        """Return the handovers, by the warm servers' names."""
        prefix, kept = handovers_folder(self.project.id), self.account.kept
        found = {key.removeprefix(prefix).removesuffix(".json"): key for key in kept if key.startswith(prefix)}
        return {name: handover.parse(kept[key][0]) for name, key in found.items()}

    def player(self, task: Task) -> str:
        """Who may play on the task; empty for a warm server that is not assigned."""
        told = self.handovers().get(task.name)
        return task.user or (told.user_id if told else "")

    def pool(self) -> Pool:
        found = self.account.kept.get(pool_key(self.project.id))
        return from_json(found[0], Pool) if found else Pool()

    def left(self) -> dict[str, list[str]]:
        """Resources and documents that are left, by kind."""
        account = self.account
        return {
            "tasks": [self.who(task.name) for task in self.tasks if task.last != "STOPPED"],
            "names": [self.who(name) for name in account.zone.records if name not in self.strangers["names"]],
            "timers": [self.who(name) for name in account.due if name not in self.strangers["timers"]],
            "clusters": [self.who(n) for n in account.fleet.own_clusters if n not in self.strangers["clusters"]],
            "slots": [
                self.who(label)
                for key in account.kept
                if key.startswith("_slots/")
                for label in json.loads(account.kept[key][0]).get("slots", {})
            ],
            "open records": [self.who(record.name) for record in self.records() if not record.is_closed],
            "handovers": [self.who(name) for name in self.handovers()],
            "warm servers": [self._whose(id) for id in self.pool().warm_servers],
            "dead letters": [str(message) for message in self.dead if not self._hopeless(message)],
        }

    def _hopeless(self, message: Message) -> bool:
        """Return whether an event needs one that was lost, or is from before an erasure and names a new server."""
        name = str(message.body.get("detail", {}).get("startedBy", ""))
        return bool(name) and (self.lost > 0 or name.partition("-")[0] in self.erased)

    def _strangers(self) -> None:
        """Make resources of others in the account; some have names like ours."""
        account = self.account
        account.fleet.run(TaskRequest(STRANGER, "d", "hippodrome", 1, 2, {}))
        names = [DnsRecord(f"{STRANGER}.example.org", "192.0.2.1"), DnsRecord("www.example.org", "192.0.2.2")]
        account.zone.change(add=names)
        account.zone.settle()
        account.fleet.own_clusters.update((STRANGER, "production"))
        for timer in (STRANGER, "backup-nightly"):
            account.due[timer] = (account.now() + timedelta(days=30), {})
        self.strangers: dict[str, set[str]] = {
            "names": {name.name for name in names},
            "clusters": set(account.fleet.own_clusters),
            "timers": set(account.due),
        }

    # Messages

    def send(self, queue: str, body: Mapping[str, Any], seconds: float = 0) -> None:
        """Put a message into a queue."""
        visible = self.account.now() + timedelta(seconds=seconds)
        self.queued.append(Message(next(self._numbers), queue, dict(body), visible, self._describe(queue, body)))

    def visible(self, queue: str | None = None) -> list[Message]:
        """Return the messages that may be delivered now."""
        now = self.account.now()
        return [message for message in self.queued if message.visible <= now and queue in (None, message.queue)]

    def repeat(self, message: Message) -> None:
        """Deliver the message once more later, as SQS may do, even if it is being handled or was handled."""
        copy = Message(next(self._numbers), message.queue, message.body, self.account.now(), message.text + ", again")
        self.queued.append(copy)

    def lose(self, message: Message) -> None:
        """Remove the message: it never arrives."""
        self.tell(f"lost: {message.text}")
        self.queued.remove(message)
        self.lost += 1
        self.calm = False
        body = message.body
        names = [str(body["detail"]["startedBy"])] if "detail" in body else []
        labels = [(self.owner(name) or self.record(name.partition("-")[0])) for name in names]
        self.unheard |= {record.label for record in labels if record}
        self.unheard |= {one["label"] for one in body.get("servers", ())}
        if "userId" in body:
            self.unheard.add(ids.server_label(self.project.id, body["userId"]))

    def deliver(self, batch: Sequence[Message], fault: FaultAt | None = None) -> None:
        """Hand messages of one queue to its function."""
        queue = batch[0].queue
        for message in batch:
            self.queued.remove(message)
            self.in_flight.append(message)
        event = aws_events.queue_event([m.body for m in batch], [str(m.number) for m in batch])
        about = "; ".join(message.text for message in batch)
        self.tell(f"{queue} queue: {about}")
        self.functions.invoke(queue, about, partial(QUEUES[queue], event, None), partial(self._delivered, batch), fault)

    def deliver_all(self, queue: str) -> None:
        """Deliver each message of a queue by itself."""
        for message in self.visible(queue):
            self.deliver([message])

    def go_on(self) -> None:
        """The usual course: servers that were asked for run and become ready."""
        self.deliver_all("start")
        self.deliver_all("start")  # the messages that the first ones have sent
        self.move_all()
        self.deliver_all("tasks")
        self.account.zone.settle()
        self.wait(20)
        self.deliver_all("tasks")

    def _delivered(self, batch: Sequence[Message], invocation: Invocation) -> None:
        failed = {str(message.number) for message in batch}
        if invocation.well:
            failed = {one["itemIdentifier"] for one in invocation.answer["batchItemFailures"]}
        elif not isinstance(invocation.error, Crash):
            self.tell(f"{invocation.function} raised {type(invocation.error).__name__}")
        for message in batch:
            self.in_flight.remove(message)
            if str(message.number) in failed:
                message.failed += 1
                self.queued.append(message)
                self.tell(f"comes again: {message}")
            else:
                self.done = [*self.done[-30:], message]

    def pending(self, record: Server) -> bool:
        """Return whether a queued message or a running function will still change this server."""
        label = record.label
        if any(self._concerns(message, record) for message in [*self.queued, *self.in_flight]):
            return True
        return any(i.function in ("sweep", "administrator") for i in self.functions.waiting) or label in (
            self.excused | self.unheard
        )

    def _concerns(self, message: Message, record: Server) -> bool:
        body = message.body
        if "keepWarm" in body:
            return False
        if message.queue != "tasks":
            same = (body["projectId"], body["userId"]) == (record.project_id, record.user_id)
            return same and body.get("attempt") in (None, record.attempt, *([1] if message.queue == "start" else []))
        if "detail" in body:
            return bool(body["detail"]["startedBy"] == record.name)
        return any((one["label"], one["attempt"]) == (record.label, record.attempt) for one in body["servers"])

    def _describe(self, queue: str, body: Mapping[str, Any]) -> str:
        if "keepWarm" in body:
            return "keep servers warm"
        if queue != "tasks":
            attempt = f"-{body['attempt']}" if body.get("attempt") else ""
            reason = f" ({body['reason']})" if body.get("reason", "stopped") != "stopped" else ""
            return f"{queue} {self._whose(body['userId'])}{attempt}{reason}"
        if "detail" in body:
            detail = body["detail"]
            told = ", to stop" if (detail["lastStatus"], detail["desiredStatus"]) == ("RUNNING", "STOPPED") else ""
            number = int(detail["taskArn"].rpartition("/")[2], 16)
            return f"{detail['lastStatus']}{told} task {number} of {self.who(detail['startedBy'])}"
        servers = ", ".join(self.who(ids.server_name(one["label"], one["attempt"])) for one in body["servers"])
        return f"{body['change'] or 'in sync'}? {servers}"

    # Participants

    def request(self, user: str, method: str, fields: Mapping[str, str] | None = None, **query: str) -> dict[str, Any]:
        """Return the HTTP API's event for a program's request."""
        return aws_events.program_event(method, {"projectId": self.project.id, "userId": user, **query}, fields or {})

    def ask(
        self,
        user: str,
        method: str = "GET",
        fields: Mapping[str, str] | None = None,
        fault: FaultAt | None = None,
        **query: str,
    ) -> dict[str, Any]:
        """Make a participant's request; the page if it comes at once, else {}."""
        came: list[dict[str, Any]] = []
        act = partial(next_step.handler, self.request(user, method, fields, **query), None)
        about = " ".join([user, method, *query, *(f"{k}={v}" for k, v in (fields or {}).items() if "ticket" not in k)])

        def done(invocation: Invocation) -> None:
            came.append(self._came(user, dict(fields or {}), invocation))

        self.functions.invoke("next_step", about, act, done, fault)
        return came[0] if came else {}

    def _came(self, user: str, fields: Mapping[str, str], invocation: Invocation) -> dict[str, Any]:
        """Take the answer as the page that the browser shows; a page that does not come changes nothing."""
        if not invocation.well or invocation.answer["statusCode"] >= 500:
            self.tell(f"{user} sees no page")
            return {}
        page = json.loads(invocation.answer["body"] or "{}")
        page.pop("css", None)
        person = self.people[user]
        person.page = page
        if "page" in page and page not in person.pages:
            person.pages.append(page)
        state = f", {page['state']} {page.get('reason') or ''}" if "state" in page else ""
        self.tell(f"{user} sees {page.get('message') or 'step ' + str(page.get('step')) + state}")
        step = fields.get("hippodrome-step")
        shown = page.get("step")  # a message page, such as that of a closed study, has none
        if "answer" in fields and page.get("page") and shown not in (None, step):
            key = answer_key(self.project.id, user, str(step))
            if key not in self.account.kept:
                self.wrong.append(f"{user} was led on from step {step}, but the answer is not stored")
        return page

    def answer(self, user: str, step: str, word: str = "yes", fault: FaultAt | None = None) -> dict[str, Any]:
        """Send a step's form."""
        ticket = ids.ticket(self.project.secret, user, step)
        fields = {"hippodrome-step": step, "hippodrome-ticket": ticket, "answer": word}
        return self.ask(user, "POST", fields, fault)

    def restart(self, user: str, fault: FaultAt | None = None) -> dict[str, Any]:
        """Press the button of the game page."""
        game = self.project.game_steps[0]
        ticket = ids.ticket(self.project.secret, user, game)
        fields = {"hippodrome-step": game, "hippodrome-ticket": ticket, "hippodrome-action": "restart"}
        return self.ask(user, "POST", fields, fault)

    def relay(self, which: str, user: str, delay: int = 0, fault: FaultAt | None = None) -> None:
        """Make a request to one of the relays, with the proof of the first page."""
        step = self.project.steps[0].key
        fields = {"hippodrome-step": step, "hippodrome-ticket": ids.ticket(self.project.secret, user, step)}
        event = self.request(user, "POST", {**fields, **({"delay": str(delay)} if delay else {})})
        self.functions.invoke(
            "relay", f"{which} {user}", partial(RELAYS[which], event, None), lambda invocation: None, fault
        )

    def moving(self) -> list[Task]:
        """Tasks that are about to run or to stop."""
        return [t for t in self.tasks if t.last == "PROVISIONING" or (t.last != "STOPPED" and not t.alive)]

    def move_all(self) -> list[Task]:
        """Let all of them go on; these tasks."""
        moving = self.moving()
        for task in moving:
            self.account.fleet.go_on(task)
        return moving

    def played(self, task: Task) -> None:
        """Let the trial store its answer."""
        step = self.project.game_steps[0]
        user = self.player(task)
        key = answer_key(self.project.id, user, step)
        if key not in self.account.kept:
            record = {"step": step, "page": "game", "answers": {"score": 10}, "schema": 1}
            self.account.put(key, json.dumps(record).encode())
            self.tell(f"{user} has played")

    # Functions without a queue, and people with rights

    def sweep(self, fault: FaultAt | None = None) -> None:
        """Run a sweep."""
        self.functions.invoke("sweep", "", partial(sweep.handler, {}, None), self._swept, fault)

    def _swept(self, invocation: Invocation) -> None:
        if invocation.well and any(invocation.answer.values()):
            done = ", ".join(f"{count} {what}" for what, count in invocation.answer.items() if count)
            self.tell(f"sweep: {done}")
            if self.calm and invocation.answer["names"]:
                self.wrong.append("sweep: nothing has gone wrong, and there are names that were left over")

    def stop_all(self, fault: FaultAt | None = None) -> None:
        """Stop all open servers at once from the administrator's machine, as `hippodrome stop` does."""
        self.calm = False
        wanted = [r for r in self.records() if not r.is_closed]
        stops = [StopServer(r.project_id, r.user_id, r.attempt, Reason.STOPPED) for r in wanted]

        def done(invocation: Invocation) -> None:
            again = stops if not invocation.well else invocation.answer
            self.excused |= {ids.server_label(stop.project_id, stop.user_id) for stop in again}

        self.functions.invoke("administrator", "stop all", lambda: installed.shared(Servers).stop(stops), done, fault)

    def may_erase(self, user: str) -> bool:
        """Return whether `hippodrome erase` may begin.

        No message of the participant is being handled, no function waits, and listings show all tasks.
        """
        busy = any(m.body.get("userId") == user for m in self.in_flight) or bool(self.functions.waiting)
        now = self.account.now()
        return not busy and all(task.listed <= now for task in self.tasks)

    def erase(self, user: str) -> None:
        """Erase the participant, as `hippodrome erase` does when it is not interrupted."""
        self.tell(f"{user} is erased")
        self.calm = False
        account, label = self.account, ids.server_label(self.project.id, user)
        record = self.record(label)
        had = {run.warm_server_name for run in (record, *record.earlier) if run.warm_server_name} if record else set()
        if record and not record.is_closed:
            Servers(account).stop([StopServer(self.project.id, user, None, Reason.STOPPED)])

        def theirs(name: str) -> bool:
            return name.startswith(label) or name.split(".", maxsplit=1)[0].removesuffix("-delay") in had

        for task in [task for task in self.tasks if theirs(task.name)]:
            account.fleet.stop(task.arn, "", f"{messages.STOP_REASON_PREFIX} stopped")
            while task.last != "STOPPED":
                account.fleet.go_on(task)
        for timer in [name for name in account.due if theirs(name)]:
            del account.due[timer]
        for name in [name for name in account.zone.records if theirs(name)]:
            del account.zone.records[name]
        account.fleet.own_clusters = {name for name in account.fleet.own_clusters if not theirs(name)}
        release_participant(account.documents, self.project.id, user)
        told = [handover_key(self.project.id, name) for name in had]
        told += [server.key(name.partition("-")[0]) for name in had]
        for key in [*account.kept]:
            if key.startswith(participant_folder(self.project.id, user)) or key in (server.key(label), *told):
                del account.kept[key]
                self.kept.pop(key, None)
        self.people[user] = Person(user)
        self.erased |= {label, *(name.partition("-")[0] for name in had)}

    def open(self, live: bool, heard: bool = True) -> None:
        """Register the project again, open or closed."""
        self.tell(f"the study is registered anew, {'open' if live else 'closed'}")
        self.register(msgspec.structs.replace(self.project, live=live), heard)

    # Time

    def wait(self, seconds: float) -> None:
        """Let time pass; end functions that run too long."""
        self.account.wait(seconds=seconds)
        self.functions.time_out()

    def timers_due(self) -> list[str]:
        now = self.account.now()
        return sorted(name for name, (at, _) in self.account.due.items() if at <= now)

    def fire(self, name: str) -> None:
        """Fire a timer, and remove it."""
        _, body = self.account.due.pop(name)
        self.tell(f"the timer of {self.who(name)} fires")
        self.send("stop", body)

    # Resources that a sweep removes

    def _watch(self, invocation: Invocation, action: str, given: Sequence[Any]) -> None:
        """Check a resource that a sweep is about to remove."""
        if invocation.function != "sweep":
            return
        if action == "tasks.list":
            there = [task for task in self.tasks if task.alive and task.listed <= self.account.now()]
            self._listed = {task.name for task in there}
            self._run = {task.name for task in there if task.last == "RUNNING"}
        elif action == "tasks.stop":
            found = self.account.fleet.tasks.get(given[0])
            self._judge(action, [found.name] if found else [])
        elif action == "dns.change":
            self._judge(action, [name.name.split(".")[0] for name in given[0]])
        elif action in ("timers.cancel", "tasks.delete_cluster"):
            self._judge(action, [given[0].removesuffix("-delay")])

    def _judge(self, action: str, names: Sequence[str]) -> None:
        for name in names:
            record, now = self.owner(name), self.account.now()
            if record is None:
                self.wrong.append(f"sweep: {action} of {name}, which is not ours")
            elif record.name == name and not record.is_closed:
                overdue = now > record.deadline + timedelta(minutes=5)
                lost = now > record.requested + timedelta(minutes=10) and name not in self._listed
                hopeless = now > record.requested + timedelta(minutes=20) and name not in self._run
                hopeless = hopeless and record.state is ServerState.STARTING
                if not overdue and not lost and not hopeless and record.state is not ServerState.DRAINING:
                    self.wrong.append(f"sweep: {action} of {self.who(name)}, which is {record.state}")
