"""`deploy stop`: every server, now."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any

import typer

from console import screen
from console.problem import Exit, Problem
from console.words import count
from deploy.aws.account import STACK, find_installation, open_account
from deploy.core import explain, options, participants
from deploy.core.quiet import functions_log
from deploy.core.server_records import Records
from hippodrome.model import ids, messages
from hippodrome.model.messages import StopServer
from hippodrome.model.project import Project
from hippodrome.model.server import Reason, Server
from hippodrome.ports import DnsRecord, Platform, RunningTask

WAIT = 180  # seconds: a task may take its stopTimeout of 120 to save what it has
PAUSE = 3  # seconds between two looks at what is still there
TOGETHER = 25  # servers let go by one call: their names go in one change of the zone
AT_ONCE = 4  # such calls; Route 53 takes 10 requests a second

Leaving = Callable[[], Sequence[str]]


@dataclass
class Found:
    """What one look found: open servers, and things that no open server owns."""

    servers: list[Server] = field(default_factory=list)
    tasks: list[RunningTask] = field(default_factory=list)
    names: list[DnsRecord] = field(default_factory=list)
    timers: list[str] = field(default_factory=list)
    clusters: list[str] = field(default_factory=list)
    leaving: list[str] = field(default_factory=list)  # told to stop, saving what they have

    @property
    def to_do(self) -> bool:
        """Whether something has not been told to go yet."""
        return bool(self.servers or self.tasks or self.names or self.timers or self.clusters)

    def __bool__(self) -> bool:
        return self.to_do or bool(self.leaving)

    def counts(self) -> dict[str, int]:
        return {
            "servers": len(self.servers),
            "tasks": len(self.tasks),
            "names": len(self.names),
            "timers": len(self.timers),
            "clusters": len(self.clusters),
            "leaving": len(self.leaving),
        }


class Stopper:
    """Lets all servers go, or those of one project, and looks until nothing of them is left.

    It does what the function `stop_server` does, from here, so that it works where queues or functions do not. Any
    number may run at once, beside the functions too.
    """

    def __init__(
        self,
        platform: Platform,
        project_id: str | None = None,
        leaving: Leaving = lambda: (),
        *,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        from hippodrome.servers.service import Servers  # noqa: PLC0415 - imports Powertools, which other commands do without

        self._platform = platform
        self._project_id = project_id
        self._leaving = leaving
        self._clock = clock
        self._sleep = sleep
        self._servers = Servers(platform)
        self._records = Records(platform.documents)
        self._owners: dict[str, Server] = {}  # by the names of things
        self.errors: dict[str, None] = {}  # sentences, each once
        self.stopped: set[str] = set()  # names of servers that were let go

    @property
    def unreadable(self) -> int:
        """How many records of servers could not be read: what those servers have was treated as nobody's."""
        return self._records.unreadable

    def look(self) -> Found:
        """What is there. Resources first and records afterwards, as the sweep does: no start slips through between."""
        platform = self._platform
        tasks = list(platform.tasks.list())
        names = list(platform.dns.list())
        timers = list(platform.timers.list())
        clusters = list(platform.tasks.clusters())
        leaving = list(self._leaving())
        labels = [name.split(".", 1)[0] for name in (record.name for record in names)]
        called = [*(task.name for task in tasks), *labels, *map(_timer_of, timers), *clusters, *leaving]
        self._owners = self._records.owners(called)
        known = {record.label: record for record in self._owners.values()}
        for record in self._records.open(platform.settings.max_runtime, platform.now()):
            known.setdefault(record.label, record)
        return Found(
            servers=sorted(
                (r for r in known.values() if not r.is_closed and self._project_id in (None, r.project_id)),
                key=lambda r: r.requested,
            ),
            tasks=[task for task in tasks if self._ownerless(task.name, ours=True)],
            names=[record for record, label in zip(names, labels, strict=True) if self._ownerless(label)],
            timers=[timer for timer in timers if self._ownerless(_timer_of(timer), ours=True)],
            clusters=[cluster for cluster in clusters if self._ownerless(cluster)],
            leaving=[name for name in leaving if self._wanted(name)],
        )

    def remove(self, found: Found, advance: Callable[[int], None] = lambda _: None) -> None:
        """Let go what was found. What fails is noted in `errors`; the next look finds it again."""
        # The control plane's stop reads each record again and goes by what it finds then.
        stops = [StopServer(r.project_id, r.user_id, r.attempt, Reason.STOPPED) for r in found.servers]
        chunks = [stops[at : at + TOGETHER] for at in range(0, len(stops), TOGETHER)]
        named = {(r.project_id, r.user_id, r.attempt): r.name for r in found.servers}
        with functions_log() as failures, ThreadPoolExecutor(AT_ONCE) as pool:
            going = {pool.submit(self._servers.stop, chunk): chunk for chunk in chunks}
            for future in as_completed(going):
                chunk = going[future]
                try:
                    again = set(future.result())
                except Exception as error:  # noqa: BLE001 - the other servers are stopped all the same
                    self._note(error)
                    again = set(chunk)
                gone = [m for m in chunk if m not in again]
                self.stopped.update(named[m.project_id, m.user_id, m.attempt or 0] for m in gone)
                advance(len(gone))
            self.errors.update(failures.lines)
        self._each(self._leftovers(found))

    def run(self, wait: float, advance: Callable[[int], None] = lambda _: None) -> Found:
        """Look and remove until a look finds nothing, or `wait` seconds are over; what the last look found."""
        end = self._clock() + wait
        found = self.look()
        while found:
            if found.to_do:
                self.remove(found, advance)
                found = self.look()
            if not found or self._clock() >= end:
                break
            self._sleep(PAUSE)
            found = self.look()
        return found

    def _leftovers(self, found: Found) -> Iterator[Callable[[], object]]:
        platform = self._platform
        for task in found.tasks:
            yield partial(platform.tasks.stop, task.task, task.cluster, f"{messages.OUR_STOP} {Reason.STOPPED}")
        if found.names:
            yield partial(platform.dns.change, remove=found.names)
        for timer in found.timers:
            yield partial(platform.timers.cancel, timer)
        for cluster in found.clusters:
            yield partial(platform.tasks.delete_cluster, cluster)

    def _each(self, acts: Iterator[Callable[[], object]]) -> None:
        for act in acts:
            try:
                act()
            except Exception as error:  # noqa: BLE001 - the others go all the same
                self._note(error)

    def _note(self, error: Exception) -> None:
        problem = explain.problem_from(error)
        self.errors[str(problem) if problem else f"{type(error).__name__}: {error}"] = None

    def _ownerless(self, name: str, ours: bool = False) -> bool:
        """Whether a thing of this name is to go though no open server owns it.

        Without a record it may be another installation's, unless it lies where only this one's things are (`ours`).
        """
        parsed = ids.parse_server_name(name)
        if parsed is None:
            return False
        record = self._owners.get(name)
        if record is None:
            return ours and self._project_id is None
        over = record.is_closed if record.name == name else record.attempt >= parsed[1]
        return over and self._project_id in (None, record.project_id)

    def _wanted(self, name: str) -> bool:
        record = self._owners.get(name)
        return self._project_id is None or (record is not None and record.project_id == self._project_id)


def _timer_of(timer: str) -> str:
    """The server that a timer is for; a delayed stop has a timer of its own."""
    return timer.removesuffix("-delay")


def leaving(ecs: Any, cluster: str) -> list[str]:
    """The names of tasks in a cluster that were told to stop and have not ended (DescribeTasks takes 100)."""
    found = []
    for page in ecs.get_paginator("list_tasks").paginate(cluster=cluster, desiredStatus="STOPPED"):
        if page["taskArns"]:
            for task in ecs.describe_tasks(cluster=cluster, tasks=page["taskArns"])["tasks"]:
                if task["lastStatus"] != "STOPPED" and ids.parse_server_name(task.get("startedBy", "")):
                    found.append(task["startedBy"])
    return found


def command(
    *,
    project: options.OneProject = None,
    wait: Annotated[int, typer.Option("--wait", min=0, help="Seconds to wait until nothing is left.")] = WAIT,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Stop every server now, and make sure that nothing of them is left.

    Whoever plays loses the game that is on; what they have answered and the recordings up to now are kept. Their page
    says that those who hold the study have switched the server off. While the project is live they can start another,
    and the servers that it keeps warm are started again: first close it with
    `python -m deploy register FOLDER --no-live`.
    """
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    platform = account.platform(installation)
    live = [p for p in participants.choose(participants.registered(platform.documents), project) if p.live]
    stopper = Stopper(platform, project, partial(leaving, account.client("ecs"), installation["Cluster"]))
    screen.say("Looking for servers …", "dim")
    found = stopper.look()
    if dry_run:
        _show(found, as_json)
        return Exit.CHANGES if found.to_do else Exit.DONE
    if found.to_do:
        _show(found, False) if not as_json else None
        owner = f"of {project}" if project else "of all projects together"
        warm = sum(record.is_warm_server for record in found.servers)
        servers = count(len(found.servers), "server") + (f" ({warm:,} of them warm)" if warm else "")
        screen.confirm(f"Stop {servers} {owner}? Whoever plays there loses the game that is on.", yes)
    with screen.progress() as progress:
        bar = progress.add_task("Stopping servers", total=len(found.servers))
        left = stopper.run(wait, lambda number: progress.advance(bar, number))
    if as_json:
        screen.answer_json({"stopped": len(stopper.stopped), "left": left.counts(), "errors": list(stopper.errors)})
    if left.to_do:
        raise Problem(
            f"Not everything is gone: {_in_words(left.counts())}.",
            "Run it again: it goes on from there. Every server's own timer stops it too.",
            list(stopper.errors),
        )
    if stopper.unreadable:
        unread = count(stopper.unreadable, "record")
        screen.warn(f"{unread} of servers cannot be read; `python -m deploy doctor` names them.")
    stopped = count(len(stopper.stopped), "server") + (" was" if len(stopper.stopped) == 1 else " were")
    screen.done(f"{stopped} stopped; nothing is left." if stopper.stopped else "Nothing runs.")
    if left.leaving:
        screen.warn(f"{count(len(left.leaving), 'task')} still saving: they end within two minutes of the stop.")
    if live and found.servers:
        screen.warn(f"{_again(live)}; `register --no-live` closes it.")
    return Exit.DONE


def _again(live: Sequence[Project]) -> str:
    """What becomes of live projects after a stop."""
    warm = [project.id for project in live if project.warm_servers]
    said = f"Live: {', '.join(project.id for project in live)}. Participants can start a server again"
    return said + (f", and {', '.join(warm)} will have warm ones again within five minutes" if warm else "")


def _show(found: Found, as_json: bool) -> None:
    if as_json:
        screen.answer_json({"found": found.counts(), "servers": [_line(record) for record in found.servers]})
        return
    projects = Counter((record.project_id, _state(record)) for record in found.servers)
    rows = [(project, state, count) for (project, state), count in sorted(projects.items())]
    rows += [("left over", what, count) for what, count in found.counts().items() if count and what != "servers"]
    if rows:
        screen.table(["project", "state", "servers"], rows, right=["servers"])
    else:
        screen.say("Nothing runs.")


def _state(record: Server) -> str:
    return f"{record.state}, warm" if record.is_warm_server else str(record.state)


def _line(record: Server) -> Mapping[str, Any]:
    return {
        "server": record.name,
        "project": record.project_id,
        "state": record.state,
        "warm": record.is_warm_server,
        "since": record.requested,
    }


def _in_words(counts: Mapping[str, int]) -> str:
    return ", ".join(f"{count:,} {what}" for what, count in counts.items() if count)
