"""`python -m trial.programs.environments_process FD`: the process that makes environments beside a participant's game.

FD is one end of a socket pair, over which the trial server hands connections to this process. The process ends with
that server, and the environments end with the process. The game has priority in processor time and memory.
"""

from __future__ import annotations

import contextlib
import os
import socket
import sys
from pathlib import Path
from typing import Any

from trial.gym import linux
from trial.gym.limits import Limits
from trial.gym.processes import serve_from
from trial.programs.environments import MAX_PROGRAMS, MAX_REPLY, MAX_REQUEST

LIMITS = Limits(
    connections=2 * MAX_PROGRAMS,  # a connection that is closing may still be counted here
    workers=MAX_PROGRAMS,
    environments=16,
    seconds=30.0,
    idle_seconds=600.0,
    megabytes=256,
    processes=4,
    message_bytes=MAX_REQUEST,
    reply_bytes=MAX_REPLY,
)


class HandedConnections:
    """Acts as a listening socket whose connections come as file descriptors over the socket `handing`."""

    def __init__(self, handing: socket.socket) -> None:
        self._handing = handing

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection. Raises BlockingIOError if none waits.

        Raises KeyboardInterrupt, which ends this process, if the trial server has closed its end.
        """
        data, descriptors, _, _ = socket.recv_fds(self._handing, 1, 1)
        if not data:
            raise KeyboardInterrupt
        return socket.socket(fileno=descriptors[0]), None

    def fileno(self) -> int:
        return self._handing.fileno()

    def setblocking(self, flag: bool, /) -> None:
        self._handing.setblocking(flag)

    def close(self) -> None:
        self._handing.close()


def main() -> int:
    """Serve until the trial server ends, and return the exit status."""
    sys.dont_write_bytecode = True  # because of agent.py, as in trial/__main__.py
    linux.die_with_parent()
    os.nice(19)
    with contextlib.suppress(OSError):  # Linux only: if memory runs out, it kills the highest score first (proc(5))
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    handing = HandedConnections(socket.socket(fileno=int(sys.argv[1])))
    return serve_from(handing, LIMITS, modules=["trial.programs.agent_environments"])


if __name__ == "__main__":
    sys.exit(main())
