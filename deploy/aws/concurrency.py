"""How many invocations the functions behind queues may have at once, so that participants' pages always find room.

All functions of an account share its concurrent executions in a Region: 1,000, and 10 in many a new account (Lambda
Developer Guide, "Lambda quotas"; AWS raises them on request, quota L-B99A9384). A page that finds none free is answered
by API Gateway with an error. Concurrency cannot be reserved for pages in a small account: Lambda refuses
PutFunctionConcurrency unless 100 executions stay unreserved, in a smaller account all of them (API Reference,
PutFunctionConcurrency; "below its minimum value of [10]", awslabs/fhir-works-on-aws-deployment issue 691). So the
queues are kept small instead, by `MaximumConcurrency` of their event source mappings, which takes 2 to 1,000 (API
Reference, ScalingConfig).
"""

from __future__ import annotations

from botocore.exceptions import ClientError

from deploy.aws.account import Account

LEAST = 2  # the least that MaximumConcurrency takes
USUAL = 20  # servers that start at once: ECS allows 20 RunTask a second, and a start takes about a second
OTHERS = 2 * LEAST  # of task_changed and stop_server: Route 53 takes a zone's changes one after the other anyway
PARAMETER = "StartConcurrency"


def starts(limit: int) -> int:
    """MaximumConcurrency of start_server in an account with `limit` executions. At least half of them stay for pages.

    In a small account fewer stay, because each of the three mappings must have at least 2: of 10 executions, 4 stay.
    """
    return min(USUAL, max(LEAST, limit // 2 - OTHERS))


def workers(limit: int) -> int:
    """The executions that the functions behind queues take at most, in an account with `limit` executions."""
    return starts(limit) + OTHERS


def parameters(limit: int) -> dict[str, str]:
    """The template's parameters for an account with `limit` executions (`unreserved`)."""
    return {PARAMETER: str(starts(limit))}


def unreserved(account: Account) -> int:
    """The concurrent executions that the account has in this Region and no function has reserved.

    Raises ClientError if Lambda refuses, KeyError if its answer has no limit.
    """
    limit = account.client("lambda").get_account_settings()["AccountLimit"]
    return int(limit.get("UnreservedConcurrentExecutions", limit["ConcurrentExecutions"]))


def unreserved_or_none(account: Account) -> int | None:
    """As `unreserved`, but None if Lambda does not say."""
    try:
        return unreserved(account)
    except (ClientError, KeyError):
        return None
