"""The quotas of an account that decide whether a study can be held, and how to ask AWS for more.

The codes are Service Quotas' own: Fargate's from its user guide's page on quotas; Lambda's L-B99A9384 "Concurrent
executions"; the VPCs' L-F678F1CE "VPCs per Region". New accounts may have only 6 vCPUs of Fargate, and 10 executions of
Lambda.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account


class Quota(NamedTuple):
    """A quota: the code of its service, and its own."""

    service: str
    code: str


SPOT = Quota("fargate", "L-36FBB829")  # vCPUs
ON_DEMAND = Quota("fargate", "L-3032A538")  # vCPUs
EXECUTIONS = Quota("lambda", "L-B99A9384")
VPCS = Quota("vpc", "L-F678F1CE")
_PLACES = {
    SPOT: "AWS Fargate, Fargate Spot vCPU resource count",
    ON_DEMAND: "AWS Fargate, Fargate On-Demand vCPU resource count",
    EXECUTIONS: "AWS Lambda, Concurrent executions",
    VPCS: "Amazon Virtual Private Cloud, VPCs per Region",
}
"""Where the console has them, below Service Quotas."""


def applied(account: Account, quota: Quota) -> float | None:
    """Ask for the quota's value in this account, else for AWS's default. Return None if AWS tells neither.

    Raises botocore's errors.
    """
    client: Any = account.client("service-quotas")
    for ask in (client.get_service_quota, client.get_aws_default_service_quota):
        try:
            return float(ask(ServiceCode=quota.service, QuotaCode=quota.code)["Quota"]["Value"])
        except ClientError as error:
            if errors.code(error) != "NoSuchResourceException":
                raise
        except KeyError:
            continue
    return None


def request(account: Account, quota: Quota, number: float) -> str:
    """Return where to ask for a higher value, in the console or by a command. AWS grants it after hours or days."""
    return (
        f"{number:g} in the console, Service Quotas, {_PLACES[quota]}; or by: "
        f"aws service-quotas request-service-quota-increase --service-code {quota.service} "
        f"--quota-code {quota.code} --desired-value {number:g} --region {account.region}"
    )


def ask_for(account: Account, quota: Quota, number: float) -> str:
    """Return the advice for a quota that is too small: to ask AWS for more, by the command that `request` returns."""
    return f"Ask for more: {request(account, quota, number)}"
