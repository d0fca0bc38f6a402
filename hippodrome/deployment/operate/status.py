"""`deploy status`: shows participants by step, what runs, and what it costs."""

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
        Text(f"{installation.stack} in {installation.region}, {look.at:%Y-%m-%d %H:%M:%S} UTC  {installation['Site']}")
    ]
    if installation.status not in states.COMPLETE:
        parts.append(Text(f"! The stack is in {installation.status}.", style="yellow"))
    parts += [
        Text(""),
        *_projects(look),
        Text(""),
        *_servers(look),
        *_failures(look),
        Text(""),
        *_parts(look, installation.has_domain),
    ]
    parts += [Text(f"! No {part}: {why}", style="yellow") for part, why in look.problems.items()]
    return Group(*parts)


def _table(*columns: str) -> Table:
    table = Table(box=None, pad_edge=False, header_style="bold")
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


def _projects(look: Snapshot) -> list[RenderableType]:
    if "projects" in look.problems:
        return []
    if not look.projects:
        return [Text(as_typed("No project is registered yet: `hippodrome register` does it."))]
    table = _table("project", "live", "participants", "today", "finished", "where they are")
    for project, counts in look.projects:
        where = ", ".join(
            f"{step.key} {step.page}: {counts.by_step[step.key]:,}"
            for step in project.steps[:-1]
            if counts.by_step[step.key]
        )
        table.add_row(
            Text(project.id),
            Text("live", style="green") if project.live else Text("closed", style="dim"),
            Text(_of(counts.participants, project.max_participants)),
            Text(f"{counts.arrived_today:,}"),
            Text(f"{counts.finished:,}"),
            Text(where),
        )
    return [table]


def _of(count: int, limit: int | None) -> str:
    return f"{count:,}" if limit is None else f"{count:,} of {limit:,}"


def _servers(look: Snapshot) -> list[RenderableType]:
    if "servers" in look.problems:
        return []
    by_state = Counter(str(server.state) for server in look.servers)
    counts = ", ".join(f"{count:,} {state}" for state, count in sorted(by_state.items())) or "none"
    waiting = sum(server.is_warm_server for server in look.servers)
    counts += f", {waiting:,} of them warm" if waiting else ""
    sessions = sum(server.is_of_session for server in look.servers)
    members = sum(look.members.values())
    counts += f", {sessions:,} of sessions with {count(members, 'member')}" if sessions else ""
    tasks = "" if look.tasks is None else f" ({look.tasks:,} tasks on ECS)"
    closed = ", ".join(f"{count:,} {reason}" for reason, count in look.closed_today.most_common())
    parts: list[RenderableType] = [
        Text(f"Servers: {counts}{tasks}." + (f" Closed today: {closed}." if closed else ""), style="bold")
    ]
    parts += _warm_lines(look)
    if look.servers:
        table = _table("server", "project", "state", "age", "left", "")
        for server in look.servers[:MAX_SERVERS]:
            seconds_left = (server.deadline - look.at).total_seconds()
            table.add_row(
                Text(server.name),
                Text(server.project_id),
                Text(str(server.state)),
                Text(duration((look.at - server.requested).total_seconds())),
                Text(
                    duration(seconds_left) if seconds_left >= 0 else "overdue", style="" if seconds_left >= 0 else "red"
                ),
                Text(_kind(server, look.members.get(server.name)), style="dim"),
            )
        parts.append(table)
    if len(look.servers) > MAX_SERVERS:
        parts.append(Text(f"… and {len(look.servers) - MAX_SERVERS:,} more (--json has them all).", style="dim"))
    spent = look.spent.usd
    cost = f"Today's servers: about ${spent.likely:,.2f} (${spent.low:,.2f} to ${spent.high:,.2f}), list prices."
    return [*parts, Text(cost)]


def _failures(look: Snapshot) -> list[RenderableType]:
    """Tell why servers have failed in the last 24 hours. Failures that only AWS can prevent share a line."""
    lines: list[RenderableType] = []
    of_aws = [failure for failure in look.failures if not failure.matters]
    for failure in look.failures:
        if failure.matters:
            number = count(failure.servers, "server")
            text = f"! {failure.project}: {number} failed, the last {failure.last:%H:%M} UTC ({failure.server}). "
            lines.append(Text(as_typed(text + failure.cause.sentence), style="red"))
    if of_aws:
        counts = ", ".join(f"{failure.servers:,} {failure.cause} ({failure.project})" for failure in of_aws)
        lines.append(Text(f"Lost in the last 24 hours by no fault of yours, and replaced where AWS could: {counts}."))
    return [Text(""), *lines] if lines else []


def _warm_lines(look: Snapshot) -> list[RenderableType]:
    """Tell how many warm servers are ready, for each project that keeps warm servers or still has some."""
    lines: list[RenderableType] = []
    for project, _ in look.projects:
        warm = _warm(look, project)
        if warm["wanted"]:
            text = f"{project.id}: {warm['ready']} of {warm['wanted']} warm servers ready"
            assigned = f"; {warm['assignedToday']:,} assigned today." if warm["assignedToday"] else "."
            lines.append(Text(text + assigned))
        elif warm["there"]:
            lines.append(Text(f"{project.id}: {count(warm['there'], 'warm server')} on the way out."))
    return lines


def _kind(server: Server, members: int | None) -> str:
    kind = "Spot" if server.spot else "on demand"
    if server.is_warm_server:
        return f"{kind}, warm"
    if server.is_of_session:
        kind += ", started ahead" if members is None else f", session of {members}"
    return kind if server.attempt == 1 else f"{kind}, attempt {server.attempt}"


def _parts(look: Snapshot, has_domain: bool) -> list[RenderableType]:
    """Draw the parts on queues, certificate and alarms."""
    parts: list[RenderableType] = []
    dead = sum(queue.waiting for queue in look.queues if queue.dead)
    waiting = [f"{q.name} {q.waiting + q.in_flight:,}" for q in look.queues if not q.dead and q.waiting + q.in_flight]
    if "queues" not in look.problems:
        parts.append(Text(f"Queues: {', '.join(waiting) or 'empty'}."))
    if dead:
        messages = "message could" if dead == 1 else "messages could"
        parts.append(
            Text(
                as_typed(f"! {dead:,} {messages} not be dealt with: `hippodrome logs --all --errors` says why."),
                style="red",
            )
        )
    certificate = look.certificate
    if certificate is not None:
        text = f"Certificate: {certificate.days_left} days left ({', '.join(certificate.names)})."
        bad = certificate.overdue(look.at) or certificate.staging
        parts.append(
            Text(text + (" STAGING: browsers refuse it." if certificate.staging else ""), "red" if bad else "")
        )
    elif "certificate" not in look.problems and has_domain:
        parts.append(
            Text(
                as_typed(
                    "! No certificate: servers cannot be reached. `hippodrome certificate --production` orders one."
                ),
                style="red",
            )
        )
    if look.alarms:
        parts.append(Text(f"! Alarms: {', '.join(sorted(look.alarms))}.", style="red"))
    elif "alarms" not in look.problems:
        parts.append(Text("Alarms: none fires."))
    return parts
