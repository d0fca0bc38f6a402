"""`start`: the server of environments within a program, as Gymie has it."""

from __future__ import annotations

import sys
import threading
from functools import partial
from typing import Any

from trial.gym.errors import unusable


def start(host: str = "127.0.0.1", port: int = 5000, **options: Any) -> None:
    """Serve environments at ws://host:port/gym until Ctrl-C or SIGTERM. What `override` has replaced is used.

    It prints where, once it listens. `options` are those of `trial.gym.processes.serve`, such as `limits`. Unlike Gymie
    it listens at this machine alone if it is given no host. If the address cannot be used it says so and returns, as
    Gymie does. Raises RuntimeError beside the main thread, where signals cannot be received.
    """
    from trial.gym.processes import serve, tell  # noqa: PLC0415 - a program that is only a client does without

    if threading.current_thread() is not threading.main_thread():
        raise RuntimeError("The server must be started in the main thread of the program: signals end it.")
    try:
        serve(host, port, **{"ready": partial(tell, host), **options})
    except (OSError, UnicodeError) as error:
        print(f"Address ws://{host}:{port} cannot be used: {unusable(error)}", file=sys.stderr)
