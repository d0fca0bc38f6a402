"""Sends many bots at once, and ends them after a signal."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, TypeVar

from hippodrome.bots.bot import Bot
from hippodrome.bots.report import BotReport

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
T = TypeVar("T")


async def walk(
    crowd: Sequence[Bot], *, at_once: int, ramp: float, watch: Callable[[Sequence[BotReport]], None]
) -> list[BotReport]:
    """Send these bots through their study, `at_once` at a time, and return their reports in the order of the bots.

    The first bots start `ramp` seconds apart. `watch` is called with the reports five times a second. If the walk is
    cancelled, all bots end.
    """
    slots = asyncio.Semaphore(at_once)

    async def run(number: int, bot: Bot) -> None:
        await asyncio.sleep(min(number, at_once) * ramp)
        async with slots:
            await bot.run()

    async def show() -> None:
        while True:
            watch([bot.report for bot in crowd])
            await asyncio.sleep(0.2)

    showing = asyncio.create_task(show())
    try:
        async with asyncio.TaskGroup() as group:
            for number, bot in enumerate(crowd):
                group.create_task(run(number, bot))
    finally:
        showing.cancel()
    watch([bot.report for bot in crowd])
    return [bot.report for bot in crowd]


def interruptible(coroutine: Coroutine[Any, Any, T]) -> T:
    """Run the coroutine and return its result. After a signal (`SIGNALS`), cancel it and raise KeyboardInterrupt.

    The cancellation is repeated every second until the coroutine has ended, since a timeout that expires at the same
    moment swallows a cancellation.
    """

    async def run() -> T:
        loop, task = asyncio.get_running_loop(), asyncio.ensure_future(coroutine)

        def cancel() -> None:
            task.cancel()
            loop.call_later(1.0, cancel)

        for number in SIGNALS:
            loop.add_signal_handler(number, cancel)
        try:
            return await task
        finally:
            for number in SIGNALS:
                signal.signal(number, signal.default_int_handler)

    try:
        return asyncio.run(run())
    except asyncio.CancelledError:
        raise KeyboardInterrupt from None
