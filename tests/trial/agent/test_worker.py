"""The agent's thread (hippodrome/trial/agent/worker.py)."""

from __future__ import annotations

import asyncio
import threading
import traceback
from pathlib import Path
from types import TracebackType
from typing import Any

from hippodrome.trial.agent.worker import Worker
from hippodrome.trial.core.effects import AgentTimeout
from testing.waiting import PATIENCE, until_async

Heard = list[tuple[str, Any]]


def _names(told: TracebackType | None) -> list[str]:
    return [frame.name for frame in traceback.extract_tb(told)]


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
        async with asyncio.timeout(PATIENCE):
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


def test_a_function_that_is_late_is_told_with_the_line_in_which_the_thread_is() -> None:
    at_the_event = ["<lambda>", "wait", "wait"]  # the event waits for its condition

    async def work() -> AgentTimeout:
        worker, free, loop, later = Worker(), threading.Event(), asyncio.get_running_loop(), [0.0]
        clock = loop.time
        loop.time = lambda: clock() + later[0]  # type: ignore[method-assign]
        call = asyncio.ensure_future(worker.call(lambda: free.wait(PATIENCE), limit=1000.0))
        try:
            await until_async(lambda: _names(worker._where())[-3:] == at_the_event)
            later[0] = 2000.0
            await call
        except AgentTimeout as error:
            return error
        finally:
            free.set()
            worker.close()
        raise AssertionError

    told = asyncio.run(work()).__traceback__
    assert _names(told)[-3:] == at_the_event
    assert "_call" not in _names(told)
    assert Path(traceback.extract_tb(told)[-3].filename).name == "test_worker.py"


def test_a_function_that_is_late_while_the_thread_rests_has_no_line() -> None:
    worker = Worker()
    worker.close()
    worker._thread.join()
    assert worker._where() is None


def test_the_limit_of_an_earlier_call_does_not_end_a_later_one() -> None:
    async def work() -> Heard:
        worker, heard, loop, later = Worker(), Heard(), asyncio.get_running_loop(), [0.0]
        clock = loop.time
        loop.time = lambda: clock() + later[0]  # type: ignore[method-assign]
        for number in range(3):
            free = threading.Event()
            await worker.call(lambda: None, limit=1000.0)
            worker.submit(lambda free=free: free.wait(10), 5000.0, lambda *said: heard.append(said))
            later[0] += 2000.0
            for _ in range(3):
                await asyncio.sleep(0)  # the loop looks at its clock
            free.set()
            while worker.busy:
                await asyncio.sleep(0.001)
            assert len(heard) == number + 1
        worker.close()
        return heard

    assert asyncio.run(work()) == [(True, None)] * 3


def test_a_failure_while_one_result_is_taken_loses_no_other() -> None:
    async def work() -> tuple[Heard, list[Any]]:
        worker, heard, free, wrong = Worker(), Heard(), threading.Event(), []
        asyncio.get_running_loop().set_exception_handler(lambda _, said: wrong.append(said["exception"]))

        def done(result: Any, error: Exception | None) -> None:
            heard.append((result, error))
            if result == 0:
                raise ValueError("heard")

        for number in range(3):
            worker.submit(lambda number=number: free.wait() and number, 10.0, done)
        free.set()
        worker.close()
        worker._thread.join()  # all three results are there before the loop hears of the first
        async with asyncio.timeout(PATIENCE):
            while worker.busy:
                await asyncio.sleep(0.001)
        return heard, wrong

    heard, wrong = asyncio.run(work())
    assert heard == [(0, None), (1, None), (2, None)]
    assert [str(error) for error in wrong] == ["heard"]


def test_a_worker_serves_one_event_loop_after_the_other() -> None:
    worker, free = Worker(), threading.Event()

    async def work(number: int) -> int:
        found = await worker.call(lambda: number, limit=10.0)
        worker.submit(free.wait, 10.0, lambda *_: None)  # is still going on when the loop ends
        return found

    assert asyncio.run(work(1)) == 1
    free.set()
    assert asyncio.run(work(2)) == 2
    worker.close()


def test_a_function_that_returns_when_its_loop_has_ended_does_no_harm() -> None:
    worker, free = Worker(), threading.Event()

    async def work() -> None:
        worker.submit(free.wait, 10.0, lambda *_: None)

    asyncio.run(work())
    free.set()
    worker.close()
    worker._thread.join(60)
    assert not worker._thread.is_alive()
