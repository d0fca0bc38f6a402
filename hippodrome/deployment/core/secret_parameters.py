"""The secrets of an installation's studies: parameters of Systems Manager, encrypted with the account's key for them.

Commands write a secret and never read it. Fargate alone reads it, with the task execution role, when it starts a server
of a study that needs it (`deployment/study/definition.py`).
"""

from __future__ import annotations

import re
from datetime import datetime

from botocore.exceptions import ClientError

from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws import errors
from hippodrome.control.model.project import Project
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.account import Account
from hippodrome.protocol import environment

NAMES = {environment.LLM_KEY: "the key of the language models that studies name in trial.llm"}
"""The secrets that servers know, each with its meaning."""
MAX_LENGTH = 4096  # bytes: a standard parameter, which is free, holds no more
_VALUE = re.compile(r"[!-~]+")  # it is sent in a header of HTTP


def needed(project: Project) -> list[str]:
    """Return the names of the secrets that the project's servers need."""
    return [environment.LLM_KEY] if project.uses_llm else []


def check_name(name: str) -> str:
    """Return the name. Raises `Problem` if servers know no secret of this name."""
    if name not in NAMES:
        names = ", ".join(NAMES)
        raise Problem(f"Unknown secret {name!r}; expected {names}.", exit_code=Exit.MISUSE)
    return name


def check_value(value: str) -> str:
    """Return the secret without surrounding white space. Raises `Problem`, which does not show it, if it is none."""
    value = value.strip()
    if not value:
        raise Problem("The secret is empty; nothing was stored.", "Give it at the prompt, or on stdin.")
    if len(value) > MAX_LENGTH or not _VALUE.fullmatch(value):
        raise Problem(
            "This is no key; nothing was stored.",
            f"A key has at most {MAX_LENGTH:,} letters, digits and signs of ASCII, and no spaces or line breaks.",
        )
    return value


def store(account: Account, stack: str, name: str, value: str) -> bool:
    """Store the secret, and return whether there was one of this name before."""
    parameter = resource_names.secret(stack, name)
    answer = account.client("ssm").put_parameter(
        Name=parameter, Description=NAMES[name], Value=value, Type="SecureString", Overwrite=True, Tier="Standard"
    )
    return int(answer["Version"]) > 1


def remove(account: Account, stack: str, name: str) -> bool:
    """Remove the secret, and return whether there was one."""
    try:
        account.client("ssm").delete_parameter(Name=resource_names.secret(stack, name))
    except ClientError as error:
        if errors.code(error) == "ParameterNotFound":
            return False
        raise
    return True


def stored(account: Account, stack: str) -> dict[str, datetime]:
    """Return when each secret of the stack was stored, by its name. The values are not read."""
    prefix = resource_names.secret(stack, "")
    filters = [{"Key": "Path", "Option": "OneLevel", "Values": [prefix.rstrip("/")]}]
    pages = account.client("ssm").get_paginator("describe_parameters").paginate(ParameterFilters=filters)
    parameters = {
        str(parameter["Name"]): parameter["LastModifiedDate"] for page in pages for parameter in page["Parameters"]
    }
    return {name.removeprefix(prefix): when for name, when in sorted(parameters.items())}


def missing(account: Account, stack: str, project: Project) -> list[str]:
    """Return the names of the secrets that the project's servers need, and the stack lacks."""
    names = needed(project)
    there = stored(account, stack) if names else {}
    return [name for name in names if name not in there]
