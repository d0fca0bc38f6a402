"""How many invocations the functions behind queues may have at once, so that participants' pages always find room.

All functions of an account share its concurrent executions in a Region: 1,000, and in many new accounts 10 (Lambda
Developer Guide, "Lambda quotas"; AWS raises them on request, quota L-B99A9384). If none is free, API Gateway answers a
participant's request with an error. Concurrency cannot be reserved for pages in a small account: Lambda refuses
PutFunctionConcurrency unless 100 executions, or all if the account has fewer, stay unreserved (API Reference,
PutFunctionConcurrency; "below its minimum value of [10]", awslabs/fhir-works-on-aws-deployment issue 691). So the
queues are kept small instead, by `MaximumConcurrency` of their event source mappings, which takes 2 to 1,000 (API
Reference, ScalingConfig).
"""

from __future__ import annotations

from botocore.exceptions import ClientError

from hippodrome.deployment.aws.account import Account

LEAST = 2  # the smallest value that MaximumConcurrency takes
USUAL = 20  # servers that start at once: ECS allows 20 RunTask a second, and a start takes about a second
OTHERS = 2 * LEAST  # task_changed and stop_server: more would wait, since Route 53 takes a zone's changes one by one
PARAMETER = "StartConcurrency"


def starts(limit: int) -> int:
    """Return MaximumConcurrency of start_server for an account's `limit` executions; at least half stay for pages.

    In a small account fewer stay, because each of the three mappings must have at least 2: of 10 executions, 4 stay.
    """
    return min(USUAL, max(LEAST, limit // 2 - OTHERS))


def workers(limit: int) -> int:
    """Return the most executions that the functions behind queues take in an account with `limit` executions."""
    return starts(limit) + OTHERS


def parameters(limit: int) -> dict[str, str]:
    """Return the template's parameters for an account with `limit` executions, the number that `unreserved` returns."""
    return {PARAMETER: str(starts(limit))}


def unreserved(account: Account) -> int:
    """Ask Lambda how many concurrent executions the account has in this Region that no function has reserved.

    Raises ClientError if Lambda refuses, KeyError if its answer has no limit.
    """
    limit = account.client("lambda").get_account_settings()["AccountLimit"]
    return int(limit.get("UnreservedConcurrentExecutions", limit["ConcurrentExecutions"]))


def unreserved_or_none(account: Account) -> int | None:
    """Return the same as `unreserved`; None if Lambda does not tell."""
    try:
        return unreserved(account)
    except (ClientError, KeyError):
        return None
