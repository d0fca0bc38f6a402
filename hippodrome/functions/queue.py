"""Parses the batches of functions behind an SQS queue, and reports to SQS only the messages that failed.

The functions behind a topic's queue also take events that SNS sends to the function itself, as in HIPPO's setup.

`report_failures` writes metrics of failed servers to the log.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, TypeVar

from hippodrome.control.log import failure, logger
from hippodrome.control.model.messages import body_of
from hippodrome.control.ports import RetryLater

if TYPE_CHECKING:
    from hippodrome.control.servers.services import ServerServices

M = TypeVar("M")
BatchResponse = dict[str, list[dict[str, str]]]


def read(event: Mapping[str, Any], parse: Callable[[Any], M | None]) -> list[tuple[str, M]]:
    """Return the messages of a batch that `parse` accepts, each with its message id.

    A record without an id, or for which `parse` returns None, is dropped and logged without its content.
    """
    found = []
    for record in event.get("Records") or ():
        message_id = _id_of(record)
        message = parse(body_of(record))
        if message is None or not message_id:
            logger.warning("a message was dropped: it is none of ours", extra={"messageId": message_id})
        else:
            found.append((message_id, message))
    return found


def one_by_one(messages: Sequence[tuple[str, M]], act: Callable[[M], None]) -> list[str]:
    """Call `act` on each message; return the ids of the messages for which it raised."""
    failed = []
    for message_id, message in messages:
        try:
            act(message)
        except Exception as error:  # noqa: BLE001 - SQS delivers this one again; the others are processed
            failure("message failed", error, messageId=message_id)
            failed.append(message_id)
    return failed


def all_at_once(messages: Sequence[tuple[str, M]], act: Callable[[Sequence[M]], Sequence[M]]) -> list[str]:
    """Call `act` once with all messages; return the ids of the messages that `act` returns, or of all if it raises."""
    if not messages:
        return []
    try:
        again = {id(message) for message in act([message for _, message in messages])}
    except Exception as error:  # noqa: BLE001 - SQS delivers all of them again; handling a message twice does no harm
        failure("batch failed", error, messages=len(messages))
        return [message_id for message_id, _ in messages]
    return [message_id for message_id, message in messages if id(message) in again]


def response(event: Mapping[str, Any], message_ids: Sequence[str]) -> BatchResponse:
    """Return the partial batch response that makes SQS deliver these messages again.

    If the event came from SNS and a message failed, raise `RetryLater` instead. SNS invokes functions asynchronously,
    so their return value is lost; but Lambda repeats an invocation that raises:
    https://docs.aws.amazon.com/lambda/latest/dg/invocation-async-error-handling.html
    """
    if message_ids and any(isinstance(record, dict) and "Sns" in record for record in event.get("Records") or ()):
        raise RetryLater("a message of the topic failed")
    return {"batchItemFailures": [{"itemIdentifier": message_id} for message_id in message_ids]}


def _id_of(record: Any) -> str | None:
    """The id of an SQS record or of an SNS notification."""
    if not isinstance(record, dict):
        return None
    notification = record.get("Sns")
    found = notification.get("MessageId") if isinstance(notification, dict) else record.get("messageId")
    return str(found) if found else None


def report_failures(services: ServerServices) -> None:
    """Write metrics of the servers that failed since the last call.

    Writes nothing unless the variable `STACK` names the installation.
    """
    causes, stack = services.failures(), os.environ.get("STACK")
    if causes and stack:
        from hippodrome.control import metrics  # noqa: PLC0415 - seldom needed

        metrics.report_failures(stack, causes)
