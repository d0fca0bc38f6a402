"""`python -m hippodrome COMMAND` is the command `hippodrome` (hippodrome/cli.py), also where that is not on PATH."""

import sys

from hippodrome.cli import main

if __name__ == "__main__":
    sys.exit(main())
