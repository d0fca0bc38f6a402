"""Computes the bill of a simulated run: its counts times the list prices of `deploy/cost/prices.py`.

Data sent to participants, recordings and logs are left out, since they are not simulated (`python -m deploy cost`
estimates them).
"""

from __future__ import annotations

from collections.abc import Mapping

from deploy.cost.estimate import DNS_QUERIES
from deploy.cost.prices import FARGATE_MINIMUM, Prices, Usd
from testing import template
from testing.simulation.world import SimulatedWorld

HOUR = 3600.0
SQS_REQUESTS = 3  # requests for a message: send, receive, delete


def bill(world: SimulatedWorld, prices: Prices, *, spot: bool) -> Mapping[str, Usd]:
    """Return US dollars by kind of cost. Servers are billed as if all of them had run on Spot, or on demand."""
    calls = world.cloud.calls
    writes = calls["s3:PutObject"] + calls["s3:ListObjectsV2"]  # deletions are free
    messages = sum(queue.sent for queue in world.queues)
    hour = prices.server_hour(world.project.size.cpu, world.project.size.memory, spot=spot)
    exactly = Usd.exactly
    return {
        "servers and their public IPv4 addresses": hour * (server_seconds(world) / HOUR),
        "Lambda": exactly(_functions(world, prices)),
        "HTTP API": exactly(world.next_step.invocations * prices.http_request.usd),
        "S3 requests": exactly(calls["s3:GetObject"] * prices.s3_read.usd + writes * prices.s3_write.usd),
        "SNS and SQS": exactly(
            calls["sns:Publish"] * prices.sns_publish.usd + SQS_REQUESTS * messages * prices.sqs_request.usd
        ),
        "Route 53 queries": exactly(DNS_QUERIES.likely * len(world.platform.tasks.tasks) * prices.dns_query.usd),
    }


def server_seconds(world: SimulatedWorld) -> float:
    """Return the seconds that all tasks together have lasted, from RunTask until their containers ended, or until now.

    Fargate begins to count a little after RunTask, and bills at least `FARGATE_MINIMUM` seconds.
    """
    now = world.clock.seconds
    tasks = world.platform.tasks.tasks.values()
    return sum(max(FARGATE_MINIMUM, (now if task.closed is None else task.closed) - task.born) for task in tasks)


def _functions(world: SimulatedWorld, prices: Prices) -> float:
    """Return US dollars for the functions: billed seconds times memory, and a fee per invocation."""
    named, properties = template.functions(), template.resources("AWS::Lambda::Function")
    usd = 0.0
    for function in (world.next_step, *world.functions):
        gb = float(properties[named[function.name]]["MemorySize"]) / 1024
        usd += function.billed * gb * prices.lambda_gb_second.usd + function.invocations * prices.lambda_request.usd
    return usd
