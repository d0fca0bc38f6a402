"""`python -m local [FOLDER]`: hold a study on this machine."""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import resource
import secrets
import signal
import time
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Annotated, TextIO

import typer
from rich.text import Text

from hippodrome.config import Config
from hippodrome.log import logger
from hippodrome.model import ids
from hippodrome.storage.project_cache import ProjectCache
from hippodrome.storage.secret import Secrets
from lambdas import installed, next_step, send_start_server_message, send_stop_server_message
from local import files, guard, publish, web
from local.activity_log import ActivityLog, Complaints
from local.platform import LocalPlatform
from local.tasks import end_everything

ROOT = ".hippodrome"
OTHERS = 0o077  # the permissions of everybody but the owner


def main(
    folder: Annotated[Path, typer.Argument(help="The project folder: config.yml, steps/, agent.py.")] = Path(),
    *,
    port: Annotated[int, typer.Option(help="The next free one is taken if it is in use; 0 for any.")] = 8000,
    data: Annotated[Path, typer.Option(help="Where answers and recordings are kept.")] = Path("data"),
    host: Annotated[
        str, typer.Option(help="127.0.0.1 or localhost: a study is held for this machine only.")
    ] = web.HOST,
    origin: Annotated[
        list[str] | None,
        typer.Option(
            help="Let the pages of this origin ask, too, such as another front end at http://localhost:3000. "
            "May be given several times.",
            show_default=False,
        ),
    ] = None,
    fresh: Annotated[bool, typer.Option("--fresh", help="Begin without data; those there are moved aside.")] = False,
) -> None:
    """Hold the study of FOLDER on this machine, and print its link."""
    os.umask(0o077)  # answers are personal data: the files of this process and of its servers are their owner's alone
    activity_log = ActivityLog()
    if host not in ("127.0.0.1", "localhost"):
        activity_log.show(
            f"A study cannot be held at {host}: its servers listen at 127.0.0.1, and browsers connect to them there, "
            "so nobody could play on another machine. Leave --host out (with make: HOST=)."
        )
        raise typer.Exit(1)
    origins = [guard.origin_of(given) for given in origin or ()]
    if None in origins:
        activity_log.show(
            f"--origin {(origin or [])[origins.index(None)]} is no origin. Write it like http://localhost:3000."
        )
        raise typer.Exit(1)
    try:
        _hold_study(folder, port, data, fresh, activity_log=activity_log, origins=[each for each in origins if each])
    except files.InUse as other:
        activity_log.show(
            f"A study is already held with the data in {data}{_at(str(other))}.", "End it there with Ctrl-C first."
        )
    except publish.NotPublished as error:
        activity_log.show("The study cannot be held yet:", *(f"  {problem}" for problem in error.problems))
    except web.NoPort as error:
        activity_log.show(f"{error}.")
    except OSError as error:
        activity_log.show(f"The study cannot be held with the data in {data}: {_words(error)}.", _remedy(error))
    else:
        return
    raise typer.Exit(1)


def _hold_study(
    folder: Path, port: int, data: Path, fresh: bool, *, activity_log: ActivityLog, origins: Collection[str]
) -> None:
    """Hold it until the process is asked to end. Raises OSError and what `Study` raises."""
    root = data.resolve().parent / ROOT
    state = root / data.resolve().name
    root.mkdir(parents=True, exist_ok=True)
    hold = files.Hold(root / f"{state.name}.lock")
    if root.stat().st_mode & OTHERS:  # of a version that let others read it
        root.chmod(0o700)
    if fresh:
        _move_aside(data.resolve(), state, activity_log)
    _more_files()
    with _signals() as ended, _function_log(state / "logs", activity_log):
        study = Study(folder, data, state, port, activity_log, origins=origins)
        hold.write(f"{study.server.url} (process {os.getpid()})")
        try:
            study.start()
            os.read(ended, 1)
        finally:
            study.close()


FUNCTIONS = {
    "next_step": next_step.handler,
    "send_start_server_message": send_start_server_message.handler,
    "send_stop_server_message": send_stop_server_message.handler,
}


class Study:
    """A study that is held on this machine."""

    def __init__(
        self,
        folder: Path,
        data: Path,
        state: Path,
        port: int,
        activity_log: ActivityLog,
        *,
        origins: Collection[str] = (),
    ) -> None:
        """Publish it and take a port. Raises `publish.NotPublished` and `web.NoPort`."""
        self._data = data
        self._state = state
        self._port = port
        self._activity_log = activity_log
        self._platform = LocalPlatform(
            data, state, project_folder=folder, written=activity_log.wrote, say=activity_log.trouble
        )
        installed.use(self._platform)
        self._config = publish.publish(folder, self._platform.documents)
        app = web.App(FUNCTIONS, activity_log.trouble, origins)
        self.server = web.WebServer(app, web.listen(port), self._platform.patience.met)
        self._watch = publish.Watch(folder, self._config, self._platform.documents, self._published, activity_log.say)

    def start(self) -> None:
        """Let participants in."""
        self._activity_log.study(step.key for step in self._config.steps)
        self._platform.start()
        self.server.start()
        self._banner()
        going_on = sum(bool(task.folder) for task in self._platform.tasks.playing())
        if going_on:
            self._activity_log.say(f"{going_on} server(s) of the last run play on")
        self._watch.start()
        self._activity_log.follow(self._platform.tasks, self._platform.documents.folder)

    def close(self) -> None:
        """End everything."""
        running = len(self._platform.tasks.playing())
        self._activity_log.show("", f"Ending{f', and {running} server(s) with it' if running else ''} …")
        self._watch.close()
        self.server.close()
        self._platform.close()
        self._activity_log.close()
        self._activity_log.show(f"Ended. The data are in {self._data}.")

    def _published(self, changed: Config) -> None:
        self._activity_log.study(step.key for step in changed.steps)
        installed.use(self._platform)  # functions forget the pages they have kept
        if not changed.project.live:
            self._activity_log.trouble(_NOT_LIVE)

    def _banner(self) -> None:
        project, url = self._config.project, self.server.url
        link = f"{url}/next?projectId={project.id}{self._signed() if project.signed_links else ''}"
        lines = [
            Text(""),
            Text.assemble("  ", (project.name or project.id, "bold")),
            Text(f"  {self._config.summary()}"),
            Text(""),
            Text.assemble("  Link   ", (link, "bold green")),
            Text(f"  Data   {self._data}"),
            Text(f"  Logs   {_near(self._state / 'logs')}"),
            Text(""),
            Text(f"  {_ONE_EACH if project.signed_links else _WHOEVER} Ctrl-C ends everything."),
        ]
        if self._port and not url.endswith(f":{self._port}"):
            lines.append(Text(f"  Port {self._port} is in use, so it is another one.", "yellow"))
        if not project.live:
            lines.append(Text(f"  {_NOT_LIVE}.", "yellow"))
        if self._data.stat().st_mode & OTHERS:
            lines.append(Text(f"  {_OPEN.format(data=self._data)}", "yellow"))
        if project.use_aws:
            lines.append(Text("  useAWS is true: on this machine servers are processes all the same.", "yellow"))
        self._activity_log.show(*lines, Text(""))

    def _signed(self) -> str:
        """The rest of a signed link, for somebody new."""
        project_id, user_id = self._config.project.id, secrets.token_hex(12)
        project = ProjectCache(self._platform, Secrets(self._platform.documents)).project(project_id)
        signature = ids.link_signature(project.secret if project else "", project_id, user_id)
        return f"&userId={user_id}&signature={signature}"


_WHOEVER = "Whoever opens the link gets an id of their own; add &userId=… to choose it."
_ONE_EACH = "signedLinks is true: this link is one person's; each start makes another."
_OPEN = "Other users of this machine can read the folder {data}. To change that: chmod -R go-rwx {data}"
_NOT_LIVE = "config.yml says `live: false`: participants get a 404 until it says true"


_REMEDIES = {
    errno.ENOSPC: "Make room on this disk, or put the data elsewhere with DATA=FOLDER.",
    errno.EDQUOT: "Make room on this disk, or put the data elsewhere with DATA=FOLDER.",
    errno.EMFILE: "Allow this process more open files (`ulimit -n 8192`), and try again.",
    errno.ENFILE: "Close other programs, and try again.",
}
_ELSEWHERE = "Put the data where you may write with DATA=FOLDER, or change who may write there."


def _words(error: OSError) -> str:
    return (error.strerror or str(error)).rstrip(".")


def _remedy(error: OSError) -> str:
    return _REMEDIES.get(error.errno or 0, _ELSEWHERE)


def _near(path: Path) -> Path:
    """The path as seen from here, if it is below."""
    here = Path.cwd()
    return path.relative_to(here) if path.is_relative_to(here) else path


def _at(note: str) -> str:
    return f", at {note}" if note else ""


def _move_aside(data: Path, state: Path, activity_log: ActivityLog) -> None:
    """Begin anew, and lose nothing."""
    end_everything(state)
    place = state.parent / "earlier" / f"{data.name}-{time.strftime('%Y%m%d-%H%M%S')}"
    for folder, name in ((data, "data"), (state, "state")):
        if folder.exists():
            place.mkdir(parents=True, exist_ok=True)
            folder.rename(place / name)
    if (place / "data").exists():
        activity_log.show(f"Earlier data are in {_near(place / 'data')} now.")


def _more_files() -> None:
    """Each server takes a few handles; macOS allows 256 until asked for more."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = 8192 if hard == resource.RLIM_INFINITY else min(8192, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with contextlib.suppress(ValueError, OSError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


@contextlib.contextmanager
def _signals() -> Iterator[int]:
    """A handle from which a byte can be read once the process is asked to end. Who asks twice gets it at once."""
    reader, writer = os.pipe()
    asked = []

    def ask(number: int, _frame: object) -> None:
        asked.append(number)
        if len(asked) > 2:  # servers that live on are found and ended at the next start
            os._exit(1)
        os.write(writer, b"!")

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield reader
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        os.close(reader)
        os.close(writer)


@contextlib.contextmanager
def _function_log(logs: Path, activity_log: ActivityLog) -> Iterator[None]:
    """What the functions log goes to a file instead of the terminal, which gets their complaints in words."""
    logs.mkdir(parents=True, exist_ok=True)
    handler = logger.registered_handler
    complaints = Complaints(activity_log)
    with (logs / "functions.log").open("a") as file:
        log = _Log(file)
        assert isinstance(handler, logging.StreamHandler)
        before = handler.setStream(log)
        logging.getLogger(logger.name).addHandler(complaints)
        try:
            yield
        finally:
            logging.getLogger(logger.name).removeHandler(complaints)
            handler.setStream(before)


class _Log:
    """A log file that is left incomplete when the disk is full. That has been told; a traceback a line helps nobody."""

    def __init__(self, file: TextIO) -> None:
        self._file = file

    def write(self, text: str) -> None:
        with contextlib.suppress(OSError):
            self._file.write(text)

    def flush(self) -> None:
        with contextlib.suppress(OSError):
            self._file.flush()


if __name__ == "__main__":
    typer.run(main)
