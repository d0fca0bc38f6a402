"""`hippodrome gym`: serves environments over a WebSocket. See docs/gym.md."""

from __future__ import annotations

import errno
import ipaddress
import os
import sys
from pathlib import Path
from typing import Annotated

import typer

from hippodrome.trial.gym.server import serve, unusable
from hippodrome.trial.gym.settings import Limits

_DEFAULT = Limits()
_HIGHEST = 10**9


def command(
    *,
    host: Annotated[str, typer.Option("--host", "-l", help="The address to listen at.")] = "127.0.0.1",
    port: Annotated[int, typer.Option("--port", "-p", min=0, max=65535, help="0: any free one.")] = 5000,
    modules: Annotated[
        list[str] | None,
        typer.Option(
            "--import",
            metavar="MODULE",
            help="Import a module that registers environments, such as a file in the present folder. May be given "
            "several times.",
            show_default=False,
        ),
    ] = None,
    origin: Annotated[
        list[str] | None,
        typer.Option(
            help="Let pages of this origin connect, such as https://example.org. May be given several times.",
            show_default=False,
        ),
    ] = None,
    output: Annotated[bool, typer.Option("--output", help="Show what environments print.")] = False,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Record all steps in this folder, for `hippodrome data`.", show_default=False
        ),
    ] = None,
    connections: Annotated[
        int, typer.Option(min=1, max=_HIGHEST, help="Most connections at a time; each has a process.")
    ] = _DEFAULT.connections,
    seconds: Annotated[
        float, typer.Option(min=1, max=_HIGHEST, help="Most seconds for one request.")
    ] = _DEFAULT.seconds,
    idle_seconds: Annotated[
        float,
        typer.Option(
            min=0, max=_HIGHEST, help="Seconds without a request after which a connection is closed; 0: never."
        ),
    ] = _DEFAULT.idle_seconds,
    megabytes: Annotated[
        int, typer.Option(min=1, max=_HIGHEST, help="Most memory for the environments of a connection.")
    ] = _DEFAULT.megabytes,
    processes: Annotated[
        int, typer.Option(min=1, max=_HIGHEST, help="Most processes that the environments of a connection start.")
    ] = _DEFAULT.processes,
) -> int:
    """Serve Gymnasium's environments to Gymie's clients and RemoteEnv, until Ctrl-C."""
    if (here := os.getcwd()) not in sys.path:
        sys.path.append(here)  # for --import
    if not _is_loopback(host):
        _say(
            f"Warning: whoever can reach {host} may make environments here and use this machine; there is no password."
        )
    try:
        status = serve(
            host,
            port,
            Limits(
                connections=connections,
                seconds=seconds,
                idle_seconds=idle_seconds,
                megabytes=megabytes,
                processes=processes,
            ),
            modules=modules or [],
            origins=origin or [],
            output=output,
            record=record,
        )
    except (OSError, UnicodeError) as error:
        hint = " Take another port: --port 5001." if getattr(error, "errno", None) == errno.EADDRINUSE else ""
        _say(f"Cannot listen at {host}:{port}: {unusable(error)}.{hint}")
        return 1
    if status == 0:
        where = f" Recordings are in {record}." if record else ""
        _say(f"Ended.{where}")  # at stderr, since the reader of a pipe at stdout may have ended already
    return status


def _say(line: str) -> None:
    print(line, file=sys.stderr)


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
