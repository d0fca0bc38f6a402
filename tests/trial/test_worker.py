"""The agent's thread (trial/agent/worker.py)."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

from trial.agent.worker import Worker
from trial.core.effects import AgentTimeout

Heard = list[tuple[str, Any]]


def test_each_function_has_its_own_limit_and_is_given_up_once() -> None:
    async def work() -> Heard:
        worker, heard, free = Worker(), Heard(), threading.Event()
        given_up = asyncio.Event()

        def hear(name: str) -> Any:
            def done(result: Any, error: Exception | None) -> None:
                heard.append((name, error if error is not None else result))
                given_up.set() if isinstance(error, AgentTimeout) else None

            return done

        worker.submit(lambda: "quick", 30.0, hear("quick"))
        worker.submit(free.wait, 30.0, hear("slow"))
        worker.submit(lambda: "after it", 0.05, hear("late"))
        async with asyncio.timeout(10):
            await given_up.wait()
            free.set()
            while worker.busy:
                await asyncio.sleep(0.001)
        worker.close()
        return heard

    heard = asyncio.run(work())
    assert [name for name, _ in heard] == ["quick", "late", "slow"]
    assert str(heard[1][1]) == "no answer within 0.05 s"
    assert [heard[0][1], heard[2][1]] == ["quick", True]


def test_a_limit_that_is_left_over_from_before_ends_nothing() -> None:
    async def work() -> Heard:
        worker, heard = Worker(), Heard()
        async with asyncio.timeout(10):
            for number in range(3):
                await worker.call(lambda: None, limit=0.1)
                worker.submit(lambda: threading.Event().wait(0.15), 5.0, lambda *said: heard.append(said))
                while worker.busy:
                    await asyncio.sleep(0.001)
                assert len(heard) == number + 1
        worker.close()
        return heard

    assert asyncio.run(work()) == [(False, None)] * 3
