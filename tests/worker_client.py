"""The command that pytest-xdist runs for a worker: it hands its files to `tests.forked_workers`, and waits for the end of the worker.

It imports next to nothing, since there is one of it for each worker.
"""

import contextlib
import os
import signal
import socket
import sys

signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the worker's, which ends this process
with socket.socket(socket.AF_UNIX) as forks:
    forks.connect(sys.argv[1])
    socket.send_fds(forks, [b"fork"], [0, 1, 2])
    for file in (0, 1):  # the worker's alone: pytest-xdist sees by them that it has ended
        os.close(file)
    code = b""
    with contextlib.suppress(ConnectionResetError):
        code = forks.recv(100)
os._exit(int(code or 1))
