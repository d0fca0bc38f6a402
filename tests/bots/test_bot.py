"""A bot walks through a study, and reports requests that failed."""

from __future__ import annotations

import asyncio
from random import Random

import pytest

from hippodrome.bots.bot import Bot
from hippodrome.bots.page import VisitedPage
from hippodrome.control.config.project_keys import MAX_STEPS


def test_a_request_that_is_not_answered_in_time_is_reported_with_its_reason(monkeypatch: pytest.MonkeyPatch) -> None:
    """The reason is the error's type, since `str()` of a TimeoutError is empty."""

    async def late(*_: object, **__: object) -> None:
        raise TimeoutError

    monkeypatch.setattr("hippodrome.bots.bot.ask", late)
    bot = Bot("http://127.0.0.1:8000/next?projectId=x", "ada", Random(0), patience=0.1)
    report = asyncio.run(bot.run())
    assert report.errors == ["no answer from 127.0.0.1:8000/next: TimeoutError"]
    assert report.troubles == ["no answer from 127.0.0.1:8000/next: TimeoutError"]


class Walker(Bot):
    """A bot in a study of `pages` pages."""

    pages = 0

    async def open(self) -> VisitedPage:
        return VisitedPage(self.address, "")

    async def do(self, page: VisitedPage) -> VisitedPage | None:
        self.pages -= 1
        return page if self.pages else None


@pytest.mark.parametrize(
    ("pages", "errors"),
    [(MAX_STEPS + 1, []), (MAX_STEPS + 2, ["the study does not end: after 501 pages there is another one"])],
)
def test_a_bot_comes_to_the_end_of_the_longest_study(pages: int, errors: list[str]) -> None:
    bot = Walker("http://127.0.0.1:8000/next?projectId=x", "ada", Random(0))
    bot.pages = pages
    assert asyncio.run(bot.run()).errors == errors
