"""`hippodrome run`: runs a study on this machine."""

from __future__ import annotations

import contextlib
import errno
import os
import resource
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import psutil
import typer

from hippodrome.console.arguments import StudyFolders
from hippodrome.console.problem import Exit, Problem
from hippodrome.console.run_state import EARLIER, STATE
from hippodrome.local import lab, requirements
from hippodrome.local.activity.function_log import function_log
from hippodrome.local.activity.log import ActivityLog
from hippodrome.local.backend import files
from hippodrome.local.backend.processes import end_everything
from hippodrome.local.publish import NotPublished
from hippodrome.local.study import Study, from_here
from hippodrome.local.study_folder import must_hold_study
from hippodrome.local.web import server
from hippodrome.local.web.access import origin_of

LOOK = 0.5  # seconds between two looks: a signal that reaches another thread does not wake the main one


def command(
    folders: StudyFolders = None,
    *,
    port: Annotated[int, typer.Option(help="If it is in use, the next free one is taken. 0: any free one.")] = 8000,
    data: Annotated[
        Path | None,
        typer.Option(help="Where answers and recordings are kept; else data/ in STUDY.", show_default=False),
    ] = None,
    host: Annotated[
        str,
        typer.Option(
            help="Serve a lab: an address or name of this machine, or 0.0.0.0 for all. Else the study is for this "
            "machine only."
        ),
    ] = server.HOST,
    origin: Annotated[
        list[str] | None,
        typer.Option(
            help="Answer pages of this origin too, such as another front end at http://localhost:3000. "
            "May be given several times.",
            show_default=False,
        ),
    ] = None,
    tls: Annotated[
        bool,
        typer.Option(
            "--tls", help="Serve pages by https, and servers by TLS: at names below localhost, or with --host there."
        ),
    ] = False,
    certificate: Annotated[
        Path | None,
        typer.Option(help="With --host: a PEM file with your own certificate and its chain.", show_default=False),
    ] = None,
    key: Annotated[
        Path | None, typer.Option(help="With --certificate: the PEM file of its key.", show_default=False)
    ] = None,
    names: Annotated[
        str | None,
        typer.Option(
            help="With --tls: `hash`, or `userId` to name servers after participants' ids.", show_default=False
        ),
    ] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Begin without data; earlier data are moved aside.")] = False,
    fake_model: Annotated[
        bool,
        typer.Option(
            "--fake-model", help="Let a stand-in answer instead of the language model, even if LLM_KEY is set."
        ),
    ] = False,
    starter: Annotated[
        int | None, typer.Option(help="End the study when the process with this id has ended.", hidden=True)
    ] = None,
) -> None:
    """Run the study on this machine, and print its link. What its requirements.txt names is installed first.

    Answers and recordings are kept in its folder data/ from run to run. Ctrl-C ends the study. With --host, computers
    and phones of this network take part, and several studies may be named: their data are in data/, here.
    """
    folders = folders or [Path()]
    for folder in folders:
        must_hold_study(folder)
    is_lab = host not in (server.HOST, "localhost")
    _check_options(len(folders), is_lab=is_lab, tls=tls, names=names, certificate=certificate, key=key)
    origins = [_origin(given) for given in origin or ()]
    place = lab.host_of(host) if is_lab else None
    for folder in folders:
        requirements.prepare(folder)
    os.umask(0o077)  # answers are personal data: only their owner may read the files of this process and its servers
    if data is None:
        data = folders[0] / "data" if len(folders) == 1 else Path("data")
    new_study = partial(
        Study,
        origins=origins,
        tls=tls or certificate is not None,
        names=names,
        host=place,
        fake_model=fake_model,
        certificate=(certificate, key) if certificate and key else None,
    )
    try:
        _run_study(folders, port, data, fresh, activity_log=ActivityLog(), new_study=new_study, starter=starter)
    except files.InUse as error:
        at = f", at {error}" if str(error) else ""
        raise Problem(f"A study already runs with the data in {data}{at}.", "End it there with Ctrl-C first.") from None
    except NotPublished as error:
        raise Problem("The study cannot run yet:", details=error.problems) from None
    except server.NoPort as error:
        raise Problem(f"{error}.") from None
    except OSError as error:
        raise Problem(f"The study cannot run with the data in {data}: {_reason(error)}.", _remedy(error)) from None


def _check_options(
    number: int, *, is_lab: bool, tls: bool, names: str | None, certificate: Path | None, key: Path | None
) -> None:
    """Raise `Problem` if these options do not go together. `number` is that of the studies."""
    wrong = None
    if names is not None and is_lab:
        wrong = "--names has no effect with --host: a lab's servers are at the address of its pages."
    elif names is not None and (names not in ("hash", "userId") or not tls):
        wrong = "--names is hash or userId, and needs --tls: without it, browsers find servers by their addresses."
    elif number > 1 and not is_lab:
        wrong = "Several studies at once need --host: without it, each study has a server of its own."
    elif (certificate is None) != (key is None):
        wrong = "--certificate and --key belong together."
    elif certificate is not None and not is_lab:
        wrong = "--certificate needs --host: for names of this machine alone, --tls makes a certificate."
    if wrong:
        raise Problem(wrong, exit_code=Exit.MISUSE)


def _origin(given: str) -> str:
    """Return an origin as browsers write it. Raises `Problem` if this is none."""
    found = origin_of(given)
    if found is None:
        raise Problem(f"--origin {given} is no origin.", "Write it like http://localhost:3000.", exit_code=Exit.MISUSE)
    return found


def _run_study(
    folders: Sequence[Path],
    port: int,
    data: Path,
    fresh: bool,
    *,
    activity_log: ActivityLog,
    new_study: Callable[..., Study],
    starter: int | None,
) -> None:
    """Run the study until a signal or the end of the process `starter` ends it.

    Raises InUse, OSError, and the errors of `Study`.
    """
    root = data.resolve().parent / STATE
    state = root / data.resolve().name
    root.mkdir(parents=True, exist_ok=True)
    hold = files.Hold(root / f"{state.name}.lock")
    if fresh:
        _move_aside(data.resolve(), state, activity_log)
    _allow_more_files()
    with _signals() as ended, function_log(state / "logs", activity_log):
        study = new_study(folders, data, state, port, activity_log)
        hold.write(f"{study.server.url} (process {os.getpid()})")
        try:
            study.start()
            _wait(ended, starter)
        finally:
            study.close()


def _wait(ended: threading.Event, starter: int | None) -> None:
    """Return once `ended` is set, or the process `starter` has ended."""
    process = None
    with contextlib.suppress(psutil.NoSuchProcess):
        process = psutil.Process(starter) if starter is not None else None
    while not ended.wait(LOOK):
        if starter is not None and (process is None or not process.is_running()):
            return


_REMEDIES = {
    errno.ENOSPC: "Make room on this disk, or put the data elsewhere with --data FOLDER.",
    errno.EDQUOT: "Make room on this disk, or put the data elsewhere with --data FOLDER.",
    errno.EMFILE: "Allow this process more open files (`ulimit -n 8192`), and try again.",
    errno.ENFILE: "Close other programs, and try again.",
}
_ELSEWHERE = "Put the data where you may write with --data FOLDER, or change who may write there."


def _reason(error: OSError) -> str:
    return (error.strerror or str(error)).rstrip(".")


def _remedy(error: OSError) -> str:
    return _REMEDIES.get(error.errno or 0, _ELSEWHERE)


def _move_aside(data: Path, state: Path, activity_log: ActivityLog) -> None:
    """End the study's servers, and move its data and state into the folder `earlier`, so that this run begins anew."""
    end_everything(state)
    place = state.parent / EARLIER / f"{data.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for folder, name in ((data, "data"), (state, "state")):
        if folder.exists():
            place.mkdir(parents=True, exist_ok=True)
            folder.rename(place / name)
    if (place / "data").exists():
        activity_log.show(f"Earlier data are in {from_here(place / 'data')} now.")


def _allow_more_files() -> None:
    """Raise this process's limit of open files: each server takes a few, and macOS allows 256 by default."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = 8192 if hard == resource.RLIM_INFINITY else min(8192, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


@contextlib.contextmanager
def _signals() -> Iterator[threading.Event]:
    """An event that is set when a signal asks the process to end. The third signal ends it at once."""
    ended, signals = threading.Event(), list[int]()

    def count(number: int, _frame: object) -> None:
        ended.set()
        signals.append(number)
        if len(signals) > 2:  # the next start ends the servers that still run
            os._exit(1)

    before = {number: signal.signal(number, count) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield ended
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
