"""`python -m hippodrome.trial`: the server of a participant or a session. Its variables: protocol/environment.py."""

from __future__ import annotations

import os
import sys

from hippodrome.trial.server import own_certificate


def main() -> int:
    """Run the server, and return the process's exit status (`hippodrome/trial/process.py`)."""
    own = own_certificate.begin(os.environ)  # first: it waits for others while the rest is imported
    from hippodrome.trial import process  # noqa: PLC0415

    return process.run(own)


if __name__ == "__main__":
    sys.exit(main())
