"""The exception `RetryLater` of storage and the services."""

from __future__ import annotations


class RetryLater(Exception):
    """The message cannot be handled now. The queue should deliver it again."""

    expected = True  # so that `log.failure` logs these errors as information
