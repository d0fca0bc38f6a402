"""`python -m deploy COMMAND`: runs a command of hippodrome/deployment/."""

import sys

from hippodrome.deployment.__main__ import main

if __name__ == "__main__":
    sys.exit(main())
