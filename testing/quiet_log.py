"""The log stands still while thousands of faults are tried."""

from __future__ import annotations

import contextlib
import logging
from collections.abc import Iterator

from hippodrome.log import logger


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Log nothing below CRITICAL meanwhile."""
    level = logger.log_level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)
