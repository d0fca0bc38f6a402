"""`python -m local.rehearsal [FOLDER] --bots 20`: send simulated participants through a whole study.

It holds the study itself, with a data folder of its own, lets bots walk through it, and then looks whether everything
that they sent and played can be found in the data and whether every server is gone.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from random import Random
from statistics import median
from typing import Annotated, Any

import psutil
import typer
import yaml
from rich.console import Console
from rich.markup import escape
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn
from rich.table import Table

from hippodrome.config import ConfigErrors, read_project
from local.bots import Account, Bot, Play, Refused, local_only, with_project

ROOT = Path(__file__).resolve().parent.parent
START_SECONDS = 60.0  # until the study must be held
GONE_SECONDS = 45.0  # until the servers must be gone after the last bot
END_SECONDS = 30.0  # until local mode must have ended
SHOWN = 10  # lines of trouble in the report

_LINK = re.compile(r"http://127\.0\.0\.1:\d+/next\S*")


class NotHeld(Exception):
    """The study could not be held; the text is what local mode said."""


# The study on this machine


class Study:
    """`python -m local` in a process of its own."""

    def __init__(self, folder: Path, data: Path, *, port: int = 0, log: Path | None = None) -> None:
        self.folder, self.data, self.port = folder.resolve(), data.resolve(), port
        self.log = log or data.resolve().parent / f"{data.name}.log"
        self.link = ""
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    def start(self, seconds: float = START_SECONDS) -> None:
        """Start it and wait for its link. Raises NotHeld."""
        self.log.parent.mkdir(parents=True, exist_ok=True)
        with self.log.open("ab") as log:
            said = log.tell()
            self._process = subprocess.Popen(  # noqa: S603 - our own command
                [
                    *(sys.executable, "-m", "local", str(self.folder)),
                    *("--port", str(self.port), "--data", str(self.data)),
                ],
                cwd=ROOT,
                env={**os.environ, "PYTHONUNBUFFERED": "1", "COLUMNS": "200"},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is for us; we end it ourselves
            )
        until = time.monotonic() + seconds
        while True:
            ended = self._process.poll() is not None
            text = self.log.read_bytes()[said:].decode("utf-8", "replace")
            found = _LINK.search(text)
            if found:
                self.link = found[0]
                return
            if ended or time.monotonic() > until:
                self.kill()
                raise NotHeld(text.strip() or "it said nothing")
            time.sleep(0.05)

    def interrupt(self, seconds: float = END_SECONDS) -> bool:
        """End it as Ctrl-C does; whether it did so by itself."""
        process = self._process
        if process is None:
            return True
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        try:
            process.wait(seconds)
        except subprocess.TimeoutExpired:
            self.kill()
            return False
        return True

    def kill(self) -> None:
        """`kill -9`: it has no time to say goodbye."""
        if self._process is not None:
            self._process.kill()
            self._process.wait()

    def clear(self) -> int:
        """End what is left of it, in any case; how many processes there were."""
        self.kill()
        left = servers_of(self.data)
        for process in left:
            with contextlib.suppress(psutil.Error):
                process.kill()
        psutil.wait_procs(left, timeout=5)
        return len(left)


def servers_of(data: Path, users: Collection[str] | None = None) -> list[psutil.Process]:
    """The processes that play for this data folder (and these users), whoever started them: by their environment."""
    store = str(data.resolve())
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error):
            told = process.environ()
            if told.get("STORE") == store and (users is None or told.get("USER_ID") in users):
                found.append(process)
    return found


def copy_of(project: Path, folder: Path) -> list[str]:
    """A copy of the project in which bots can end the game; what was changed, in words. Its files are links."""
    folder.mkdir(parents=True)
    config = next(project / name for name in ("config.yml", "config.yaml") if (project / name).is_file())
    for path in project.iterdir():
        if path != config and path.name != "data" and not path.name.startswith("."):
            (folder / path.name).symlink_to(path.resolve())
    tree = yaml.safe_load(config.read_text(encoding="utf-8"))
    changes = []
    if not tree["project"].get("live"):
        tree["project"]["live"] = True
        changes.append("`live` is true")
    trial = tree.get("trial") or {}
    shown = trial.get("ui") or dict.fromkeys(("left", "right", "up", "down", "start", "pause"), True)
    if not shown.get("stop"):
        tree["trial"] = {**trial, "ui": {**shown, "stop": True}}
        changes.append("the game may be stopped (`ui.stop`)")
    (folder / config.name).write_text(yaml.safe_dump(tree, sort_keys=False, allow_unicode=True), encoding="utf-8")
    return changes


# What is in the data


@dataclass
class Recording:
    """One recording as it lies in the data folder."""

    name: str
    complete: bool = False
    step: str = ""  # of the study
    steps: int = 0  # of the environment
    pictures: int = 0  # that could be shown: steps and resets


def read_recording(path: Path) -> Recording:
    """Read a recording to its end. Never raises: what cannot be read is not complete."""
    found = Recording(path.name)
    unpack = zlib.decompressobj(31)
    try:
        text = unpack.decompress(path.read_bytes())
        lines = [json.loads(line) for line in text.splitlines()]
        kinds = [line["kind"] for line in lines]
        found.step = str(lines[0]["step"]) if lines else ""
        found.steps = kinds.count("step")
        found.pictures = found.steps + kinds.count("reset")
        found.complete = unpack.eof and kinds[:1] == ["header"] and kinds[-1:] == ["end"]
    except (OSError, zlib.error, ValueError, KeyError, TypeError, AttributeError):
        found.complete = False
    return found


@dataclass
class Findings:
    """What the data say about the bots, and what is missing."""

    answers: int = 0
    answers_sent: int = 0
    games: int = 0
    games_played: int = 0
    recordings: int = 0
    steps: int = 0
    codes: int = 0
    starts: list[float] = field(default_factory=list)  # seconds from request to ready
    missing: list[str] = field(default_factory=list)


def look(data: Path, project_id: str, accounts: Sequence[Account], *, recorded: bool = True) -> Findings:
    """Compare what is in the data folder with what the bots say. `recorded`: the project keeps recordings."""
    found = Findings()
    for account in accounts:
        folder = data / project_id / "users" / account.user_id
        for step, sent in account.answers.items():
            found.answers_sent += 1
            if _same(_json(folder / "answers" / f"{step}.json").get("answers"), sent):
                found.answers += 1
            else:
                found.missing.append(f"{account.user_id}: the answers of step {step} are not what was sent")
        recordings = [read_recording(path) for path in sorted((folder / "trials").glob("*/*.gz"))]
        for play in account.plays:
            who, stored = f"{account.user_id}, step {play.step}", _json(folder / "answers" / f"{play.step}.json")
            own = [one for one in recordings if one.step == play.step]
            _look_at_game(found, who, play, stored.get("answers") or {}, own)
            if recorded and not own:
                found.missing.append(f"{who}: no recording")
        for path in sorted((folder / "trials").rglob("*")):
            if path.is_file() and path.suffix != ".gz":
                found.missing.append(f"{account.user_id}: {path.name} lies among the recordings")
        code = _json(folder / "participant.json").get("completionCode")
        found.codes += bool(code) and str(code) in account.final_page
    for path in sorted((data / "_servers").glob("*.json")):
        record = _json(path)
        if record.get("ready") and record.get("userId") in {account.user_id for account in accounts}:
            found.starts.append(_seconds(record["requested"], record["ready"]))
    if 0 < found.codes < sum(account.finished for account in accounts):
        found.missing.append("some final pages lack their completion code, or show another")
    return found


def _look_at_game(found: Findings, who: str, play: Play, answers: dict[str, Any], recordings: list[Recording]) -> None:
    """Compare what a bot has seen of a game with its answer and its recordings."""
    found.games_played += 1
    if not answers:
        found.missing.append(f"{who}: the game's answer is not there")
        return
    found.games += 1
    if answers.get("outcome") == "failed":
        found.missing.append(f"{who}: the game ended with an error of the agent's")
    if play.done and (answers.get("score"), answers.get("episodes")) != (play.score, play.episodes):
        found.missing.append(f"{who}: the score shown is not the score stored")
    if not recordings:
        return
    steps, pictures = sum(one.steps for one in recordings), sum(one.pictures for one in recordings)
    found.recordings += len(recordings)
    found.steps += steps
    found.missing += [f"{who}: {one.name} is cut off" for one in recordings if not one.complete]
    if steps < answers.get("frames", 0):
        found.missing.append(f"{who}: {steps} steps recorded of {answers.get('frames')} played")
    if pictures < play.frames:
        found.missing.append(f"{who}: {play.frames} frames seen but {pictures} recorded")


def open_records(data: Path, users: Collection[str] | None = None) -> list[str]:
    """The servers (of these users) that the records call open."""
    records = ((path.stem, _json(path)) for path in sorted((data / "_servers").glob("*.json")))
    return [
        name
        for name, record in records
        if record.get("state") != "closed" and (users is None or record.get("userId") in users)
    ]


def _json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_bytes())
    except (OSError, ValueError):
        return {}
    return data if isinstance(data, dict) else {}


def _same(stored: object, sent: object) -> bool:
    """Byte for byte: the same names in the same order with the same texts."""
    return json.dumps(stored).encode() == json.dumps(sent).encode()


def _seconds(before: str, after: str) -> float:
    return (datetime.fromisoformat(after) - datetime.fromisoformat(before)).total_seconds()


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
    run, places = secrets.token_hex(3), asyncio.Semaphore(at_once)
    crowd = [
        Bot(link, f"bot-{run}-{number:0{len(str(bots))}}", Random(f"{run}{number}"), play=play, patience=patience)  # noqa: S311
        for number in range(1, bots + 1)
    ]

    async def walk(number: int, bot: Bot) -> None:
        await asyncio.sleep(min(number, at_once) * ramp)
        async with places:
            await bot.run()

    async def show() -> None:
        while True:
            watch([bot.account for bot in crowd])
            await asyncio.sleep(0.2)

    showing = asyncio.create_task(show())
    try:
        async with asyncio.TaskGroup() as group:
            for number, bot in enumerate(crowd):
                group.create_task(walk(number, bot))
    finally:
        showing.cancel()
    watch([bot.account for bot in crowd])
    return [bot.account for bot in crowd]


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


@dataclass
class Leftovers:
    """What must not be there at the end."""

    processes: int = 0
    records: list[str] = field(default_factory=list)
    stubborn: bool = False  # local mode had to be killed

    def words(self) -> list[str]:
        """What is wrong; nothing if nothing is left over."""
        lines = [f"the record of server {name} is not closed" for name in self.records]
        if self.processes:
            lines.append(f"{self.processes} server process(es) were left over")
        if self.stubborn:
            lines.append(f"local mode did not end within {END_SECONDS:.0f} s")
        return lines


def wait_until_gone(data: Path, users: Collection[str] | None = None, seconds: float = GONE_SECONDS) -> Leftovers:
    """Give the last servers time to end; what is left."""
    until = time.monotonic() + seconds
    while True:
        left = Leftovers(len(servers_of(data, users)), open_records(data, users))
        if not left.words() or time.monotonic() > until:
            return left
        time.sleep(0.2)


# The report


def report(
    console: Console, accounts: Sequence[Account], found: Findings | None, left: Leftovers | None, seconds: float
) -> bool:
    """Print the table and what went wrong; whether everything is as it should be."""
    finished = sum(account.finished for account in accounts)
    plays = [play for account in accounts for play in account.plays]
    errors = [f"{account.user_id}: {error}" for account in accounts for error in account.errors]
    troubles = [f"{account.user_id}: {trouble}" for account in accounts for trouble in account.troubles]
    table = Table(
        show_header=False, title=f"Rehearsal with {len(accounts)} bots, {seconds:.0f} s", title_justify="left"
    )
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
        row("recordings", f"{found.recordings}, with {found.steps} steps")
        row("completion codes shown", _of(found.codes, finished))
    else:
        row("data", "not looked at: without --data nobody knows where they are")
    if left:
        row("servers left over", str(max(left.processes, len(left.records))))
    if troubles:
        row("troubles got over", str(len(troubles)))
    bad = errors + (found.missing if found else []) + (left.words() if left else [])
    row("errors", str(len(bad)) if bad else "none")
    console.print(table)
    for lines, style in ((troubles, "yellow"), (bad, "red")):
        for line in lines[:SHOWN]:
            console.print(f"  {escape(line)}", style=style, soft_wrap=True)
        if len(lines) > SHOWN:
            console.print(f"  … and {len(lines) - SHOWN} more", style=style)
    return finished == len(accounts) and not bad


def _of(part: int, whole: int) -> str:
    return f"{part} of {whole}"


def _spread(values: Sequence[float]) -> str:
    ordered = sorted(values)
    p95 = ordered[min(len(ordered) - 1, round(0.95 * (len(ordered) - 1) + 0.49))]
    return f"p50 {median(ordered):.1f} s, p95 {p95:.1f} s, max {ordered[-1]:.1f} s"


# The command line


@contextlib.contextmanager
def _held(folder: Path, data: Path | None, changed: bool, console: Console) -> Iterator[Study]:
    """The study on this machine; whatever happens, nothing of it is left afterwards."""
    with tempfile.TemporaryDirectory(prefix="rehearsal-", ignore_cleanup_errors=True) as temporary:
        place = Path(temporary)
        project = place / "project" if changed else folder
        if changed and (changes := copy_of(folder, project)):
            words = " and ".join(changes)
            console.print(f"The bots walk through a copy of the project in which {words}.", soft_wrap=True)
        study = Study(project, data or place / "data", log=place / "local.log")
        try:
            study.start()
            yield study
        except KeyboardInterrupt:
            console.print("Interrupted: the servers are being ended …")
            study.interrupt()
            raise
        finally:
            study.clear()


def _keep_logs(study: Study) -> Path:
    """Put the logs where they outlive the rehearsal."""
    kept = Path(tempfile.mkdtemp(prefix="rehearsal-log-"))
    shutil.copy(study.log, kept)
    servers = study.data.parent / ".hippodrome" / study.data.name / "logs"
    if servers.is_dir():
        shutil.copytree(servers, kept / "logs")
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
        Path | None, typer.Option(help="Keep the data here. With --url: where that study keeps them.")
    ] = None,
    url: Annotated[
        str | None, typer.Option(help="The link of a study that is held already, on this machine only.")
    ] = None,
) -> None:
    """Send simulated participants through the whole study of FOLDER, and see whether everything arrives."""
    console = Console(highlight=False)
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.default_int_handler)  # as Ctrl-C: nothing may be left over
    began = time.monotonic()
    try:
        config = read_project(folder)
        link = with_project(local_only(url), config.project.id) if url else None
        with contextlib.ExitStack() as stack:
            study = None if link else stack.enter_context(_held(folder, data, play > 0, console))
            place = study.data if study else data
            with _bar(console, bots) as watch:
                accounts = asyncio.run(
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
            found = look(place, config.project.id, accounts, recorded=config.trial.s3upload) if place else None
            fine = report(console, accounts, found, left, time.monotonic() - began)
            if not fine and study:
                console.print(f"What local mode and the servers said is in {_keep_logs(study)}.", soft_wrap=True)
    except (ConfigErrors, Refused, NotHeld) as error:
        console.print(str(error), markup=False, soft_wrap=True)
        raise typer.Exit(1) from None
    except (KeyboardInterrupt, asyncio.CancelledError):
        raise typer.Exit(130) from None
    raise typer.Exit(0 if fine else 1)


if __name__ == "__main__":
    typer.run(main)
