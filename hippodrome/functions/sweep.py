"""Timer: removes resources that no open record owns, sends lost messages again, and reports both as metrics."""

import os
from dataclasses import asdict
from typing import Any

from hippodrome.control import metrics
from hippodrome.control.servers.sweep import Sweep
from hippodrome.functions import installed


def handler(event: dict[str, Any], context: object) -> dict[str, int]:
    """Run a sweep, and return its counts, which are the fields of `SweepResult`.

    Writes metrics to the log if the variable `STACK` names the installation.
    """
    sweep = Sweep(installed.platform())
    swept = sweep.run()
    if stack := os.environ.get("STACK"):
        metrics.report(stack, sweep.running, swept)
    return asdict(swept)
