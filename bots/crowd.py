"""Many bots at once, and how they are interrupted."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Coroutine, Sequence
from typing import Any, TypeVar

from bots.account import BotReport
from bots.bot import Bot

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
T = TypeVar("T")


async def walk(
    crowd: Sequence[Bot], *, at_once: int, ramp: float, watch: Callable[[Sequence[BotReport]], None]
) -> list[BotReport]:
    """Send these bots through their study, `at_once` at a time; what happened to each. Cancelling ends all of them."""
    places = asyncio.Semaphore(at_once)

    async def one(number: int, bot: Bot) -> None:
        await asyncio.sleep(min(number, at_once) * ramp)
        async with places:
            await bot.run()

    async def show() -> None:
        while True:
            watch([bot.account for bot in crowd])
            await asyncio.sleep(0.2)

    showing = asyncio.create_task(show())
    try:
        async with asyncio.TaskGroup() as group:
            for number, bot in enumerate(crowd):
                group.create_task(one(number, bot))
    finally:
        showing.cancel()
    watch([bot.account for bot in crowd])
    return [bot.account for bot in crowd]


def interruptible(walk: Coroutine[Any, Any, T]) -> T:
    """Its result. A signal cancels it, again every second until it has ended: a timeout that is over at the very
    moment of a cancellation swallows it. Raises KeyboardInterrupt then."""

    async def held() -> T:
        loop, task = asyncio.get_running_loop(), asyncio.ensure_future(walk)

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
        return asyncio.run(held())
    except asyncio.CancelledError:
        raise KeyboardInterrupt from None
