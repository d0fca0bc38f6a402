"""`start`: the server of environments within a program, as Gymie has it."""

from __future__ import annotations

import sys
from typing import Any


def start(host: str = "127.0.0.1", port: int = 5000, **options: Any) -> None:
    """Serve environments at ws://host:port/gym until Ctrl-C or SIGTERM. What `override` has replaced is used.

    `options` are those of `trial.gym.server.serve`, such as `limits`. Unlike Gymie it listens at this machine alone if
    it is given no host. If the address cannot be used it says so and returns, as Gymie does.
    """
    from trial.gym.server import serve  # noqa: PLC0415 - a program that is only a client does without

    try:
        serve(host, port, **options)
    except OSError as error:
        print(f"Address ws://{host}:{port} cannot be used: {error.strerror}", file=sys.stderr)
