"""`hippodrome cost`: what a study will cost, and what it has cost."""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from datetime import UTC, date, datetime, timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model.server import Server
from hippodrome.deployment.aws.account import Account, find_installation, open_account
from hippodrome.deployment.aws.resource_names import STACK, TAG
from hippodrome.deployment.core import options, participants
from hippodrome.deployment.core.server_records import Records
from hippodrome.deployment.core.study_selection import one_or_all
from hippodrome.deployment.cost.billed import Billed, billed_or_why
from hippodrome.deployment.cost.estimate import (
    CostLine,
    FixedResources,
    StudyToEstimate,
    WarmCost,
    assumptions,
    month_lines,
    study_lines,
    total,
    warm,
)
from hippodrome.deployment.cost.prices import REGION, Prices, current
from hippodrome.deployment.cost.spent import Spent, spent

if TYPE_CHECKING:
    from hippodrome.control.config import Config

PEOPLE = 100  # participants, if --participants is left out


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
        bool, typer.Option("--billed", help="Also what AWS has billed: asks Cost Explorer, $0.01 a request.")
    ] = False,
    now: Annotated[
        bool, typer.Option("--current", help="Ask AWS for Fargate's prices in this region; needs credentials.")
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
        return _after(open_account(profile, region), stack, project, ask_aws=ask_aws, now=now, as_json=as_json)
    if every or ask_aws:
        raise Problem(
            f"{'--all' if every else '--billed'} is about what has been spent.", "Add --spent.", exit_code=Exit.MISUSE
        )
    account = open_account(profile, region) if now else None
    config = _read(Path(study or "."))
    setup = config.project.aws_setup
    where = region or (account.region if account else os.environ.get("AWS_REGION")) or setup.region or REGION
    prices = _prices(account) if account else Prices()
    return _before(_study(config, people, minutes, spot), _warm_before(config, prices), prices, where, as_json)


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
        raise Problem(
            f"The project in {folder} has mistakes.",
            "Correct them first.",
            [str(diagnostic) for diagnostic in errors.diagnostics],
        ) from None


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


def _warm_before(config: Config, prices: Prices) -> list[WarmCost]:
    project = config.project
    if not project.warm_servers:
        return []
    return [warm(project.id, project.warm_servers, project.aws_setup.cpu or 1, project.aws_setup.memory or 2, prices)]


def _fixed_resources() -> FixedResources:
    from hippodrome.deployment.code.template import Template  # noqa: PLC0415 - reads YAML

    try:
        return FixedResources.of(Template.read().resources({"AlarmEmail": "", "MonthlyBudget": "0"}))
    except Problem:
        return FixedResources()


def _before(study: StudyToEstimate, waiting: Sequence[WarmCost], prices: Prices, region: str, as_json: bool) -> int:
    lines, monthly = study_lines(study, prices), month_lines(prices, _fixed_resources())
    notes = [*assumptions(study), prices.note(region)]
    if as_json:
        screen.result_json(
            {
                "participants": study.participants,
                "study": [_line(line) for line in lines],
                "total": total(lines).as_json(),
                "perParticipant": (total(lines) * (1 / study.participants)).as_json(),
                "warmServers": [_warm(person) for person in waiting],
                "month": [_line(line) for line in monthly],
                "monthTotal": total(monthly).as_json(),
                "assumptions": notes,
                "prices": {"region": prices.region, "date": prices.date},
            }
        )
        return Exit.DONE
    people = count(study.participants, "participant")
    _table(f"The study, {people}", [*lines, CostLine("Together", "", total(lines))], study.participants)
    screen.result("")
    _show_warm(waiting)
    _table(
        "A month of the installation, even without participants", [*monthly, CostLine("Together", "", total(monthly))]
    )
    screen.result("")
    for note in notes:
        screen.result(note)
    return Exit.DONE


def _table(title: str, lines: Sequence[CostLine], people: int = 0) -> None:
    rows = [(line.what, line.amount, *map(_money, line.usd)) for line in lines]
    if people > 1:
        rows.append(("Each participant", "", *map(_money, lines[-1].usd * (1 / people))))
    right = ["amount", "low $", "likely $", "high $"]
    screen.table(["", *right], rows, title, right=right)


def _show_warm(waiting: Sequence[WarmCost]) -> None:
    """Print what warm servers cost in an hour and in a day, since it is not known how long their studies stay live."""
    rows: list[Sequence[object]] = []
    for person in waiting:
        size = f"{person.servers} of {person.cpu:g} vCPU, {person.memory:g} GB"
        kinds = ((person.project_id, f"{size}, on Spot", person.spot), ("", "the same on demand", person.on_demand))
        rows += [(name, what, _money(hour.likely), _money(hour.likely * 24)) for name, what, hour in kinds]
    if rows:
        title = "Servers that are kept warm, for as long as the study is live, even without participants"
        screen.table(["project", "servers", "an hour $", "a day $"], rows, title, right=["an hour $", "a day $"])
        screen.result("On Spot at 65 % off. If Spot has no room when a warm server starts, it runs on demand.")
        screen.result("")


# After


def _after(account: Account, stack: str, project: str | None, *, ask_aws: bool, now: bool, as_json: bool) -> int:
    installation = find_installation(account, stack)
    documents = account.platform(installation).documents
    projects = participants.choose(participants.registered_projects(documents), project)
    prices = _prices(account) if now else Prices()
    at = datetime.now(UTC)
    records = Records(documents)
    with screen.ProgressBars() as progress:
        bar = progress.add_task("Reading the records of servers", total=None)
        every = records.since(advance=lambda done, of: progress.update(bar, completed=done, total=of))
    sizes = {project.id: (project.size.cpu, project.size.memory) for project in projects}
    owned = {project.id: [r for r in every if r.project_id == project.id] for project in projects}
    by_project = {name: spent(records, prices, at, sizes) for name, records in owned.items() if project or records}
    waited = {name: spent([r for r in owned[name] if r.is_warm_server], prices, at, sizes) for name in by_project}
    now_warm = [
        warm(project.id, project.warm_servers, project.size.cpu, project.size.memory, prices)
        for project in projects
        if project.live and project.warm_servers
    ]
    mine = [r for r in every if project in (None, r.project_id)]
    bill, no_bill = _bill(account, stack, mine, at) if ask_aws else (None, "")
    if as_json:
        screen.result_json(
            {
                "projects": {
                    name: {**_spent(one), "waiting": _spent(waited[name])} for name, one in by_project.items()
                },
                "warmServers": [_warm(one) for one in now_warm],
                "unreadable": records.unreadable,
                "billed": _billed(bill) if bill else None,
                "problems": {"bill": no_bill} if no_bill else {},
                "prices": {"region": prices.region, "date": prices.date},
            }
        )
        return Exit.DONE
    rows = []
    for name, one in by_project.items():
        rows.append(_row(name, one))
        if waited[name].attempts:
            rows.append(_row("  of it, waiting (warm servers)", waited[name]))
    if rows:
        right = ["servers", "hours", "low $", "likely $", "high $"]
        screen.table(["project", *right], rows, "Servers, from their own records", right=right)
    else:
        screen.result("No server has run yet.")
    for note in _notes(by_project.values(), records.unreadable):
        screen.result(note)
    if rows:
        screen.result(prices.note(account.region))
        screen.result(
            "Not in it: functions, requests and data, which cost little; see `hippodrome cost` without --spent."
        )
    if now_warm:
        screen.result("")
        _show_warm(now_warm)
    if bill:
        _show_bill(bill, project)
    elif no_bill:
        screen.out.print(Text(f"\n! No bill: {no_bill}", style="yellow"))
    return Exit.DONE


def _row(name: str, amounts: Spent) -> tuple[object, ...]:
    return (name, amounts.attempts, f"{amounts.hours:,.1f}", *map(_money, amounts.usd))


def _notes(found: Collection[Spent], unreadable: int) -> list[str]:
    never, guessed = sum(amounts.never_ran for amounts in found), sum(one.guessed for one in found)
    notes = []
    if never:
        notes.append(f"{never:,} more were asked for and never ran: not counted.")
    if guessed:
        notes.append(
            f"{guessed:,} records do not say what the server ran on: computed with the project's present size."
        )
    if unreadable:
        notes.append(f"{unreadable:,} records cannot be read and are not counted.")
    return notes


def _bill(account: Account, stack: str, records: Sequence[Server], now: datetime) -> tuple[Billed | None, str]:
    """Ask for the bill since the day of the first server, or without servers since the first day of this month.

    If there is no bill, return None and the reason.
    """
    first = min((r.earlier[0].requested if r.earlier else r.requested for r in records), default=now.replace(day=1))
    # Cost Explorer remembers about a year.
    start: date = max(first.date(), (now - timedelta(days=364)).date())
    return billed_or_why(account, stack, start, (now + timedelta(days=1)).date())


def _show_bill(bill: Billed, project: str | None) -> None:
    rows = [(service, _money(amount)) for service, amount in sorted(bill.tagged.items(), key=lambda row: -row[1])]
    screen.result("")
    title = f"Billed by AWS, {bill.start} to {bill.end}, with the stack's tag"
    if rows:
        screen.table(["service", "$"], [*rows, ("Together", _money(sum(bill.tagged.values())))], title, right=["$"])
    else:
        screen.result(f"{title}: nothing. The tag {TAG} has to be a cost allocation tag (Billing console).")
    if bill.fargate is not None:
        screen.result(f"All Fargate tasks of the account in this region: ${_money(bill.fargate)}.")
    if project:
        screen.result("AWS's bill is not divided by projects.")
    screen.result(f"AWS is a day behind. Asking has cost ${bill.asking:.2f}.")


def _prices(account: Account) -> Prices:
    today = datetime.now(UTC).date().isoformat()
    try:
        return current(account.client("pricing", "us-east-1"), account.region, today)
    except LookupError as error:
        raise Problem(f"{error}.", "Leave out --current to use the table of this version.") from None


def _line(line: CostLine) -> dict[str, Any]:
    return {"what": line.what, "amount": line.amount, "usd": line.usd.as_json()}


def _warm(warm_cost: WarmCost) -> dict[str, Any]:
    return {
        "project": warm_cost.project_id,
        "servers": warm_cost.servers,
        "spotHour": warm_cost.spot.as_json(),
        "onDemandHour": warm_cost.on_demand.as_json(),
    }


def _spent(amounts: Spent) -> dict[str, Any]:
    return {
        "usd": amounts.usd.as_json(),
        "hours": round(amounts.hours, 3),
        "servers": amounts.attempts,
        "neverRan": amounts.never_ran,
        "sizeGuessed": amounts.guessed,
    }


def _billed(bill: Billed) -> dict[str, Any]:
    return {
        "from": bill.start,
        "to": bill.end,
        "tagged": bill.tagged,
        "fargateOfTheAccount": bill.fargate,
        "askingCost": bill.asking,
    }


def _money(amount: float) -> str:
    if amount == 0:
        return "0"
    return f"{amount:,.2f}" if amount >= 0.1 else f"{amount:.2g}" if amount >= 0.0001 else "< 0.0001"
