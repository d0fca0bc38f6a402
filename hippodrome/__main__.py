"""`python -m hippodrome COMMAND` is the command `hippodrome` (hippodrome/cli.py), also where that is not on PATH."""

import os
import sys

if not sys.flags.safe_path and sys.path[0] == os.getcwd():
    sys.path.append(sys.path.pop(0))  # the present folder may be a study's, whose files must hide no module of ours

from hippodrome.cli import main

if __name__ == "__main__":
    sys.exit(main())
