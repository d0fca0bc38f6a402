"""Checks the quotas: whether AWS lets as many servers run as a study needs.

A quota that allows too few servers is worth a look. It is bad only if it allows none.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from hippodrome.console.formatting import count
from hippodrome.deployment.aws import concurrency, quotas
from hippodrome.deployment.core.finding import Finding, bad, good, look
from hippodrome.deployment.operate.doctor.check_context import CheckContext

USUAL = 1.0  # vCPU of a server, if no project says how many
REQUESTS = 0.1  # executions of next_step at once for each waiting participant: 0.12 s every two seconds, rounded up
IN_LOBBY = 0.15  # the same in a lobby: its executions make four more calls of S3, one after the other
HEADROOM = 4  # standard deviations above the mean: requests come at random, and all should find room


def fargate(context: CheckContext) -> Iterator[Finding]:
    """Compare the vCPU quotas, on Spot and on demand, with what all servers need together, warm ones included."""
    cpu = max((p.size.cpu for p in context.projects if p.game_steps), default=0.0 if context.projects else USUAL)
    if not cpu:
        yield good("Fargate quotas", "No project needs servers.")
        return
    warm = sum(p.warm_servers for p in context.projects)  # they run beside the servers that participants use
    warm_cpu = sum(p.warm_servers * p.size.cpu for p in context.projects)
    need = context.at_once * cpu + warm_cpu
    beside = f" beside {count(warm, 'warm one')}" if warm else ""
    for kind, quota in (("Spot", quotas.SPOT), ("on demand", quotas.ON_DEMAND)):
        check = f"Fargate quota, {kind}"
        value = quotas.applied(context.account, quota)
        if value is None:
            yield look(
                check, "Service Quotas does not tell it.", f"Look at quota {quota.code} of Fargate in its console."
            )
            continue
        servers = int(max(0.0, value - warm_cpu) // cpu)
        text = f"{value:g} vCPU: {servers:,} servers of {cpu:g} vCPU at once{beside}"
        more = quotas.ask_for(context.account, quota, math.ceil(need))
        if value >= need:
            yield good(check, f"{text}; {context.at_once:,} are wanted.")
        elif servers == 0:
            yield bad(check, f"{text}, and {context.at_once:,} are wanted.", more)
        elif kind == "Spot":
            yield look(check, f"{text}, and {context.at_once:,} are wanted: the others have to wait.", more)
        else:
            yield look(check, f"{text}, if Spot has no room; {context.at_once:,} are wanted.", more)


def functions(context: CheckContext) -> Iterator[Finding]:
    """Check Lambda's concurrent executions, which the whole account shares."""
    free = concurrency.unreserved(context.account)
    workers = concurrency.workers(free)
    players = max((p.players for p in context.projects if p.game_steps), default=1)
    waiting = context.at_once * players
    mean = (IN_LOBBY if players > 1 else REQUESTS) * waiting
    need = workers + math.ceil(mean + HEADROOM * math.sqrt(mean))
    more = quotas.ask_for(context.account, quotas.EXECUTIONS, 1000)
    whom = f" for {waiting:,} participants of {context.at_once:,} servers" if players > 1 else ""
    if free >= need:
        yield good("Lambda quota", f"{free:,} executions at once; about {need:,} are wanted{whom}.")
    elif free > workers:
        refused = "links that are opened in the same second may show an error"
        yield look("Lambda quota", f"{free:,} executions at once; about {need:,} are wanted{whom}: {refused}.", more)
    else:
        few = f"{free:,} executions at once, and about {need:,} are wanted{whom}: pages will fail."
        yield bad("Lambda quota", few, more)
