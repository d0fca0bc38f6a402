"""The benches give well-formed rows; what they measure is not judged here."""

from __future__ import annotations

import asyncio
import io
import json
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bench import __main__ as command
from bench import control, pages, scale, table, warm
from bench.bill import bill
from bench.simulation.ports import Life
from deploy.prices import Prices

COLUMNS = {"name", "value", "unit", "yardstick", "ratio", "goal", "met"}


def assert_well_formed(rows: list[table.Row]) -> None:
    assert rows
    for row in rows:
        assert set(row) - {"detail"} == COLUMNS
        assert row["value"] > 0, row["name"]
        assert row["ratio"] is None or row["ratio"] == row["value"] / row["yardstick"]
        assert (row["goal"] is None) == (row["met"] is None)
    json.dumps(rows)
    assert len({row["name"] for row in rows}) == len(rows)


@pytest.mark.parametrize(
    "measure", [control.calls_of_requests, control.calls_of_a_participant, control.bytes_per_answer, pages.weights]
)
def test_the_cheap_rows_are_well_formed(measure: table.Measure) -> None:
    assert_well_formed(list(measure()))


def test_the_calls_of_each_function_add_up() -> None:
    for row in control.calls_of_a_participant():
        counted = [calls for name, calls in row["detail"].items() if isinstance(calls, dict)]
        assert sum(sum(calls.values()) for calls in counted) == row["value"]
        assert len(counted) == 4  # next_step, start_server, task_changed, stop_server


def test_a_small_crowd_comes_to_the_end_of_the_study(tmp_path: Path) -> None:
    pytest.importorskip("local.__main__")
    pages.project_without_game(tmp_path)
    with pages.serving([sys.executable, "-m", "local", ".", "--port", "0"], tmp_path) as address:
        crowd = asyncio.run(pages.send_crowd(address, 3, pages.through_the_study))
    assert len(crowd.waits) == 3 * (2 * len(control.ANSWERS) + 1)
    answers = list(tmp_path.glob("data/crowd/users/*/answers/*.json"))
    assert len(answers) == 3 * len(control.ANSWERS)


def test_who_comes_to_warm_servers_is_given_one_and_waits_for_nothing() -> None:
    arrivals = [warm.OPENS + 90.0 * number for number in range(5)]
    with scale.quiet():
        came, without = (warm.simulated(servers, arrivals, 900, 2400) for servers in (2, 0))
    assert (came.took_spare, without.took_spare) == (1, 0)
    assert max(came.to_ready) < 5 < min(without.to_ready)
    assert max(came.at_game) < min(without.at_game)
    assert not any(came.world.left().values()), came.world.story()


def test_a_server_in_local_mode_comes_to_its_first_picture(tmp_path: Path) -> None:
    pytest.importorskip("ale_py")
    (took,) = warm.in_local_mode(1, 1, loading=0.0)
    assert 0 < took < warm.PATIENCE


def test_a_bill_counts_what_ran_and_on_demand_only_the_servers_cost_more() -> None:
    prices = Prices()
    with scale.quiet():
        world = warm.simulated(0, [0.0, 30.0], 900, 2400).world
    tasks = list(world.platform.tasks.tasks.values())
    assert [task.last for task in tasks] == [Life.STOPPED] * 2
    spot, demand = (bill(world, prices, spot=kind) for kind in (True, False))
    servers, *others = spot
    hours = sum(task.ended - task.born for task in tasks if task.ended) / 3600
    assert demand[servers].likely == pytest.approx(hours * prices.server_hour(1, 2, spot=False).likely)
    assert spot[servers].likely < demand[servers].likely
    assert {spot[other] == demand[other] for other in others} == {True}
    assert all(usd.likely > 0 for usd in spot.values())


def test_the_cost_of_many_is_told_for_each_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scale, "MANY", 3)
    with scale.quiet():
        served, sweep, cost = scale.many_at_once()
    assert_well_formed([served, sweep, cost])
    assert served["value"] == 100
    an_hour = Prices().server_hour(1, 2, spot=True)
    assert an_hour.low < cost["value"] < 2 * an_hour.high, "they play for an hour"


def test_what_warm_servers_cost_is_what_the_command_says() -> None:
    (row,) = warm.what_they_cost()
    assert_well_formed([row])
    assert row["value"] == pytest.approx(warm.WARM * Prices().server_hour(1, 2, spot=True).likely)


def test_a_goal_is_about_the_ratio_where_there_is_a_yardstick() -> None:
    over = table.row("a", 30, "ms", yardstick=10, at_most=2)
    assert (over["ratio"], over["goal"], over["met"]) == (3, "≤ 2x", False)
    by_value = table.row("a", 30, "bytes", yardstick=10, at_most=40, judge="value")
    assert (by_value["ratio"], by_value["goal"], by_value["met"]) == (3, "≤ 40", True)
    without = table.row("a", 30, "ms")
    assert (without["ratio"], without["goal"], without["met"]) == (None, None, None)


def test_a_measure_that_fails_does_not_keep_the_others() -> None:
    def broken() -> Iterator[table.Row]:
        yield table.row("first", 1, "ms")
        raise RuntimeError("no such thing")

    def sound() -> Iterator[table.Row]:
        yield table.row("last", 2, "ms")

    found = list(table.each([broken, sound]))
    assert [row["name"] for row in found] == ["first", "broken", "last"]
    assert [table.measured(row) for row in found] == [True, False, True]
    assert "no such thing" in found[1]["error"]
    text = io.StringIO()
    table.show(found, Console(file=text, width=100))
    assert "no such thing" in text.getvalue()


def group(monkeypatch: pytest.MonkeyPatch, name: str, *rows: Any) -> None:
    """Put a group of these rows in the place of a real one; an exception among them is raised."""
    module = types.ModuleType(f"bench.{name}")

    def found() -> Iterator[Any]:
        for row in rows:
            if isinstance(row, Exception):
                raise row
            yield row

    module.rows = found  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, f"bench.{name}", module)


def test_the_command_keeps_the_rows_and_fails_only_for_what_it_could_not_measure(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "results.json"
    monkeypatch.setattr(table.keep, "__defaults__", (file,))
    slow = table.row("slow", 100, "ms", yardstick=1, at_most=2)
    group(monkeypatch, "control", slow)
    group(monkeypatch, "pages", table.row("heavy", 1, "bytes"), RuntimeError("gone"))
    assert command.main(["control"]) == 0, "a slow machine is no error"
    assert command.main(["pages"]) == 1
    kept = json.loads(file.read_text())
    assert [(row["group"], row["name"]) for row in kept] == [
        ("control", "slow"), ("pages", "heavy"), ("pages", "the rest of pages"),
    ]  # fmt: skip
    output = capsys.readouterr()
    assert "slow" in output.out
    assert "heavy: 1 bytes" in output.err
    with pytest.raises(SystemExit):
        command.main(["no-such-group"])
