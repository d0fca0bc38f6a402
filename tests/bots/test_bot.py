"""What a bot says of a request that failed."""

from __future__ import annotations

import asyncio
from random import Random

import pytest

from bots.bot import Bot


def test_a_request_that_is_not_answered_in_time_is_said_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """A TimeoutError has no text of its own."""

    async def late(*_: object, **__: object) -> None:
        raise TimeoutError

    monkeypatch.setattr("bots.bot.ask", late)
    bot = Bot("http://127.0.0.1:8000/next?projectId=x", "ada", Random(0), patience=0.1)
    report = asyncio.run(bot.run())
    assert report.errors == ["no answer from 127.0.0.1:8000/next: TimeoutError"]
    assert report.troubles == ["no answer from 127.0.0.1:8000/next: TimeoutError"]
