"""The stages of apply, stop, erase and destroy (look, plan, execute, verify) in a world that refuses and changes."""

from __future__ import annotations

import pytest

from hippodrome.deployment.core.stages import Executor, PlanStep, step

THINGS = ("task", "timer", "name", "cluster", "record")


class World:
    """Things that are to be removed, and a count of the calls that stand for calls of AWS."""

    def __init__(self, *things: str) -> None:
        self.things = list(things)
        self.removed: list[str] = []
        self.slept: list[float] = []
        self.refuses: dict[str, int] = {}  # how often each removal fails
        self.interrupted_at: int | None = None  # the number of the call that is interrupted before it does anything
        self.calls = 0
        self.executor = Executor(self.slept.append, clock=lambda: 0.0)

    def look(self) -> list[str]:
        self._call()
        return [*self.things]

    def plan(self, found: list[str]) -> list[PlanStep]:
        return [step(self.remove, thing) for thing in found]

    def remove(self, thing: str) -> None:
        self._call()
        if self.refuses.get(thing, 0) > 0:
            self.refuses[thing] -= 1
            raise ConnectionError(f"{thing} is busy")
        if thing in self.things:
            self.things.remove(thing)
            self.removed.append(thing)

    def _call(self) -> None:
        if self.calls == self.interrupted_at:
            raise KeyboardInterrupt
        self.calls += 1


def test_plans_can_be_compared() -> None:
    world = World()
    assert world.plan(["task", "timer"]) == [PlanStep(world.remove, ("task",)), PlanStep(world.remove, ("timer",))]


def test_the_steps_of_a_plan_are_executed_in_order() -> None:
    world = World(*THINGS)
    assert world.executor.converge(world.look, world.plan) == []
    assert (world.removed, world.slept) == ([*THINGS], [])


def test_without_things_to_remove_there_is_only_one_look() -> None:
    world = World()
    assert world.executor.converge(world.look, world.plan) == []
    assert world.calls == 1


def test_without_note_the_first_failure_ends_the_run() -> None:
    world = World(*THINGS)
    world.refuses["timer"] = 1
    with pytest.raises(ConnectionError, match="timer"):
        world.executor.converge(world.look, world.plan)
    assert world.removed == ["task"]


def test_with_note_the_other_steps_go_on_and_the_failed_one_is_tried_again() -> None:
    world = World(*THINGS)
    world.refuses["timer"] = 1
    noted: list[Exception] = []
    assert world.executor.converge(world.look, world.plan, note=noted.append) == []
    assert world.removed == ["task", "name", "cluster", "record", "timer"]
    assert [str(error) for error in noted] == ["timer is busy"]
    assert len(world.slept) == 1


@pytest.mark.parametrize("call", range(8))
def test_interrupted_at_any_call_the_next_run_ends_clean(call: int) -> None:
    world = World(*THINGS)
    world.interrupted_at = call
    if call < len(THINGS) + 2:  # the look, a removal of each thing, and the look that finds nothing
        with pytest.raises(KeyboardInterrupt):
            world.executor.converge(world.look, world.plan, note=lambda _: None)
    world.interrupted_at = None
    assert world.executor.converge(world.look, world.plan) == []
    assert sorted(world.removed) == sorted(THINGS)


def test_things_that_appear_meanwhile_are_removed_too() -> None:
    world = World("task")
    appearing = iter(["task 2", "task 3"])
    remove = world.remove

    def remove_and_add(thing: str) -> None:
        remove(thing)
        world.things += [*filter(None, [next(appearing, None)])]

    world.remove = remove_and_add  # type: ignore[method-assign]
    assert world.executor.converge(world.look, world.plan, pause=0) == []
    assert (world.removed, world.slept) == (["task", "task 2", "task 3"], [])


def test_the_result_is_what_is_left_when_time_is_over() -> None:
    world = World(*THINGS)
    world.refuses["name"] = 1000
    assert world.executor.converge(world.look, world.plan, note=lambda _: None, seconds=60, pause=20) == ["name"]
    assert world.slept == [20, 20, 20]


def test_the_first_plan_is_executed_even_without_time() -> None:
    world = World(*THINGS)
    assert world.executor.converge(world.look, world.plan, seconds=0) == []
    assert world.removed == [*THINGS]


def test_rounds_limit_the_number_of_plans() -> None:
    world = World("task")
    world.refuses["task"] = 1000
    noted: list[Exception] = []
    assert world.executor.converge(world.look, world.plan, note=noted.append, rounds=3, pause=0) == ["task"]
    assert len(noted) == 3


def test_things_without_a_plan_are_waited_for() -> None:
    world = World()
    looks = iter([["saving"], ["saving"], []])
    assert world.executor.converge(lambda: next(looks), lambda _: [], pause=0, seconds=60) == []
    assert world.slept == [0, 0]


def test_waiting_ends_when_nothing_is_left_or_returns_what_is_left() -> None:
    world = World()
    looks = iter([["a", "b"], ["b"], []])
    assert world.executor.wait(lambda: next(looks), 600, pause=20) == []
    assert world.slept == [20, 20]
    assert world.executor.wait(lambda: ["b"], 60, pause=20, title="Waiting") == ["b"]
    assert world.slept == [20, 20, 20, 20, 20]


def test_waiting_ends_by_the_clock_too() -> None:
    ticks = iter(range(0, 1000, 50))
    slept: list[float] = []
    assert Executor(slept.append, clock=lambda: float(next(ticks))).wait(lambda: ["b"], 90) == ["b"]
    assert len(slept) == 1


def test_a_failed_try_is_repeated_if_the_remedy_helped() -> None:
    tries: list[int] = []
    helped: list[Exception] = []

    def act() -> str:
        tries.append(1)
        if len(tries) < 3:
            raise ConnectionError
        return "done"

    assert Executor().retry(act, lambda error: not helped.append(error), 5) == "done"
    assert (len(tries), len(helped)) == (3, 2)


@pytest.mark.parametrize(("remedy", "expected"), [(False, 1), (True, 3)])
def test_a_failed_try_is_repeated_after_a_remedy_and_the_last_failure_is_raised(remedy: bool, expected: int) -> None:
    tries: list[int] = []

    def act() -> None:
        tries.append(1)
        raise ConnectionError

    with pytest.raises(ConnectionError):
        Executor().retry(act, lambda _: remedy, 3)
    assert len(tries) == expected
