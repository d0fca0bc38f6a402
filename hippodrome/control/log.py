"""Writes the functions' log: JSON lines without ids, answers or tokens.

A line identifies a participant at most by the name of a server, which is a hash. Exceptions are logged by their types
and their place in the code, because their texts may quote what a participant sent.
"""

from __future__ import annotations

import traceback

from aws_lambda_powertools import Logger

logger = Logger(service="hippodrome", log_uncaught_exceptions=False)


def failure(text: str, error: BaseException, **fields: object) -> None:
    """Log an error without its message: its type, the types of its causes, the place in the code, and AWS's code.

    An error whose attribute `expected` is true, such as `RetryLater`, is logged at the level INFO, others at ERROR.
    """
    chain: list[str] = []
    cause: BaseException | None = error
    while cause is not None and len(chain) < 5:
        chain.append(type(cause).__name__)
        cause = cause.__cause__ or cause.__context__
    frames = [f"{f.filename.rsplit('/', 2)[-1]}:{f.lineno} {f.name}" for f in traceback.extract_tb(error.__traceback__)]
    log = logger.info if getattr(error, "expected", False) else logger.error
    log(text, extra={"error": chain, "where": frames[-6:], "code": _aws_code(error), **fields})


def _aws_code(error: BaseException) -> str | None:
    """The error code of a botocore ClientError, such as `ThrottlingException`; its message stays out."""
    response = getattr(error, "response", None)
    return response.get("Error", {}).get("Code") if isinstance(response, dict) else None
