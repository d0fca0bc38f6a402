"""`python -m local.rehearsal [FOLDER] --bots 20`: send simulated participants through a whole study.

It holds the study itself, with a data folder of its own (in `data-try/` of the project, where the data stay), lets
bots walk through it, and then looks whether everything that they sent and played can be found in the data and whether
every server is gone.
"""

from __future__ import annotations

import contextlib
import os
import re
import secrets
import shlex
import shutil
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from random import Random
from statistics import median
from typing import Annotated

import typer
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from bots.account import Account
from bots.addresses import THIS_MACHINE, AddressRefused
from bots.bot import Bot
from bots.crowd import SIGNALS, interruptible, walk
from bots.links import with_project
from bots.verification import Verification
from hippodrome.config import ConfigErrors, read_project
from local.rehearsal.crashes import Crash, Servers
from local.rehearsal.logs import Functions, verify
from local.rehearsal.study_process import TRIED, Leftovers, NotHeld, StudyProcess, copy_of, logs_of, wait_until_gone

SHOWN = 10  # lines of trouble in the report
SHOWN_CRASHES = 3  # tracebacks of agent.py's in the report


# The rehearsal


async def rehearse(
    link: str,
    bots: int,
    *,
    play: float,
    at_once: int,
    patience: float,
    ramp: float,
    watch: Callable[[Sequence[Account]], None],
) -> list[Account]:
    """Send bots through the study, `at_once` at a time; what happened to each. Cancelling ends all of them."""
    run = secrets.token_hex(3)
    crowd = [
        Bot(link, f"bot-{run}-{number:0{len(str(bots))}}", Random(f"{run}{number}"), play=play, patience=patience)  # noqa: S311
        for number in range(1, bots + 1)
    ]
    return await walk(crowd, at_once=at_once, ramp=ramp, watch=watch)


@contextlib.contextmanager
def _bar(console: Console, bots: int) -> Iterator[Callable[[Sequence[Account]], None]]:
    """A progress bar that shows how far the bots are."""
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("{task.fields[doing]}"),
    )
    with Progress(*columns, console=console) as progress:
        bar = progress.add_task("Bots", total=bots, doing="")

        def watch(accounts: Sequence[Account]) -> None:
            stages = [re.sub(r"step \S+", "pages", account.stage) for account in accounts]
            over = sum(stage in ("finished", "failed") for stage in stages)
            doing = [
                f"{stages.count(stage)} {words}"
                for stage, words in (
                    ("answers pages", "answering"),
                    ("waits for its server", "waiting"),
                    ("plays", "playing"),
                    ("failed", "failed"),
                )
                if stage in stages
            ]
            progress.update(bar, completed=over, doing=", ".join(doing))

        yield watch


# The report


def report(
    console: Console,
    accounts: Sequence[Account],
    found: Verification | None,
    left: Leftovers | None,
    seconds: float,
    *,
    recorded: bool = True,
    live: bool = True,
    said: Sequence[str] = (),
    crashes: Sequence[Crash] = (),
) -> bool:
    """Print the table and what went wrong; whether everything is as it should be.

    `recorded` and `live` are what config.yml says, `said` what the functions complained of, `crashes` the errors of
    agent.py.
    """
    finished = sum(account.finished for account in accounts)
    plays = [play for account in accounts for play in account.plays]
    errors = [f"{account.user_id}: {error}" for account in accounts for error in account.errors]
    troubles = [f"{account.user_id}: {trouble}" for account in accounts for trouble in account.troubles]
    crowd = f"{len(accounts)} bot{'s' if len(accounts) != 1 else ''}"
    table = Table(show_header=False, title=f"Rehearsal with {crowd}, {seconds:.0f} s", title_justify="left")
    row = table.add_row
    row("bots finished", _of(finished, len(accounts)))
    if plays:
        row("wait on the game page", _spread([play.waited for play in plays]))
    if found and found.starts:
        row("server: request to ready", _spread(found.starts))
    rates = [rate for play in plays if (rate := play.received_rate)]
    if rates:
        asked = ", ".join(sorted({str(play.frame_rate) for play in plays if play.frame_rate}))
        row("frames per second", f"p50 {median(rates):.1f}, least {min(rates):.1f}, of {asked} set")
        amount = sum(play.bytes for play in plays)
        row("frames received", f"{sum(play.frames for play in plays)}, {amount / 1e6:.1f} MB")
    if found:
        row("answers found", _of(found.answers, found.answers_sent))
        row("games found", _of(found.games, found.games_played))
        none = "none expected: config.yml says `s3upload: false`"
        row("recordings", f"{found.recordings}, with {found.steps} steps" if recorded or found.recordings else none)
        none = "none expected: config.yml says `live: false`, so nobody gets in"
        row("completion codes shown", _of(found.codes, finished) if live else none)
    else:
        row("data", "not looked at: without --data nobody knows where they are")
    if left:
        row("servers left over", str(max(left.processes, len(left.records))))
    if troubles:
        row("troubles got over", str(len(troubles)))
    failures = [crash.words() for crash in crashes]
    bad = errors + (found.missing if found else []) + (left.words() if left else [])
    row("errors", escape("\n".join([*([str(len(bad))] if bad else []), *failures])) or "none")
    console.print(table)
    for crash in crashes[:SHOWN_CRASHES]:
        console.print(escape(crash.traceback), style="red", soft_wrap=True)
    for all_lines, style in ((troubles, "yellow"), (bad, "red"), (said, "red" if bad else "yellow")):
        lines = _counted(all_lines)
        if lines and all_lines is said:
            console.print("  Local mode said:")
        for line in lines[:SHOWN]:
            console.print(f"  {escape(line)}", style=style, soft_wrap=True)
        if len(lines) > SHOWN:
            console.print(f"  … and {len(lines) - SHOWN} more", style=style)
    return finished == len(accounts) and not bad and not crashes


def _counted(lines: Sequence[str]) -> list[str]:
    """Each line once. Of lines that differ only in who they are about, the first, and of how many it is true."""
    groups: dict[str, list[str]] = {}
    for line in lines:
        groups.setdefault(re.sub(r"^bot-\w+-\d+", "", line), []).append(line)
    return [same[0] if len(same) == 1 else f"{len(same)} times: {same[0]}" for same in groups.values()]


def _of(part: int, whole: int) -> str:
    return f"{part} of {whole}"


def _spread(values: Sequence[float]) -> str:
    ordered = sorted(values)
    p95 = ordered[min(len(ordered) - 1, round(0.95 * (len(ordered) - 1) + 0.49))]
    return f"p50 {median(ordered):.1f} s, p95 {p95:.1f} s, max {ordered[-1]:.1f} s"


# The command line


@contextlib.contextmanager
def _held(folder: Path, data: Path, changed: bool, console: Console) -> Iterator[StudyProcess]:
    """The study on this machine; whatever happens, nothing of it is left afterwards."""
    with tempfile.TemporaryDirectory(prefix="rehearsal-", ignore_cleanup_errors=True) as temporary:
        place = Path(temporary)
        project = place / "project" if changed else folder
        if changed and (changes := copy_of(folder, project)):
            words = " and ".join(changes)
            console.print(f"The bots walk through a copy of the project in which {words}.", soft_wrap=True)
        study = StudyProcess(project, data, log=place / "local.log")
        try:
            study.start()
            yield study
        except KeyboardInterrupt:
            console.print("Interrupted: the servers are being ended …")
            study.interrupt()
            raise
        finally:
            study.clear()


def _data_of_bots(folder: Path, project_id: str, data: Path | None) -> Path:
    """Where the bots' data go. Raises NotHeld if people's data would be among them, or nothing can be written there."""
    place = data or folder / TRIED / f"try-{time.strftime('%Y%m%d-%H%M%S')}"
    users = place / project_id / "users"
    people = [user.name for user in users.iterdir() if not user.name.startswith("bot-")] if users.is_dir() else []
    if people or place.resolve() == (folder / "data").resolve():
        whose = f"holds the data of {len(people)} participants" if people else "is where the study's own data belong"
        raise NotHeld(
            f"{place} {whose}, and bots must not be among them. Name another folder with --data (with make: DATA=)."
        )
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise NotHeld(
            f"The bots' data cannot be kept in {place}: {error.strerror}. Name another folder with --data (with make: "
            "DATA=)."
        ) from None
    return place


def _how_to_read(folder: Path, data: Path) -> str:
    project = "" if folder.resolve() == Path.cwd() else f" PROJECT={shlex.quote(str(folder))}"
    return f"The bots' data are in {data}. This makes tables of them: make data{project} DATA={shlex.quote(str(data))}"


def _keep_logs(study: StudyProcess, project: Path) -> Path:
    """Put the logs where they outlive the rehearsal, and let them name only what is there afterwards."""
    kept = Path(tempfile.mkdtemp(prefix="rehearsal-log-"))
    shutil.copy(study.log, kept)
    servers = logs_of(study.data)
    if servers.is_dir():
        shutil.copytree(servers, kept / "logs")
    names = {str(servers): str(kept / "logs"), str(study.folder): str(project.resolve())}
    for log in kept.rglob("*.log"):
        text = log.read_text(encoding="utf-8", errors="replace")
        for before, after in names.items():
            text = text.replace(before, after)
        log.write_text(text, encoding="utf-8")
    return kept


def main(
    folder: Annotated[Path, typer.Argument(help="The project folder.")] = Path(),
    *,
    bots: Annotated[int, typer.Option(min=1, max=1000, help="How many simulated participants.")] = 20,
    at_once: Annotated[int, typer.Option(min=1, help="How many of them at the same time.")] = 10,
    play: Annotated[float, typer.Option(min=0, help="Seconds that each plays; 0: to the end of the game.")] = 8.0,
    patience: Annotated[float, typer.Option(min=1, help="Seconds that a bot waits for any one thing.")] = 300.0,
    ramp: Annotated[float, typer.Option(min=0, help="Seconds between the first arrivals.")] = 0.3,
    data: Annotated[
        Path | None,
        typer.Option(
            help="Keep the bots' data here, else in data-try/ of the project. With --url: where that study keeps them."
        ),
    ] = None,
    url: Annotated[
        str | None, typer.Option(help="The link of a study that is held already, on this machine only.")
    ] = None,
) -> None:
    """Send simulated participants through the whole study of FOLDER, and see whether everything arrives."""
    os.umask(0o077)  # as `make run`: what is written here is its owner's alone
    console = Console(highlight=False)
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)  # as Ctrl-C: nothing may be left over
    began = time.monotonic()
    try:
        config = read_project(folder)
        link = with_project(THIS_MACHINE.page(url), config.project.id) if url else None
        with contextlib.ExitStack() as stack:
            place = data if link else _data_of_bots(folder, config.project.id, data)
            study = stack.enter_context(_held(folder, place, play > 0, console)) if place and not link else None
            functions = Functions(place) if place else None
            servers = Servers(place) if place else None
            with _bar(console, bots) as watch:
                accounts = interruptible(
                    rehearse(
                        study.link if study else str(link),
                        bots,
                        play=play,
                        at_once=at_once,
                        patience=patience,
                        ramp=ramp,
                        watch=watch,
                    )
                )
            left = wait_until_gone(place, {account.user_id for account in accounts}) if place else None
            if study and left:
                left.stubborn = not study.interrupt()
                left.processes = max(left.processes, study.clear())
            found = verify(place, config.project.id, accounts, recorded=config.trial.s3upload) if place else None
            fine = report(
                console,
                accounts,
                found,
                left,
                time.monotonic() - began,
                recorded=config.trial.s3upload,
                live=config.project.live or bool(study and play > 0),  # the bots' copy is
                said=functions.complaints() if functions else (),
                crashes=servers.crashes({str(study.folder): str(folder)} if study else {}) if servers else (),
            )
            if not fine and study:
                kept = _keep_logs(study, folder)
                console.print(f"What local mode and the servers said is in {kept}.", soft_wrap=True)
            if study and place:
                console.print(_how_to_read(folder, place), markup=False, soft_wrap=True)
    except (ConfigErrors, AddressRefused, NotHeld) as error:
        console.print(str(error), markup=False, soft_wrap=True)
        raise typer.Exit(1) from None
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    raise typer.Exit(0 if fine else 1)


if __name__ == "__main__":
    typer.run(main)
