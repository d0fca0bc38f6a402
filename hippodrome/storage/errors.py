"""What storage raises."""

from __future__ import annotations


class RetryLater(Exception):
    """Not possible yet: the queue should deliver the message again."""

    expected = True  # logged as information, see `log.failure`
