"""The function that registers projects, as the commands ask it: it alone writes the list and signs links."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from deploy.account import Account, Installation
from deploy.problem import Problem


def ask(account: Account, installation: Installation, event: Mapping[str, Any]) -> dict[str, Any]:
    """What the function answers; empty if that is no object. Raises `Problem` if it failed."""
    reply = account.client("lambda").invoke(
        FunctionName=installation["RegisterFunction"], Payload=json.dumps(event).encode()
    )
    body = reply["Payload"].read()
    if reply.get("FunctionError"):
        raise Problem(
            "The function that registers projects failed.",
            "Run it again. If it stays, `python -m deploy logs update_project_master_list` tells why.",
        )
    try:
        answer = json.loads(body)
    except ValueError:
        answer = None
    return answer if isinstance(answer, dict) else {}
