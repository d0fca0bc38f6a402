"""What a botocore error says."""

from __future__ import annotations

from botocore.exceptions import ClientError


def code(error: ClientError) -> str:
    """AWS's name of the error, such as `NoSuchKey`."""
    return str(error.response.get("Error", {}).get("Code", ""))


def message(error: ClientError) -> str:
    """AWS's sentence about it."""
    return str(error.response.get("Error", {}).get("Message", ""))


def status(error: ClientError) -> int:
    """The HTTP status it came with; 0 if there was none."""
    return int(error.response.get("ResponseMetadata", {}).get("HTTPStatusCode", 0))
