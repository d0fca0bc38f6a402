"""What AWS has billed, from Cost Explorer, which is a day behind and costs a cent for each request."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.aws.resource_names import TAG
from hippodrome.deployment.core import explain
from hippodrome.deployment.cost.prices import Prices

HOME = "us-east-1"  # where Cost Explorer lives
ECS = "Amazon Elastic Container Service"  # Fargate's tasks are billed under it
METRIC = "UnblendedCost"


@dataclass
class Billed:
    """A bill in US dollars, by service. `fargate`: the cost of all tasks in the region, if none has the stack's tag."""

    start: date
    end: date
    tagged: dict[str, float] = field(default_factory=dict)
    fargate: float | None = None
    requests: int = 0

    @property
    def asking(self) -> float:
        """What the requests to Cost Explorer have cost, in US dollars."""
        return self.requests * Prices().explorer_request.usd


def billed(account: Account, stack: str, start: date, end: date) -> Billed:
    """Ask Cost Explorer for the cost of all resources with the stack's tag, from `start` up to `end`, without that day.

    A tag counts from the day on which it was made a cost allocation tag (Billing, "Cost allocation tags"). Raises
    `Problem` if Cost Explorer has no data, and ClientError if it refuses.
    """
    bill = Billed(start, end)
    client = account.client("ce", HOME)
    try:
        bill.tagged = _ask(client, bill, {"Tags": {"Key": TAG, "Values": [stack], "MatchOptions": ["EQUALS"]}})
        if ECS not in bill.tagged:
            here = [
                {"Dimensions": {"Key": "SERVICE", "Values": [ECS]}},
                {"Dimensions": {"Key": "REGION", "Values": [account.region]}},
            ]
            bill.fargate = _ask(client, bill, {"And": here}).get(ECS, 0.0)
    except ClientError as error:
        code = errors.code(error)
        if code == "DataUnavailableException" or "not enabled" in errors.message(error):
            raise Problem(
                "Cost Explorer has no data of this account yet.",
                "Switch it on in the Billing console; it takes a day to fill.",
            ) from None
        raise
    return bill


def billed_or_why(account: Account, stack: str, start: date, end: date) -> tuple[Billed | None, str]:
    """Ask as `billed` does. Return the bill and ""; if there is none, None and the reason, with advice."""
    try:
        return billed(account, stack, start, end), ""
    except Exception as error:
        problem = explain.problem_from(error)
        if problem is None:
            raise
        return None, f"{problem} {problem.advice}".strip()


def _ask(client: Any, counted: Billed, where: Mapping[str, Any]) -> dict[str, float]:
    sums: dict[str, float] = {}
    token: dict[str, str] = {}
    while True:
        answer = client.get_cost_and_usage(
            TimePeriod={"Start": counted.start.isoformat(), "End": counted.end.isoformat()},
            Granularity="MONTHLY",
            Metrics=[METRIC],
            Filter=where,
            GroupBy=[{"Type": "DIMENSION", "Key": "SERVICE"}],
            **token,
        )
        counted.requests += 1
        for period in answer.get("ResultsByTime", ()):
            for group in period.get("Groups", ()):
                amount = float(group["Metrics"][METRIC]["Amount"])
                sums[group["Keys"][0]] = sums.get(group["Keys"][0], 0.0) + amount
        if not answer.get("NextPageToken"):
            return sums
        token = {"NextPageToken": answer["NextPageToken"]}
