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
from bench import control, pages, table

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
