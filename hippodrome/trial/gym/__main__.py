"""Serve environments over a WebSocket: `python -m hippodrome.trial.gym`. See docs/gym.md."""

from __future__ import annotations

import argparse
import errno
import ipaddress
import sys
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path

from hippodrome.trial.gym.server import serve, unusable
from hippodrome.trial.gym.settings import Limits

_HELP = {
    "connections": "most connections at a time; each has a process",
    "seconds": "most seconds for one request",
    "idle_seconds": "seconds without a request after which a connection is closed; 0: never",
    "megabytes": "most memory for the environments of a connection",
    "processes": "most processes that the environments of a connection start",
}
_HIGHEST = 10**9


def main(arguments: Sequence[str] | None = None) -> int:
    """Serve environments until Ctrl-C or SIGTERM. Return the exit status."""
    parser = argparse.ArgumentParser(prog="python -m hippodrome.trial.gym", description=__doc__)
    parser.add_argument("-l", "--host", default="127.0.0.1", help="the address to listen at (default: this machine)")
    parser.add_argument("-p", "--port", default=5000, type=int, help="the port (default 5000; 0: any)")
    parser.add_argument(
        "--import", action="append", default=[], metavar="MODULE", help="import a module that registers environments"
    )
    parser.add_argument(
        "--origin", action="append", default=[], help="let pages of this origin connect, such as https://example.org"
    )
    parser.add_argument("--output", action="store_true", help="show what environments print")
    parser.add_argument("--record", type=Path, metavar="FOLDER", help="record all steps in this folder, for make data")
    group = parser.add_argument_group("limits")
    for field in fields(Limits):
        default = Limits.__dataclass_fields__[field.name].default
        group.add_argument(
            f"--{field.name.replace('_', '-')}",
            type=type(default),
            default=default,
            metavar="N",
            help=f"{_HELP[field.name]} (default {default:g})",
        )
    given = vars(parser.parse_args(arguments))
    limits = Limits(**{field.name: given[field.name] for field in fields(Limits)})
    for field in fields(Limits):
        least = 0 if field.name == "idle_seconds" else 1
        if not least <= given[field.name] <= _HIGHEST:
            parser.error(f"--{field.name.replace('_', '-')} must be a number from {least} to {_HIGHEST:g}")
    if not 0 <= given["port"] <= 65535:
        parser.error("--port must be a number from 0 to 65535")
    host = given["host"]
    if not _is_loopback(host):
        print(
            f"Warning: whoever can reach {host} may make environments here and use this machine; there is no password.",
            file=sys.stderr,
        )
    try:
        status = serve(
            host,
            given["port"],
            limits,
            modules=given["import"],
            origins=given["origin"],
            output=given["output"],
            record=given["record"],
        )
    except (OSError, UnicodeError) as error:
        hint = " Take another port: --port 5001." if getattr(error, "errno", None) == errno.EADDRINUSE else ""
        print(f"Cannot listen at {host}:{given['port']}: {unusable(error)}.{hint}", file=sys.stderr)
        return 1
    if status == 0:
        where = f" Recordings are in {given['record']}." if given["record"] else ""
        print(f"Ended.{where}", file=sys.stderr)  # stderr, since the reader of a pipe at stdout may have ended already
    return status


def _is_loopback(host: str) -> bool:
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


if __name__ == "__main__":
    sys.exit(main())
