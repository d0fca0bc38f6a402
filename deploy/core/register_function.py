"""Calls the Lambda function that registers projects: only that function may write the list and sign links."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from botocore.exceptions import ClientError

from console import formatting, screen
from console.problem import Problem
from deploy.aws.account import Account, Installation
from hippodrome.model.project import MASTER_LIST, read_list


def ask(account: Account, installation: Installation, event: Mapping[str, Any]) -> dict[str, Any]:
    """Call the function; return its answer, {} if that is no JSON object. Raises `Problem` if the function failed."""
    reply = account.client("lambda").invoke(
        FunctionName=installation["RegisterFunction"], Payload=json.dumps(event).encode()
    )
    body = reply["Payload"].read()
    if reply.get("FunctionError"):
        raise Problem(
            "The function that registers projects failed.",
            "Run it again. If it fails again, `python -m deploy logs update_project_master_list` tells why.",
        )
    try:
        answer = json.loads(body)
    except ValueError:
        answer = None
    return answer if isinstance(answer, dict) else {}


def hide_secrets(account: Account, installation: Installation) -> None:
    """Let the function remove the secrets that an earlier version of the installation wrote into the list of projects.

    Researchers read that list. If this fails, nothing is lost: the next registration removes them.
    """
    try:
        found = account.platform(installation).documents.get(MASTER_LIST)
        if found is None or not read_list(found.body).secrets():
            return
        count = ask(account, installation, {"takeOver": True}).get("takenOver")
    except (Problem, ClientError, ValueError, RecursionError):
        count = None
    if isinstance(count, int):
        screen.success(
            f"{formatting.count(count, 'secret')} of an earlier version went out of the list that researchers read."
        )
    else:
        screen.warning(
            "The list that researchers read may hold secrets of an earlier version: the next `register` moves them."
        )
