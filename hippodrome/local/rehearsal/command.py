"""`hippodrome try`: sends simulated participants through a whole study.

It runs the study with a data folder of its own, which stays in `data-try/` of the project, and lets bots walk through
it. Then it checks that everything that they sent and played is in the data, and that no server is left.
"""

from __future__ import annotations

import contextlib
import os
import re
import shlex
import signal
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from hippodrome.bots.addresses import THIS_MACHINE, AddressRefused
from hippodrome.bots.crowd import SIGNALS, interruptible
from hippodrome.bots.links import with_project
from hippodrome.bots.report import BotReport
from hippodrome.console.arguments import StudyFolder, folder_argument
from hippodrome.console.problem import Problem
from hippodrome.console.program import as_typed
from hippodrome.control.config import Config, ConfigErrors, read_project
from hippodrome.control.config.folder import read_source
from hippodrome.local import requirements
from hippodrome.local.rehearsal import ends as reached
from hippodrome.local.rehearsal.ends import Crowd, Ends
from hippodrome.local.rehearsal.logs import StudyLogs, verify
from hippodrome.local.rehearsal.report import report
from hippodrome.local.rehearsal.study_process import (
    TRIED,
    StudyNotStarted,
    StudyProcess,
    copy_of,
    logs_of,
    sessions_not_open,
    sessions_of,
    wait_until_gone,
)
from hippodrome.local.study_folder import must_hold_study


@contextlib.contextmanager
def _bar(console: Console, bots: int) -> Iterator[Callable[[Sequence[BotReport]], None]]:
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

        def watch(reports: Sequence[BotReport]) -> None:
            stages = [re.sub(r"step \S+", "pages", bot.stage) for bot in reports]
            over = sum(stage in ("finished", "ended", "failed") for stage in stages)
            doing = [
                f"{stages.count(stage)} {words}"
                for stage, words in (
                    ("answers pages", "answering"),
                    ("waits for others", "in the lobby"),
                    ("waits for its server", "waiting"),
                    ("plays", "playing"),
                    ("ended", "ended before the last page"),
                    ("failed", "failed"),
                )
                if stage in stages
            ]
            progress.update(bar, completed=over, total=max(bots, len(reports)), doing=", ".join(doing))

        yield watch


# The command line


@contextlib.contextmanager
def _running(
    folder: Path, data: Path, changed: bool, console: Console, *, real_llm: bool = False
) -> Iterator[StudyProcess]:
    """Run the study, or a copy of it in which bots can end the game if `changed`. Nothing runs afterwards."""
    with tempfile.TemporaryDirectory(prefix="rehearsal-", ignore_cleanup_errors=True) as temporary:
        project = Path(temporary) / "project" if changed else folder
        if changed and (changes := copy_of(folder, project)):
            words = " and ".join(changes)
            console.print(f"The bots walk through a copy of the project in which {words}.", soft_wrap=True)
        study = StudyProcess(project, data, log=logs_of(data) / "run.log", real_llm=real_llm)
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
    """Make the folder for the bots' data. Raises StudyNotStarted if it is for people's data or cannot be written."""
    place = data or folder / TRIED / f"try-{time.strftime('%Y%m%d-%H%M%S')}"
    users = place / project_id / "users"
    people = [user.name for user in users.iterdir() if not user.name.startswith("bot-")] if users.is_dir() else []
    if people or place.resolve() == (folder / "data").resolve():
        reason = f"holds the data of {len(people)} participants" if people else "is where the study's own data belong"
        raise StudyNotStarted(f"{place} {reason}, and bots must not be among them. Name another folder with --data.")
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StudyNotStarted(
            f"The bots' data cannot be stored in {place}: {error.strerror}. Name another folder with --data."
        ) from None
    return place


def _how_to_read(folder: Path, data: Path) -> str:
    """Where the data are, and the command that makes tables of them."""
    study = "" if folder.resolve() == Path.cwd() else f" {folder_argument(folder)}"
    command = f"hippodrome data{study} --from {shlex.quote(str(data))}"
    return f"The bots' data are in {data}. This makes tables of them: {command}"


def _rehearse_and_report(
    folder: Path,
    config: Config,
    crowd: Crowd,
    bots: int,
    *,
    link: str,
    data: Path | None,
    study: StudyProcess | None,
    console: Console,
    began: float,
    ends: Ends | None = None,
) -> bool:
    """Send a crowd of so many `bots` through the study at `link`, and print the report; return whether all is well.

    `data` is None if the folder of its data is not known. With `ends`, bots are sent to each of them instead.
    """
    logs = StudyLogs(data) if data else None
    with _bar(console, len(ends.goals()) if ends else bots) as watch:
        reports = interruptible(ends.rehearse(link, crowd, watch) if ends else crowd.rehearse(link, bots, watch))
    servers_left = None
    if data:
        ids = {bot.user_id for bot in reports}
        sessions = sessions_of(data, config.project.id, ids)
        servers_left = wait_until_gone(
            data, ids | sessions | (sessions_not_open(data, config.project.id) if study else set())
        )
    if study and servers_left:
        servers_left.local_mode_killed = not study.interrupt()
        servers_left.processes = max(servers_left.processes, study.clear())
    verification = verify(data, config.project.id, reports, recorded=config.trial.s3upload) if data else None
    fine = report(
        console,
        reports,
        verification,
        servers_left,
        time.monotonic() - began,
        play=crowd.play,
        recorded=config.trial.s3upload,
        live=config.project.live or bool(study and crowd.play > 0),  # the copy for bots is live
        warnings=logs.warnings() if logs else (),
        crashes=logs.crashes({str(study.folder): str(folder)} if study else {}) if logs else (),
    )
    all_reached = reached.report(console, ends, read_source(folder)) if ends else True
    if not fine and study:
        console.print(f"The logs of local mode and of the servers are in {logs_of(study.data)}.", soft_wrap=True)
    if study and data:
        console.print(as_typed(_how_to_read(folder, data)), markup=False, soft_wrap=True)
    return fine and all_reached


def command(
    folder: StudyFolder = Path(),
    *,
    bots: Annotated[int, typer.Option(min=1, max=1000, help="How many simulated participants.")] = 20,
    at_once: Annotated[int, typer.Option(min=1, help="How many of them walk at the same time.")] = 10,
    ends: Annotated[
        bool, typer.Option("--ends", help="Send bots to each cell of `conditions` and to each end, instead of --bots.")
    ] = False,
    play: Annotated[float, typer.Option(min=0, help="Seconds that each plays; 0: to the end of the game.")] = 8.0,
    patience: Annotated[float, typer.Option(min=1, help="Seconds that a bot waits for any one thing.")] = 300.0,
    ramp: Annotated[float, typer.Option(min=0, help="Seconds between the first arrivals.")] = 0.3,
    data: Annotated[
        Path | None,
        typer.Option(
            help="The folder for the bots' data; else one in data-try/ of STUDY. With --url: that study's data.",
            show_default=False,
        ),
    ] = None,
    url: Annotated[
        str | None, typer.Option(help="The link of a study that runs already, on this machine only.")
    ] = None,
    real_llm: Annotated[
        bool,
        typer.Option("--real-llm", help="Ask the study's language model, which costs money, instead of a stand-in."),
    ] = False,
) -> None:
    """Send simulated participants through the whole study, and check that everything that they do arrives.

    What the study's requirements.txt names is installed first. The exit code is 1 if something is missing, and with
    --ends if nobody came through a cell, or reached an end.
    """
    must_hold_study(folder)
    requirements.prepare(folder)
    os.umask(0o077)  # like `run`: only their owner may read these files
    console = Console(highlight=False)
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)  # like Ctrl-C, after which nothing is left running
    began = time.monotonic()
    try:
        config = read_project(folder)
        link = with_project(THIS_MACHINE.page(url), config.project.id) if url else None
        place = data if link else _data_of_bots(folder, config.project.id, data)
        if ends and not place:
            raise StudyNotStarted("With --url, --ends also needs --data: it reads there which cell a bot got.")
        running = _running(folder, place, play > 0, console, real_llm=real_llm) if place and not link else None
        with running or contextlib.nullcontext() as study:
            fine = _rehearse_and_report(
                folder,
                config,
                Crowd(
                    at_once=max(at_once, config.project.players),
                    ramp=ramp,
                    play=play,
                    patience=patience,
                    right={step.key: step.step.right for step in config.steps if step.step and step.step.right},
                ),
                bots,
                link=study.link if study else str(link),
                data=place,
                study=study,
                console=console,
                began=began,
                ends=Ends(config, place) if ends and place else None,
            )
    except ConfigErrors as errors:
        mistakes = [str(mistake) for mistake in errors.diagnostics]
        raise Problem("The study has mistakes:", "Correct them, and try again.", mistakes) from None
    except (AddressRefused, StudyNotStarted) as error:
        raise Problem(str(error)) from None
    except KeyboardInterrupt:
        raise typer.Exit(130) from None
    raise typer.Exit(0 if fine else 1)
