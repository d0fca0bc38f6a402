"""Sends messages between functions: by SNS topics, and with a delay by the SQS queue of `task_changed`."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

from hippodrome.control.ports import Message, Topic

TOPICS = {Topic.START: "START_SERVER_TOPIC_ARN", Topic.STOP: "STOP_SERVER_TOPIC_ARN"}
MAX_DELAY = 900  # seconds: SQS's longest delay


class SnsBus:
    """Implements `hippodrome.control.ports.Bus`. Messages travel as JSON."""

    def __init__(self, sns: Callable[[], Any], sqs: Callable[[], Any], need: Callable[[str], str]) -> None:
        self._sns = sns
        self._sqs = sqs
        self._need = need

    def publish(self, topic: Topic, message: Message) -> None:
        self._sns().publish(TopicArn=self._need(TOPICS[topic]), Message=json.dumps(dict(message)))

    def send_delayed(self, message: Message, seconds: int) -> None:
        """Send the message to the queue of `task_changed`, which gets it after `seconds`. AWS calls: one SendMessage.

        Raises ValueError for a delay outside SQS's limits, 0 to `MAX_DELAY` seconds.
        """
        if not 0 <= seconds <= MAX_DELAY:
            raise ValueError(f"a message can be delayed by 0 to {MAX_DELAY} seconds, not {seconds}")
        self._sqs().send_message(
            QueueUrl=self._need("TASK_QUEUE_URL"), MessageBody=json.dumps(dict(message)), DelaySeconds=seconds
        )
