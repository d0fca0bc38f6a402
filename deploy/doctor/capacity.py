"""Quotas: whether AWS will let as many servers run as a study needs.

Quota codes from Service Quotas (service `fargate`): L-36FBB829 "Fargate Spot vCPU resource count", L-3032A538 "Fargate
On-Demand vCPU resource count". New accounts have as little as 6 of each, and 10 concurrent executions of Lambda.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

from botocore.exceptions import ClientError

from deploy import concurrency
from deploy.doctor.finding import Finding, Patient, bad, good, look
from deploy.words import count
from hippodrome.aws import errors

SPOT, ON_DEMAND = "L-36FBB829", "L-3032A538"
USUAL = 1.0  # vCPU of a server, while no project says
REQUESTS = 0.1  # executions of next_step for each participant who waits: a look every two seconds, 0.12 s each
HEADROOM = 4  # standard deviations above the mean: requests come at random, and none should find no room


def fargate(patient: Patient) -> Iterator[Finding]:
    """vCPUs on Spot and on demand, against servers at once times their vCPUs, and warm ones besides."""
    cpu = patient.cpu or (0 if patient.projects else USUAL)
    if not cpu:
        yield good("Fargate quotas", "No project needs servers.")
        return
    need = patient.at_once * cpu + patient.warm_cpu
    beside = f" beside {count(patient.warm, 'warm one')}" if patient.warm else ""
    client = patient.account.client("service-quotas")
    for kind, code in (("Spot", SPOT), ("on demand", ON_DEMAND)):
        check = f"Fargate quota, {kind}"
        value = _quota(client, code)
        if value is None:
            yield look(check, "Service Quotas does not tell it.", f"Look at quota {code} of Fargate in its console.")
            continue
        servers = int(max(0.0, value - patient.warm_cpu) // cpu)
        text = f"{value:g} vCPU: {servers:,} servers of {cpu:g} vCPU at once{beside}"
        more = (
            f"Ask for more: aws service-quotas request-service-quota-increase --service-code fargate "
            f"--quota-code {code} --desired-value {math.ceil(need)} --region {patient.account.region}"
        )
        if value >= need:
            yield good(check, f"{text}; {patient.at_once:,} are wanted.")
        elif kind == "Spot" or servers == 0:
            yield bad(check, f"{text}, and {patient.at_once:,} are wanted: the others have to wait.", more)
        else:
            yield look(check, f"{text}, if Spot has no room; {patient.at_once:,} are wanted.", more)


def _quota(client: Any, code: str) -> float | None:
    """The applied value of a quota of Fargate, else AWS's default; None if neither is told."""
    for ask in (client.get_service_quota, client.get_aws_default_service_quota):
        try:
            return float(ask(ServiceCode="fargate", QuotaCode=code)["Quota"]["Value"])
        except ClientError as error:
            if errors.code(error) != "NoSuchResourceException":
                raise
        except KeyError:
            continue
    return None


def functions(patient: Patient) -> Iterator[Finding]:
    """Concurrent executions of Lambda, which the whole account shares."""
    limit = patient.account.client("lambda").get_account_settings()["AccountLimit"]
    free = int(limit.get("UnreservedConcurrentExecutions", limit["ConcurrentExecutions"]))
    workers = concurrency.workers(free)
    mean = REQUESTS * patient.at_once
    need = workers + math.ceil(mean + HEADROOM * math.sqrt(mean))
    more = (
        "Ask for more: aws service-quotas request-service-quota-increase --service-code lambda "
        f"--quota-code L-B99A9384 --desired-value 1000 --region {patient.account.region}"
    )
    if free >= need:
        yield good("Lambda quota", f"{free:,} executions at once; about {need:,} are wanted.")
    elif free > workers:
        yield look(
            "Lambda quota", f"{free:,} executions at once; about {need:,} are wanted: pages may come late.", more
        )
    else:
        yield bad("Lambda quota", f"{free:,} executions at once, and about {need:,} are wanted: pages will fail.", more)
