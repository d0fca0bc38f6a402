"""The process that makes environments beside a participant's game: `python -m trial.programs.environments_process FD`.

FD is one end of a socket pair, over which the trial's server hands it connections. It ends with that server, and its
environments with it. The game goes first, in time and in memory.
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
from trial.programs.environments import LARGEST_REPLY, LARGEST_REQUEST, MOST

LIMITS = Limits(
    connections=2 * MOST,  # one that is closing may still be counted here
    workers=MOST,
    environments=16,
    seconds=30.0,
    idle_seconds=600.0,
    megabytes=256,
    processes=4,
    message_bytes=LARGEST_REQUEST,
    reply_bytes=LARGEST_REPLY,
)


class Handed:
    """Stands for a listening socket: connections come as descriptors over another one."""

    def __init__(self, handing: socket.socket) -> None:
        self._handing = handing

    def accept(self) -> tuple[socket.socket, Any]:
        """The next connection. Raises BlockingIOError if there is none, and KeyboardInterrupt without the trial."""
        told, found, _, _ = socket.recv_fds(self._handing, 1, 1)
        if not told:
            raise KeyboardInterrupt
        return socket.socket(fileno=found[0]), None

    def fileno(self) -> int:
        return self._handing.fileno()

    def setblocking(self, flag: bool, /) -> None:
        self._handing.setblocking(flag)

    def close(self) -> None:
        self._handing.close()


def main() -> int:
    """Serve until the trial's server is gone; the exit status."""
    sys.dont_write_bytecode = True  # as the trial: it imports agent.py
    linux.die_with_parent()
    os.nice(19)
    with contextlib.suppress(OSError):  # Linux alone has it; the kernel ends the highest first (proc(5))
        Path("/proc/self/oom_score_adj").write_text("1000", encoding="ascii")
    handing = Handed(socket.socket(fileno=int(sys.argv[1])))
    return serve_from(handing, LIMITS, modules=["trial.programs.agent_environments"])


if __name__ == "__main__":
    sys.exit(main())
