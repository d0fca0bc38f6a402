"""Switches the log off while a test tries thousands of faults."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator

from hippodrome.control.log import logger


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Log nothing below CRITICAL within the block."""
    level = logger.log_level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
