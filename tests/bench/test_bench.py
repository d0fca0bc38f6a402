"""`make bench` runs; its table and results.json hold what was measured, and say what was missed or not measured.

The figures themselves are not judged here, but for those that the estimate of costs takes from it.
"""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import pytest

from bench import __main__ as command
from bench import table
from bench.row import Row, row
from hippodrome.deployment.cost import estimate


def test_goals_are_about_the_ratio_where_there_is_a_yardstick() -> None:
    over = row("a", 30, "ms", yardstick=10, at_most=2, decides="-")
    assert (over["ratio"], over["goal"], over["met"]) == (3, "≤ 2x", False)
    under = row("a", 30, "ms", at_least=20, decides="-")
    assert (under["ratio"], under["goal"], under["met"]) == (None, "≥ 20", True)
    without = row("a", 30, "ms", decides="-")
    assert (without["goal"], without["met"]) == (None, None)


@pytest.mark.parametrize(
    ("better", "worse", "ratio"), [("less", 13.0, 1.3), ("more", 10 / 1.3, 1.3), ("less", 9.0, 0.9)]
)
def test_a_comparison_says_by_how_much_this_version_is_worse(better: Any, worse: float, ratio: float) -> None:
    compared = table.compared(row("a", 1, "ms", better=better, decides="-"), [10, 1, 11], [worse], at_most=1.25)
    assert compared["ratio"] == pytest.approx(ratio)
    assert compared["met"] is (ratio < 1.25)


def test_the_table_and_the_results_hold_what_was_measured_missed_and_not_measured(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    results = tmp_path / "results.json"
    monkeypatch.setattr(table.store, "__defaults__", (results,))
    slow = row("the slow one", 100, "ms", at_most=2, decides="whether one waits")
    outcomes: dict[str, list[Row]] = {
        "local.pages": [{"measure": "local.pages", **slow}],
        "local.crowd": [table.unmeasured("local.crowd", "no such thing")],
    }
    monkeypatch.setattr(command, "measure", lambda name: outcomes[name])
    assert command.main(["local.pages"]) == 0, "a slow machine is no error"
    assert command.main(["local.crowd"]) == 1
    assert [entry["name"] for entry in json.loads(results.read_text())] == ["local.crowd", "the slow one"]
    output = capsys.readouterr().out
    assert "Goals missed: 1 of 1\n  the slow one" in output
    assert "Not measured: local.crowd\nno such thing" in output
    with pytest.raises(SystemExit):
        command.main(["no-such-measure"])


def test_a_measure_that_fails_is_a_row_with_its_error() -> None:
    (failed,) = command.measure("local.nothing")
    assert not table.measured(failed)
    assert "has no attribute 'nothing'" in failed["error"]


def test_a_version_is_no_worse_than_itself() -> None:
    compared = command.compare("local.pages", command.ROOT)
    assert [(entry["ratio"], entry["met"]) for entry in compared] == [(pytest.approx(1, abs=0.01), True)] * 2


# The estimate of costs


def test_the_estimate_of_costs_counts_the_calls_of_the_bench() -> None:
    rows = command.measure("calls.of_a_participant")
    for reads, measured in zip((estimate.S3_READS.low, estimate.S3_READS.high), rows, strict=True):
        counted = Counter[str]()
        for calls in measured["detail"].values():
            counted.update(calls)
        assert sum(counted.values()) == measured["value"]
        assert reads == pytest.approx(counted["s3:GetObject"], abs=1)
        assert pytest.approx(counted["s3:PutObject"] + counted["s3:ListObjectsV2"], abs=1) == estimate.S3_WRITES
        assert counted["sns:Publish"] == estimate.PUBLISHES


def test_the_estimate_of_costs_takes_the_heaviest_page_of_the_bench() -> None:
    assert round(max(measured["value"] for measured in command.measure("local.pages")) / 1000) == estimate.PAGE_KB
