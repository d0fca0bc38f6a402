"""`hippodrome status`: shows participants by step, what runs, and what it costs."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Mapping
from typing import Annotated, Any

import typer
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.formatting import count, duration
from hippodrome.console.problem import Exit, Problem
from hippodrome.console.program import as_typed
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server
from hippodrome.deployment.aws.account import Installation, find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.core import options, participants
from hippodrome.deployment.core.study_selection import one_or_all
from hippodrome.deployment.operate.snapshot import InstallationMonitor, Snapshot
from hippodrome.deployment.stack import states

EVERY = 5.0  # seconds between two looks
MAX_SERVERS = 20  # servers that are shown one by one, the oldest first


def command(
    study: options.Study = None,
    *,
    every: options.All = False,
    watch: Annotated[bool, typer.Option("--watch", "-w", help="Look again every few seconds, until Ctrl-C.")] = False,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Show participants by step, servers by state, queues, certificate, alarms, and today's cost, of a study or --all.

    It shows counts and no ids; servers have their names, which are hashes. It reads listings, the servers' records and
    the number of a session's members, never a participant's documents.
    """
    if watch and as_json:
        raise Problem("--watch and --json do not go together.", "For scripts, ask again: `status --json`.")
    project = one_or_all(study, every)
    account = open_account(profile, region)
    installation = find_installation(account, stack)
    if project:
        participants.choose(participants.registered_projects(account.platform(installation).documents), project)
    watcher = InstallationMonitor(account, installation, project)
    if watch:
        _watch(watcher, installation)
        return Exit.DONE
    with screen.err.status("Looking …") as status:
        look = watcher.look(status.update)
    if as_json:
        screen.result_json(as_data(look, installation))
    else:
        screen.out.print(picture(look, installation))
    return Exit.DONE


def _watch(watcher: InstallationMonitor, installation: Installation) -> None:
    """Look and show until Ctrl-C. The pause between two looks is `EVERY`, or a look's own time if that is longer."""
    console = Console(highlight=False)  # unlike `screen.out` it breaks lines, which Live would cut off
    try:
        with contextlib.ExitStack() as stack:
            live = None
            if console.is_terminal:
                live = stack.enter_context(Live(Text("Looking …"), console=console, auto_refresh=False, screen=True))
            while True:
                began = time.monotonic()
                try:
                    shown = picture(watcher.look(), installation)
                except Problem as problem:  # AWS was busy for a moment, or the project is gone
                    shown = Group(Text(f"! {problem}", style="yellow"))
                if live:
                    live.update(shown, refresh=True)
                else:
                    console.print(shown, "")
                time.sleep(max(EVERY, time.monotonic() - began))
    except KeyboardInterrupt:
        return


# For scripts


def as_data(look: Snapshot, installation: Installation) -> dict[str, Any]:
    """Return the snapshot as JSON data."""
    certificate = look.certificate
    return {
        "stack": installation.stack,
        "region": installation.region,
        "status": installation.status,
        "site": installation["Site"],
        "at": look.at,
        "projects": [
            {
                "id": project.id,
                "name": project.name,
                "live": project.live,
                "participants": counts.participants,
                "maxParticipants": project.max_participants,
                "finished": counts.finished,
                "arrivedToday": counts.arrived_today,
                "lastArrival": counts.last_arrival,
                "warmServers": _warm(look, project),
                "steps": [
                    {"step": step.key, "page": step.page, "here": counts.by_step[step.key]} for step in project.steps
                ],
            }
            for project, counts in look.projects
        ],
        "servers": {
            "byState": dict(Counter(str(server.state) for server in look.servers)),
            "open": [_server(server, look) for server in look.servers],
            "tasks": look.tasks,
            "closedToday": dict(look.closed_today),
            "failed": [
                {
                    "project": failure.project,
                    "cause": failure.cause,
                    "meaning": failure.cause.sentence,
                    "matters": failure.matters,
                    "servers": failure.servers,
                    "last": failure.last,
                    "lastServer": failure.server,
                }
                for failure in look.failures
            ],
        },
        "spentToday": look.spent.usd.as_json(),
        "queues": [
            {"name": q.name, "waiting": q.waiting, "inFlight": q.in_flight, "delayed": q.delayed, "deadLetters": q.dead}
            for q in look.queues
        ],
        "certificate": certificate
        and {
            "names": certificate.names,
            "expires": certificate.expires,
            "daysLeft": certificate.days_left,
            "staging": certificate.staging,
        },
        "alarms": look.alarms,
        "problems": look.problems,
    }


def _warm(look: Snapshot, project: Project) -> Mapping[str, int]:
    found = look.warm(project.id)
    warm_servers = project.warm_servers if project.live else 0
    return {"wanted": warm_servers, "ready": found.ready, "there": found.there, "assignedToday": found.assigned_today}


def _server(server: Server, look: Snapshot) -> Mapping[str, Any]:
    now = look.at
    of_session = {"session": True, "members": look.members.get(server.name, 0)} if server.is_of_session else {}
    return {
        "server": server.name,
        "project": server.project_id,
        "state": server.state,
        "attempt": server.attempt,
        "spot": server.spot,
        "warm": server.is_warm_server,
        "ageMinutes": round((now - server.requested).total_seconds() / 60, 1),
        "minutesLeft": round((server.deadline - now).total_seconds() / 60, 1),
        **of_session,
    }


# For people


def picture(look: Snapshot, installation: Installation) -> RenderableType:
    """Draw the snapshot as tables and lines."""
    parts: list[RenderableType] = [
        _line(f"{installation.stack} in {installation.region}, {look.at:%Y-%m-%d %H:%M:%S} UTC  {installation['Site']}")
    ]
    if installation.status not in states.COMPLETE:
        parts.append(_line(f"! The stack is in {installation.status}.", "yellow"))
    for part in (_projects(look), _servers(look), _failures(look), _others(look, installation.has_domain)):
        parts += [Text(""), *part] if part else []
    parts += [_line(f"! No {part}: {why}", "yellow") for part, why in look.problems.items()]
    return Group(*parts)


def _line(text: str, style: str = "") -> Text:
    return Text(as_typed(text), style=style)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _projects(look: Snapshot) -> list[RenderableType]:
    if "projects" in look.problems:
        return []
    if not look.projects:
        return [_line("No project is registered yet: `hippodrome register` does it.")]
    table = _table("project", "live", "participants", "today", "finished", "where they are")
    for project, counts in look.projects:
        here = [(step, counts.by_step[step.key]) for step in project.steps[:-1]]
        limit = f" of {project.max_participants:,}" if project.max_participants is not None else ""
        table.add_row(
            project.id,
            Text("live", style="green") if project.live else Text("closed", style="dim"),
            f"{counts.participants:,}{limit}",
            f"{counts.arrived_today:,}",
            f"{counts.finished:,}",
            Text(", ".join(f"{step.key} {step.page}: {number:,}" for step, number in here if number)),
        )
    return [table]


def _servers(look: Snapshot) -> list[RenderableType]:
    if "servers" in look.problems:
        return []
    by_state = Counter(str(server.state) for server in look.servers)
    counts = ", ".join(f"{count:,} {state}" for state, count in sorted(by_state.items())) or "none"
    warm = sum(server.is_warm_server for server in look.servers)
    counts += f", {warm:,} of them warm" if warm else ""
    sessions = sum(server.is_of_session for server in look.servers)
    members = count(sum(look.members.values()), "member")
    counts += f", {sessions:,} of sessions with {members}" if sessions else ""
    tasks = "" if look.tasks is None else f" ({look.tasks:,} tasks on ECS)"
    closed = ", ".join(f"{number:,} {reason}" for reason, number in look.closed_today.most_common())
    parts: list[RenderableType] = [
        _line(f"Servers: {counts}{tasks}." + (f" Closed today: {closed}." if closed else ""), "bold"),
        *_warm_lines(look),
    ]
    if look.servers:
        table = _table("server", "project", "state", "age", "left", "")
        for server in look.servers[:MAX_SERVERS]:
            left = (server.deadline - look.at).total_seconds()
            table.add_row(
                server.name,
                server.project_id,
                str(server.state),
                duration((look.at - server.requested).total_seconds()),
                duration(left) if left >= 0 else Text("overdue", style="red"),
                Text(_kind(server, look.members.get(server.name)), style="dim"),
            )
        parts.append(table)
    if len(look.servers) > MAX_SERVERS:
        parts.append(_line(f"… and {len(look.servers) - MAX_SERVERS:,} more (--json has them all).", "dim"))
    spent = look.spent.usd
    cost = f"Today's servers: about ${spent.likely:,.2f} (${spent.low:,.2f} to ${spent.high:,.2f}), list prices."
    return [*parts, _line(cost)]


def _failures(look: Snapshot) -> list[RenderableType]:
    """Tell why servers have failed in the last 24 hours. Failures that only AWS can prevent share a line."""
    lines: list[RenderableType] = []
    for failure in look.failures:
        if failure.matters:
            number = count(failure.servers, "server")
            text = f"! {failure.project}: {number} failed, the last {failure.last:%H:%M} UTC ({failure.server}). "
            lines.append(_line(text + failure.cause.sentence, "red"))
    of_aws = ", ".join(f"{f.servers:,} {f.cause} ({f.project})" for f in look.failures if not f.matters)
    if of_aws:
        lines.append(_line(f"Lost in the last 24 hours by no fault of yours, and replaced where AWS could: {of_aws}."))
    return lines


def _warm_lines(look: Snapshot) -> list[RenderableType]:
    """Tell how many warm servers are ready, for each project that keeps warm servers or still has some."""
    lines: list[RenderableType] = []
    for project, _ in look.projects:
        warm = _warm(look, project)
        if warm["wanted"]:
            assigned = f"; {warm['assignedToday']:,} assigned today" if warm["assignedToday"] else ""
            lines.append(_line(f"{project.id}: {warm['ready']} of {warm['wanted']} warm servers ready{assigned}."))
        elif warm["there"]:
            lines.append(_line(f"{project.id}: {count(warm['there'], 'warm server')} on the way out."))
    return lines


def _kind(server: Server, members: int | None) -> str:
    kind = "Spot" if server.spot else "on demand"
    if server.is_warm_server:
        return f"{kind}, warm"
    if server.is_of_session:
        kind += ", started ahead" if members is None else f", session of {members}"
    return kind if server.attempt == 1 else f"{kind}, attempt {server.attempt}"


def _others(look: Snapshot, has_domain: bool) -> list[RenderableType]:
    """Draw the lines on queues, certificate and alarms."""
    lines: list[RenderableType] = []
    if "queues" not in look.problems:
        waiting = [f"{q.name} {number:,}" for q in look.queues if not q.dead and (number := q.waiting + q.in_flight)]
        lines.append(_line(f"Queues: {', '.join(waiting) or 'empty'}."))
    if dead := sum(queue.waiting for queue in look.queues if queue.dead):
        messages = "message could" if dead == 1 else "messages could"
        lines.append(
            _line(f"! {dead:,} {messages} not be dealt with: `hippodrome logs --all --errors` says why.", "red")
        )
    if certificate := look.certificate:
        text = f"Certificate: {certificate.days_left} days left ({', '.join(certificate.names)})."
        bad = certificate.overdue(look.at) or certificate.staging
        lines.append(
            _line(text + (" STAGING: browsers refuse it." if certificate.staging else ""), "red" if bad else "")
        )
    elif "certificate" not in look.problems and has_domain:
        order = "`hippodrome certificate --production` orders one."
        lines.append(_line(f"! No certificate: servers cannot be reached. {order}", "red"))
    if look.alarms:
        lines.append(_line(f"! Alarms: {', '.join(sorted(look.alarms))}.", "red"))
    elif "alarms" not in look.problems:
        lines.append(_line("Alarms: none fires."))
    return lines
