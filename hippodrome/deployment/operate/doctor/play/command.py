"""Runs the rehearsal with bots: asks first, shows its progress, and writes the transcript."""

from __future__ import annotations

import contextlib
import json
import signal
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from hippodrome.bots.crowd import SIGNALS
from hippodrome.console import screen
from hippodrome.console.formatting import count
from hippodrome.console.problem import Problem
from hippodrome.deployment.core.finding import Finding, Mark, bad
from hippodrome.deployment.cost.prices import REGION
from hippodrome.deployment.operate.doctor.check_context import CheckContext
from hippodrome.deployment.operate.doctor.play import upkeep
from hippodrome.deployment.operate.doctor.play.play import Play
from hippodrome.deployment.operate.doctor.play.transcript import Transcript
from hippodrome.deployment.operate.doctor.rehearsal import CHECK, project_for

QUIET = 30.0  # seconds between two lines of progress, if there is no terminal


def played(
    context: CheckContext, bots: int, *, minutes: int, yes: bool, file: Path | None
) -> tuple[list[Finding], dict[str, Any]]:
    """Ask, rehearse, and write the transcript into `file`. Return the findings, and the transcript as JSON data.

    Raises `Problem` if the answer is no, or the file's folder does not exist.
    """
    project = project_for(context)
    if project is None:
        return [bad(CHECK, "No live project has a game: there is nothing to play.", "Register one with --live.")], {}
    if file is not None and not file.absolute().parent.is_dir():
        raise Problem(f"There is no folder {file.parent}.", "Make it, or name another file for the transcript.")
    usd = upkeep.estimate(project, bots)
    screen.info(
        f"{count(bots, 'bot')} and three servers more, about ten minutes, {minutes} at most. "
        f"It costs about ${usd.likely:.2f}, ${usd.high:.2f} at most (list prices of {REGION}). "
        f"{project.id} itself is not touched: a copy of it is registered, and removed at the end. "
        "One alarm is set off: its mail says that it is a rehearsal."
    )
    screen.confirm("Begin?", yes)
    began = datetime.now(UTC)
    with _as_interrupt(), _watched() as progress:
        play = Play(context, project, bots, progress, minutes)
        try:
            play.run()
        finally:
            if file is not None:
                _write(file, play.transcript, began, context.account.region, bots)
    return play.transcript.findings, play.transcript.document(began, context.account.region, bots)


def _write(file: Path, transcript: Transcript, began: datetime, region: str, bots: int) -> None:
    text = json.dumps(transcript.document(began, region, bots), indent=1, ensure_ascii=False)
    try:
        file.write_text(f"{text}\n", encoding="utf-8")
    except OSError as error:
        screen.warning(f"The transcript could not be written to {file}: {error.strerror}.")
    else:
        proven = len(transcript.proven)
        wrong = sum(line.mark is Mark.BAD for line in transcript.lines)
        screen.success(f"The transcript is in {file}: {proven} things proven, {wrong} not.")


@contextlib.contextmanager
def _watched() -> Iterator[Callable[[str], None]]:
    """Show, within the block, each call's text: in one line of a terminal, else in a line every `QUIET` seconds."""
    last = time.monotonic() - QUIET
    with screen.err.status("Rehearsing …") as status:

        def progress(text: str) -> None:
            nonlocal last
            status.update(f"Rehearsing: {text}")
            if not screen.err.is_terminal and time.monotonic() - last >= QUIET:
                last = time.monotonic()
                screen.info(f"  {text}")

        yield progress


@contextlib.contextmanager
def _as_interrupt() -> Iterator[None]:
    """Let, within the block, SIGTERM and a closed terminal raise KeyboardInterrupt, so that everything is removed."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    for number in SIGNALS:
        signal.signal(number, signal.default_int_handler)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
