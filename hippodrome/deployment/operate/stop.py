"""`hippodrome stop`: stops every server, now."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field
from typing import Annotated

import typer

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws import AwsPlatform
from hippodrome.control.model.messages import STOP_REASON_PREFIX, StopServer
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Reason, Server
from hippodrome.control.ports import RunningTask
from hippodrome.control.servers import resources
from hippodrome.control.servers.leftovers import Scope, leftovers
from hippodrome.control.servers.resources import Resources
from hippodrome.deployment.aws.account import find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import explain, options, participants
from hippodrome.deployment.core.captured_log import functions_log
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.core.stages import Executor, PlanStep, step
from hippodrome.deployment.core.study_selection import one_or_all

WAIT = 180  # seconds: a task may take its stopTimeout of 120 to store its recordings
TOGETHER = 25  # servers stopped by one call: their DNS records go in one change of the zone
EVERYTHING = Scope(without_record=True)
AT_ONCE = 4  # such calls at the same time; Route 53 takes 10 requests a second


@dataclass
class FoundServers:
    """The results of one look: open servers, resources that no open server owns, and tasks that are stopping."""

    servers: list[Server] = field(default_factory=list)
    leftovers: Resources = field(default_factory=Resources)
    draining: list[RunningTask] = field(default_factory=list)  # tasks that were told to stop and store their recordings

    @property
    def to_do(self) -> bool:
        """Whether a server or a resource was found that has to be stopped or removed."""
        return bool(self.servers or self.leftovers)

    def __bool__(self) -> bool:
        return self.to_do or bool(self.draining)

    def counts(self) -> dict[str, int]:
        """Return how many servers, resources and stopping tasks were found, by kind."""
        return {"servers": len(self.servers), **self.leftovers.counts(), "draining": len(self.draining)}


class Stopper:
    """Stops all servers, or those in a scope: of a project, or of a participant; looks until nothing of them is left.

    It does the work of the function `stop_server` on this machine, so that it works even if queues or functions do not.
    Several commands may do this at the same time, and while the functions stop servers, too.
    """

    def __init__(self, platform: AwsPlatform, scope: Scope = EVERYTHING, executor: Executor | None = None) -> None:
        from hippodrome.control.servers.services import ServerServices  # noqa: PLC0415 - imports Powertools, which other commands do without
        from hippodrome.control.servers.termination import Termination  # noqa: PLC0415 - the same

        self._platform = platform
        self._scope = scope
        self._executor = executor or Executor()
        self._termination = Termination(ServerServices(platform))
        self.records = Records(platform.documents)
        self.errors: dict[str, None] = {}  # sentences, each once
        self.stopped: set[str] = set()  # names of servers that were stopped

    def run(self, wait: float, advance: Callable[[int], None] = lambda _: None) -> FoundServers:
        """Stop servers until a look finds nothing, or `wait` seconds are over. Return what the last look found."""
        return self._executor.converge(
            self.look, lambda servers: self.plan(servers, advance), note=self._note, seconds=wait
        )

    def look(self) -> FoundServers:
        """Find servers and resources. Changes nothing.

        Reads resources first and then the records, as the sweep does.
        """
        platform = self._platform
        found = resources.list_resources(platform)
        theirs = filter(self._scope.erases, found.clusters)
        draining = list(platform.tasks.draining(found.cluster, *theirs))
        owners = self.records.owners([*found.names(), *(task.name for task in draining)])
        by_label = {record.label: record for record in owners.values()}
        for record in self._open():
            by_label.setdefault(record.label, record)
        return FoundServers(
            sorted(
                (record for record in by_label.values() if not record.is_closed and self._covers(record.name, record)),
                key=lambda record: record.requested,
            ),
            leftovers(found, owners, self._scope),
            [task for task in draining if self._covers(task.name, owners.get(task.name))],
        )

    def _open(self) -> Iterable[Server]:
        if self._scope.labels:
            return self.records.read(self._scope.labels).values()
        return self.records.open(self._platform.settings.max_runtime, self._platform.now())

    def _covers(self, name: str, owner: Server | None) -> bool:
        return self._scope.erases(name) if self._scope.labels else self._scope.covers(owner)

    def plan(self, servers: FoundServers, advance: Callable[[int], None] = lambda _: None) -> list[PlanStep]:
        """Plan the steps that stop and remove what was found; empty if only tasks that are stopping are left."""
        from hippodrome.control.servers.dns import delete_dns_records  # noqa: PLC0415 - imports Powertools, which other commands do without

        platform, left = self._platform, servers.leftovers
        reason = f"{STOP_REASON_PREFIX} {Reason.STOPPED}"
        steps = [step(self._stop_servers, servers.servers, advance)] if servers.servers else []
        steps += [step(platform.tasks.stop, task.task, task.cluster, reason) for task in left.tasks]
        steps += [step(delete_dns_records, platform, left.dns_records)] if left.dns_records else []
        steps += [step(platform.timers.cancel, timer) for timer in left.timers]
        # Last, since ECS refuses to delete a cluster while a task in it is ending.
        return steps + [step(platform.tasks.delete_cluster, cluster) for cluster in left.clusters]

    def _stop_servers(self, servers: Sequence[Server], advance: Callable[[int], None]) -> None:
        """Stop the servers in chunks. `Termination` reads each record again and decides by what it finds then."""
        with functions_log() as failures, ThreadPoolExecutor(AT_ONCE) as pool:
            chunks = [servers[at : at + TOGETHER] for at in range(0, len(servers), TOGETHER)]
            for future in as_completed([pool.submit(self._stop_chunk, chunk) for chunk in chunks]):
                try:
                    stopped = future.result()
                except Exception as error:  # noqa: BLE001 - the other servers are stopped all the same
                    self._note(error)
                else:
                    self.stopped.update(stopped)
                    advance(len(stopped))
            self.errors.update(failures.lines)

    def _stop_chunk(self, servers: Sequence[Server]) -> list[str]:
        """Stop servers with one call, and return the names of the servers that are stopped."""
        stops = {
            StopServer(server.project_id, server.user_id, server.attempt, Reason.STOPPED): server.name
            for server in servers
        }
        again = self._termination.stop([*stops])
        return [name for stop, name in stops.items() if stop not in again]

    def _note(self, error: Exception) -> None:
        problem = explain.problem_from(error)
        self.errors[str(problem) if problem else f"{type(error).__name__}: {error}"] = None


def command(
    study: options.Study = None,
    *,
    every: options.All = False,
    wait: Annotated[int, typer.Option("--wait", min=0, help="Seconds to wait until nothing is left.")] = WAIT,
    dry_run: options.DryRun = False,
    yes: options.Yes = False,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Stop every server of a study, or with --all of all studies, and make sure that nothing of them is left.

    A participant who plays loses the present game; all answers, and the recordings up to now, are kept. Their page
    says that the researchers have switched the server off. While the project is live, participants can start
    another server, and warm servers are started again: close the project first, with
    `hippodrome register STUDY --no-live`.
    """
    project = one_or_all(study, every)
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    platform = account.platform(installation)
    live = [p for p in participants.choose(participants.registered_projects(platform.documents), project) if p.live]
    stopper = Stopper(platform, Scope(project_id=project, without_record=True))
    screen.info("Looking for servers …", "dim")
    state = stopper.look()
    if dry_run:
        _show(state, as_json)
        return Exit.CHANGES if state.to_do else Exit.DONE
    if state.to_do:
        if not as_json:
            _show(state, False)
        owner = f"of {project}" if project else "of all projects together"
        warm = sum(record.is_warm_server for record in state.servers)
        servers = count(len(state.servers), "server") + (f" ({warm:,} of them warm)" if warm else "")
        screen.confirm(f"Stop {servers} {owner}? Participants who play there lose the game that is on.", yes)
    with screen.ProgressBars() as progress:
        bar = progress.add_task("Stopping servers", total=len(state.servers))
        remaining = stopper.run(wait, lambda number: progress.advance(bar, number))
    if as_json:
        screen.result_json(
            {"stopped": len(stopper.stopped), "left": remaining.counts(), "errors": list(stopper.errors)}
        )
    if remaining.to_do:
        left = ", ".join(f"{count:,} {what}" for what, count in remaining.counts().items() if count)
        raise Problem(
            f"Not everything is gone: {left}.",
            "Run it again: it goes on from there. Every server's own timer stops it too.",
            list(stopper.errors),
        )
    if stopper.records.unreadable:  # resources of these servers count as owned by no server
        unread = count(stopper.records.unreadable, "record")
        screen.warning(f"{unread} of servers cannot be read; `hippodrome doctor --all` names them.")
    stopped = count(len(stopper.stopped), "server") + (" was" if len(stopper.stopped) == 1 else " were")
    screen.success(f"{stopped} stopped; nothing is left." if stopper.stopped else "Nothing runs.")
    if remaining.draining:
        screen.warning(
            f"{count(len(remaining.draining), 'task')} still saving: they end within two minutes of the stop."
        )
    if live and state.servers:
        screen.warning(f"{_again(live)}; `register --no-live` closes it.")
    return Exit.DONE


def _again(live: Sequence[Project]) -> str:
    """Write a sentence on live projects, whose servers can start again after a stop."""
    warm = [project.id for project in live if project.warm_servers]
    text = f"Live: {', '.join(project.id for project in live)}. Participants can start a server again"
    return text + (f", and {', '.join(warm)} will have warm ones again within five minutes" if warm else "")


def _show(found: FoundServers, as_json: bool) -> None:
    if as_json:
        servers = [
            {
                "server": record.name,
                "project": record.project_id,
                "state": record.state,
                "warm": record.is_warm_server,
                "since": record.requested,
            }
            for record in found.servers
        ]
        screen.result_json({"found": found.counts(), "servers": servers})
        return
    projects = Counter(
        (record.project_id, f"{record.state}, warm" if record.is_warm_server else str(record.state))
        for record in found.servers
    )
    rows = [(project, state, count) for (project, state), count in sorted(projects.items())]
    rows += [("left over", what, count) for what, count in found.counts().items() if count and what != "servers"]
    if rows:
        screen.table(["project", "state", "servers"], rows, right=["servers"])
    else:
        screen.info("Nothing runs.")
