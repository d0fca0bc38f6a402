"""`python typed.py -m MODULE …` in a shell: has the command run in a process that a forker makes (`testing/preloaded.py`).

The environment variable FORKER is the file descriptor of the socket to the forker, which the shell has inherited.
"""

from __future__ import annotations

import json
import os
import socket
import sys

if __name__ == "__main__":
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with socket.socket(fileno=int(os.environ.pop("FORKER"))) as forker, theirs:
        request = {
            "module": sys.argv[2],
            "arguments": sys.argv[3:],
            "cwd": os.getcwd(),
            "env": {**os.environ},
            "session": False,
            "safe_path": False,
            "starts": False,
        }
        socket.send_fds(forker, [json.dumps(request).encode()], [theirs.fileno(), 1, 2])
    process, code = int(ours.recv(100)), int(ours.recv(100))
    sys.exit(code if code >= 0 else 128 - code)
