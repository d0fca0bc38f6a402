"""Calls the Lambda function that registers projects: only that function may write the list and sign links."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from hippodrome.console.problem import Problem
from hippodrome.deployment.aws.account import Account, Installation


def ask(account: Account, installation: Installation, event: Mapping[str, Any]) -> dict[str, Any]:
    """Call the function; return its answer, {} if that is no JSON object. Raises `Problem` if the function failed."""
    reply = account.client("lambda").invoke(
        FunctionName=installation["RegisterFunction"], Payload=json.dumps(event).encode()
    )
    body = reply["Payload"].read()
    if reply.get("FunctionError"):
        raise Problem(
            "The function that registers projects failed.",
            "Run it again. If it fails again, `hippodrome logs --all --function update_project_master_list` tells why.",
        )
    try:
        answer = json.loads(body)
    except ValueError:
        answer = None
    return answer if isinstance(answer, dict) else {}
