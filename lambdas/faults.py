"""How the functions that see servers fail tell CloudWatch why: in the log, and without a cost as long as none does."""

from __future__ import annotations

import os

from hippodrome.servers import Servers


def tell(servers: Servers) -> None:
    """Count the failures since the last call, for the alarms. Not without `STACK`, which says whose they are."""
    causes, stack = servers.failures(), os.environ.get("STACK")
    if causes and stack:
        from hippodrome import metrics  # noqa: PLC0415 - seldom needed

        metrics.report_failures(stack, causes)
