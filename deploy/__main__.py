"""`python -m deploy COMMAND` is `hippodrome COMMAND`, also with a Python that lacks the packages."""

import sys

try:
    from hippodrome.cli import main
except ModuleNotFoundError:
    from deploy import venv

    venv.go_on()

if __name__ == "__main__":
    sys.exit(main())
