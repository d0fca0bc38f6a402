"""`start`, which runs the server of environments in a program, as Gymie's `start` does."""

from __future__ import annotations

import sys
import threading
from functools import partial
from typing import Any

from trial.gym.errors import unusable


def start(host: str = "127.0.0.1", port: int = 5000, **options: Any) -> None:
    """Serve environments at ws://host:port/gym until Ctrl-C or SIGTERM, with the functions of `override`.

    It prints the address once it listens. Without a `host` it listens at this machine alone, unlike Gymie. If the
    address cannot be used, it prints a sentence and returns, as Gymie does. `options` are those of
    `trial.gym.processes.serve`, such as `limits`. Raises RuntimeError outside of the main thread, where signals cannot
    be received.
    """
    from trial.gym.processes import serve, tell  # noqa: PLC0415 - a program that is only a client needs no server

    if threading.current_thread() is not threading.main_thread():
        raise RuntimeError("The server must be started in the main thread of the program: signals end it.")
    try:
        serve(host, port, **{"ready": partial(tell, host), **options})
    except (OSError, UnicodeError) as error:
        print(f"Address ws://{host}:{port} cannot be used: {unusable(error)}", file=sys.stderr)
