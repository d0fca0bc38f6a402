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

LEAST = 2  # that MaximumConcurrency takes
USUAL = 20  # servers that start at once: RunTask takes 20 a second, and each of them takes about one
OTHERS = 2 * LEAST  # of task_changed and stop_server: Route 53 takes a zone's changes one after the other anyway
PARAMETER = "StartConcurrency"


def starts(limit: int) -> int:
    """MaximumConcurrency of start_server in an account with so many executions. At least half of them stay for pages.

    In a small account fewer stay, because each of the three mappings must have at least 2: of 10 executions, 4 stay.
    """
    return min(USUAL, max(LEAST, limit // 2 - OTHERS))


def workers(limit: int) -> int:
    """Executions that the functions behind queues can take in an account that has so many."""
    return starts(limit) + OTHERS


def parameters(limit: int) -> dict[str, str]:
    """The template's parameters for an account that has so many executions (`unreserved`)."""
    return {PARAMETER: str(starts(limit))}


def unreserved(account: Account) -> int | None:
    """Executions that the account has in this Region and no function has reserved; None if Lambda does not say."""
    try:
        limit = account.client("lambda").get_account_settings()["AccountLimit"]
        return int(limit.get("UnreservedConcurrentExecutions", limit["ConcurrentExecutions"]))
    except (ClientError, KeyError):
        return None
