"""What all tests share."""

from __future__ import annotations

import io
from collections.abc import Iterator

import pytest


@pytest.fixture
def log() -> Iterator[io.StringIO]:
    """Everything the functions log during a test, as it would reach CloudWatch."""
    from hippodrome.log import logger

    handler = logger.registered_handler
    text = io.StringIO()
    before = handler.setStream(text)  # type: ignore[attr-defined]
    yield text
    handler.setStream(before)  # type: ignore[attr-defined]
