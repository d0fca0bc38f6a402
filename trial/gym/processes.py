"""Starts a server of environments: forks the spawner (`spawner.py`), then listens in this process (`server.py`).

`python -m trial.gym` and `start` (`embedded.py`) call it.
"""

from __future__ import annotations

import os
import resource
import signal
import socket
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from trial.gym import handover
from trial.gym.limits import Limits
from trial.gym.server import PATH, WITHOUT_HANDSHAKE, GymServer, ListeningSocket


def serve(
    host: str,
    port: int,
    limits: Limits | None = None,
    *,
    modules: Sequence[str] = (),
    origins: Sequence[str] = (),
    output: bool = False,
    record: Path | None = None,
    ready: Callable[[int], None] = lambda _: None,
) -> int:
    """Serve environments until SIGINT or SIGTERM. Return the exit status.

    `modules` are imported in the spawner, before environments are made. Pages of `origins` may connect. `output` shows
    what environments print. `record` is a folder for recordings. `ready` is called with the port once it listens.
    Raises OSError or UnicodeError if the address cannot be used.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.create_server((host, port), family=family, backlog=512) as listener:
        return serve_from(
            listener,
            limits or Limits(),
            modules=modules,
            origins=origins,
            output=output,
            record=record,
            ready=lambda: ready(listener.getsockname()[1]),
        )


def serve_from(
    listener: ListeningSocket,
    limits: Limits,
    *,
    modules: Sequence[str] = (),
    origins: Sequence[str] = (),
    output: bool = False,
    record: Path | None = None,
    ready: Callable[[], None] = lambda: None,
) -> int:
    """Serve environments, as `serve` does, to the connections of `listener`. `ready` is called without a port."""
    _allow_files(limits.connections + 2 * WITHOUT_HANDSHAKE)
    control, spawner = _fork_spawner(listener, limits, modules, output=output, record=record)
    with control:
        if not _is_ready(control):
            os.waitpid(spawner, 0)
            return 1
        server = GymServer(listener, control, limits, origins)
        before = signal.signal(signal.SIGTERM, _interrupt)
        try:
            ready()
            server.run()
        except KeyboardInterrupt:
            return 0
        except EOFError as error:
            print(f"The server ends: {error}.", file=sys.stderr)
            return 1
        finally:
            server.close()
            control.close()
            signal.signal(signal.SIGTERM, before)
            os.waitpid(spawner, 0)


def tell(host: str, port: int) -> None:
    """Print where environments are served."""
    shown = f"[{host}]" if ":" in host else host
    print(f"Environments are served at ws://{shown}:{port}{PATH}. Ctrl-C ends it.", flush=True)


def _allow_files(count: int) -> None:
    """Let this process open `count` files, or as many as the system allows."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft != resource.RLIM_INFINITY and soft < count:
        most = count if hard == resource.RLIM_INFINITY else min(count, hard)
        resource.setrlimit(resource.RLIMIT_NOFILE, (most, hard))


def _fork_spawner(
    listener: ListeningSocket, limits: Limits, modules: Sequence[str], *, output: bool, record: Path | None
) -> tuple[socket.socket, int]:
    """Start the spawner. Return this process's end of the socket to it, and the spawner's process id."""
    ours, theirs = socket.socketpair()
    sys.stdout.flush()
    sys.stderr.flush()
    pid = os.fork()
    if pid:
        theirs.close()
        return ours, pid
    status = 1
    try:
        ours.close()
        listener.close()
        from trial.gym import spawner  # noqa: PLC0415 - the process that listens must not import numpy and gymnasium

        status = spawner.main(theirs, limits, modules, output=output, record=record)
    except KeyboardInterrupt:
        status = 0
    finally:
        sys.stderr.flush()
        os._exit(status)


def _is_ready(control: socket.socket) -> bool:
    """Wait for the spawner's first message. Return False if the spawner has ended instead."""
    received = bytearray()
    while handover.read_ended(received) is None:
        data = control.recv(4096)
        if not data:
            return False
        received += data
    return True


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt
