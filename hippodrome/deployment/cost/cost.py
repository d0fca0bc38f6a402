"""`hippodrome cost`: what a study will cost, and what it has cost."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model.project import Project
from hippodrome.control.model.server import Server
from hippodrome.deployment.aws.account import Account, find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK, TAG
from hippodrome.deployment.core import explain, options, participants
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.core.study_selection import one_or_all
from hippodrome.deployment.cost.estimate import (
    CostLine,
    StudyToEstimate,
    assumptions,
    month_lines,
    study_lines,
    total,
)
from hippodrome.deployment.cost.prices import DATE, EXPLORER_REQUEST, REGION, note, server_hour
from hippodrome.deployment.cost.spent import Spent, billed, spent

if TYPE_CHECKING:
    from hippodrome.control.config import Config

PEOPLE = 100  # participants, if --participants is left out
_PRICES = {"region": REGION, "date": str(DATE)}
_FIGURES = ["low $", "likely $", "high $"]


def command(
    study: options.Study = None,
    *,
    people: Annotated[
        int, typer.Option("--participants", min=1, max=10_000_000, help="How many participants the study will have.")
    ] = PEOPLE,
    minutes: Annotated[
        float | None,
        typer.Option("--minutes", min=0.1, max=1440, help="Mean minutes that a server runs.", show_default=False),
    ] = None,
    spot: Annotated[bool, typer.Option("--spot/--no-spot", help="Whether servers run on Fargate Spot.")] = True,
    after: Annotated[bool, typer.Option("--spent", help="What the study has cost, or with --all each.")] = False,
    every: options.All = False,
    ask_aws: Annotated[
        bool, typer.Option("--billed", help="Also what AWS has billed: asks Cost Explorer, for $0.01.")
    ] = False,
    as_json: options.Json = False,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
) -> int:
    """Estimate what a study will cost, or with --spent, tell what it has cost.

    Before: reads the study's config.yml (cpu, memory, maxRuntime, frame rate) and needs no AWS account. After: counts
    the servers' time from their own records. Both are estimates from list prices; --billed, with --spent, tells what
    AWS has charged.
    """
    if after:
        project = one_or_all(study, every)
        return _after(open_account(profile, region), stack, project, ask_aws=ask_aws, as_json=as_json)
    if every or ask_aws:
        raise Problem(
            f"{'--all' if every else '--billed'} is about what has been spent.", "Add --spent.", exit_code=Exit.MISUSE
        )
    config = _read(Path(study or "."))
    where = region or os.environ.get("AWS_REGION") or config.project.aws_setup.region or REGION
    estimated = _study(config, people, minutes, spot)
    return _before(estimated, _warm_before(config), _model(config, people), where, as_json)


# Before


def _read(folder: Path) -> Config:
    """Read the config.yml in a folder. Raises `Problem` with every mistake in it."""
    from hippodrome.control.config import ConfigErrors, read_project  # noqa: PLC0415 - the checks of config.yml, only needed for this

    if not folder.is_dir():
        raise Problem(
            f"There is no folder {folder}, and an estimate needs the study's config.yml.",
            f"Name the study's folder. What it has cost: `hippodrome cost {folder} --spent`.",
        )
    try:
        return read_project(folder)
    except ConfigErrors as errors:
        mistakes = [str(diagnostic) for diagnostic in errors.diagnostics]
        raise Problem(f"The project in {folder} has mistakes.", "Correct them first.", mistakes) from None


def _study(config: Config, people: int, minutes: float | None, spot: bool) -> StudyToEstimate:
    from hippodrome.control.config.remarks import starts_at_link  # noqa: PLC0415 - as in `_read`

    project, trial = config.project, config.trial
    if minutes is not None and minutes > project.max_runtime:
        raise Problem(
            f"No server of {project.id} runs {minutes:g} minutes: its maxRuntime is {project.max_runtime}.",
            "Give a smaller --minutes, or the project a longer maxRuntime.",
        )
    rate = trial.max_frame_rate if trial.allow_frame_rate_change else trial.starting_frame_rate
    return StudyToEstimate(
        participants=people,
        steps=len(config.steps),
        cpu=project.aws_setup.cpu or 1,
        memory=project.aws_setup.memory or 2,
        max_runtime=project.max_runtime,
        minutes=minutes,
        frame_rate=rate or 30,
        games=bool(config.game_steps),
        spot=spot,
        observations=bool(trial.record_observations),
        at_link=starts_at_link(config),
        players=project.players,
        patience=project.patience,
    )


def _model(config: Config, people: int) -> list[str]:
    """Return a note on what the language model can cost, if the study has one."""
    from hippodrome.control.config import model_cost  # noqa: PLC0415 - as in `_read`

    words = model_cost.note(config, people)
    return [words] if words else []


def _before(
    study: StudyToEstimate, warm: Sequence[dict[str, Any]], model: Sequence[str], region: str, as_json: bool
) -> int:
    lines, monthly = study_lines(study), month_lines()
    each = total(lines) * (1 / study.participants)
    notes = [*assumptions(study), *model, note(region, datetime.now(UTC).date())]
    if as_json:
        screen.result_json(
            {
                "participants": study.participants,
                "study": [line._asdict() | {"usd": line.usd.as_json()} for line in lines],
                "total": total(lines).as_json(),
                "perParticipant": each.as_json(),
                "warmServers": warm,
                "month": [line._asdict() | {"usd": line.usd.as_json()} for line in monthly],
                "monthTotal": total(monthly).as_json(),
                "assumptions": notes,
                "prices": _PRICES,
            }
        )
        return Exit.DONE
    together = [CostLine("Together", "", total(lines)), CostLine("Each participant", "", each)]
    _table(f"The study, {count(study.participants, 'participant')}", [*lines, *together])
    _show_warm(warm)
    _table(
        "A month of the installation, even without participants", [*monthly, CostLine("Together", "", total(monthly))]
    )
    for sentence in notes:
        screen.result(sentence)
    return Exit.DONE


def _table(title: str, lines: Iterable[CostLine]) -> None:
    rows = [(line.what, line.amount, *map(_money, line.usd)) for line in lines]
    screen.table(["", "amount", *_FIGURES], rows, title, right=["amount", *_FIGURES])
    screen.result("")


# Warm servers


def _warm_before(config: Config) -> list[dict[str, Any]]:
    setup = config.project.aws_setup
    return _warm(config.project.id, config.project.warm_servers, setup.cpu or 1, setup.memory or 2)


def _warm(project_id: str, servers: int, cpu: float, memory: float) -> list[dict[str, Any]]:
    """Compute what a project's warm servers cost in an hour, as JSON data; [] if it has none.

    A server that waits costs as much as one in use.
    """
    spot, on_demand = (server_hour(cpu, memory, spot=kind) * servers for kind in (True, False))
    size = {"servers": servers, "cpu": cpu, "memory": memory}
    hours = {"spotHour": spot.as_json(), "onDemandHour": on_demand.as_json()}
    return [{"project": project_id, **size, **hours}] if servers else []


def _show_warm(warm: Sequence[dict[str, Any]]) -> None:
    """Print what warm servers cost in an hour and in a day, since it is not known how long their studies stay live."""
    rows = []
    for of_project in warm:
        size = f"{of_project['servers']} of {of_project['cpu']:g} vCPU, {of_project['memory']:g} GB"
        for kind, hour in (("on Spot", of_project["spotHour"]), ("on demand", of_project["onDemandHour"])):
            usd = hour["likely"]
            rows.append((of_project["project"], f"{size}, {kind}", _money(usd), _money(usd * 24)))
    if rows:
        title = "Servers that are kept warm, for as long as the study is live, even without participants"
        screen.table(["project", "servers", "an hour $", "a day $"], rows, title, right=["an hour $", "a day $"])
        screen.result("")


# After


def _after(account: Account, stack: str, project: str | None, *, ask_aws: bool, as_json: bool) -> int:
    documents = account.platform(find_installation(account, stack)).documents
    projects = participants.choose(participants.registered_projects(documents), project)
    at, reader = datetime.now(UTC), Records(documents)
    with screen.ProgressBars() as progress:
        bar = progress.add_task("Reading the records of servers", total=None)
        records = reader.since(advance=lambda done, of: progress.update(bar, completed=done, total=of))
    owned = {each.id: [record for record in records if record.project_id == each.id] for each in projects}
    sums = {name: spent(of_project, at) for name, of_project in owned.items() if project or of_project}
    waiting = {name: spent((record for record in owned[name] if record.is_warm_server), at) for name in sums}
    warm = [line for each in projects if each.live for line in _warm_now(each)]
    mine = [record for of_project in owned.values() for record in of_project]
    bill, why = _bill(account, stack, mine, at) if ask_aws else ({}, "")
    if as_json:
        by_project = {name: {**_spent(amounts), "waiting": _spent(waiting[name])} for name, amounts in sums.items()}
        data = {"projects": by_project, "warmServers": warm, "unreadable": reader.unreadable, "prices": _PRICES}
        problems = {"problems": {"bill": why} if why else {}}
        screen.result_json({**data, "billed": bill if ask_aws and not why else None, **problems})
        return Exit.DONE
    _show_sums(sums, waiting)
    if reader.unreadable:
        screen.result(f"{count(reader.unreadable, 'record')} cannot be read, and not counted.")
    if sums:
        screen.result(note(account.region, at.date()))
        screen.result("Functions, requests and data cost little and are not in it: see `hippodrome cost`.")
    screen.result("")
    _show_warm(warm)
    if why:
        screen.result(f"! No bill: {why}")
        screen.result("Cost Explorer has to be switched on in the Billing console; it takes a day to fill.")
    elif ask_aws:
        _show_bill(bill)
    return Exit.DONE


def _warm_now(project: Project) -> list[dict[str, Any]]:
    return _warm(project.id, project.warm_servers, project.size.cpu, project.size.memory)


def _show_sums(sums: dict[str, Spent], waiting: dict[str, Spent]) -> None:
    rows = []
    for name, amounts in sums.items():
        rows.append(_row(name, amounts))
        if waiting[name].attempts:
            rows.append(_row("  of it, waiting (warm servers)", waiting[name]))
    if not rows:
        screen.result("No server has run yet.")
        return
    right = ["servers", "hours", *_FIGURES]
    screen.table(["project", *right], rows, "Servers, from their own records", right=right)
    if never := sum(amounts.never_ran for amounts in sums.values()):
        screen.result(f"{never:,} more were asked for and never ran: not counted.")


def _row(name: str, amounts: Spent) -> tuple[object, ...]:
    return (name, amounts.attempts, f"{amounts.hours:,.1f}", *map(_money, amounts.usd))


def _bill(account: Account, stack: str, records: Sequence[Server], now: datetime) -> tuple[dict[str, float], str]:
    """Ask for the bill since the day of the first server, or without servers since the first day of this month.

    If there is no bill, return the reason, too.
    """
    first = min((r.earlier[0].requested if r.earlier else r.requested for r in records), default=now.replace(day=1))
    start = max(first, now - timedelta(days=364)).date()  # Cost Explorer remembers about a year
    try:
        return billed(account, stack, start, (now + timedelta(days=1)).date()), ""
    except Exception as error:
        problem = explain.problem_from(error)
        if problem is None:
            raise
        return {}, f"{problem} {problem.advice}".strip()


def _show_bill(bill: dict[str, float]) -> None:
    rows = [(service, _money(usd)) for service, usd in sorted(bill.items(), key=lambda row: -row[1])]
    if rows:
        title = "Billed by AWS for all that has the stack's tag, a day behind, not divided by projects"
        screen.table(["service", "$"], [*rows, ("Together", _money(sum(bill.values())))], title, right=["$"])
    else:
        screen.result(f"AWS has billed nothing with the tag {TAG}: make it a cost allocation tag (Billing console).")
    screen.result(f"This request has cost ${EXPLORER_REQUEST}.")


def _spent(amounts: Spent) -> dict[str, Any]:
    return {
        "usd": amounts.usd.as_json(),
        "hours": round(amounts.hours, 3),
        "servers": amounts.attempts,
        "neverRan": amounts.never_ran,
    }


def _money(amount: float) -> str:
    if amount == 0:
        return "0"
    return f"{amount:,.2f}" if amount >= 0.1 else f"{amount:.2g}" if amount >= 0.0001 else "< 0.0001"
