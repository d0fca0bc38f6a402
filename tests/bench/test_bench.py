"""The benches make well-formed rows, and report goals that are missed. The figures themselves are not judged."""

from __future__ import annotations

import ast
import asyncio
import collections
import contextlib
import dataclasses
import io
import json
import os
import platform
import re
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from bench import __main__ as command
from bench import (
    control,
    data,
    functions,
    gym,
    load,
    memory,
    pages,
    pictures,
    scale,
    scenes,
    seen,
    sessions,
    study_on_moto,
    table,
    together,
    trial,
    warm,
)
from bench.bill import bill
from deploy.cost import estimate
from deploy.cost.prices import Prices
from hippodrome.model import ids, server
from testing import browser
from testing.quiet_log import quiet
from testing.simulation import aws_bound, cloud, hippo, world
from testing.simulation import tasks as ecs
from testing.simulation.conditions import Conditions
from testing.tasks import Life
from testing.waiting import until_async
from trial.pictures.encoder import Encoder

COLUMNS = {"name", "value", "unit", "yardstick", "ratio", "goal", "met", "kind"}


def assert_well_formed(rows: list[table.Row]) -> None:
    assert rows
    for row in rows:
        assert set(row) - {"detail"} == COLUMNS
        assert row["value"] > 0, row["name"]
        assert row["ratio"] is None or row["ratio"] == row["value"] / row["yardstick"]
        assert (row["goal"] is None) == (row["met"] is None)
    json.dumps(rows)
    assert len({row["name"] for row in rows}) == len(rows)


@pytest.mark.parametrize("measure", [control.calls_of_requests, control.bytes_per_answer, pages.weights])
def test_the_cheap_rows_are_well_formed(measure: table.Measure) -> None:
    assert_well_formed(list(measure()))


@pytest.fixture(scope="module")
def participant() -> list[Any]:
    return list(control.calls_of_a_participant())


def test_the_calls_of_each_function_add_up(participant: list[Any]) -> None:
    assert_well_formed(participant)
    for row in participant:
        counted = [calls for name, calls in row["detail"].items() if isinstance(calls, dict)]
        assert sum(sum(calls.values()) for calls in counted) == row["value"]
        assert len(counted) == 4  # next_step, start_server, task_changed, stop_server


def test_the_estimate_of_costs_counts_the_calls_of_the_bench(participant: list[Any]) -> None:
    rows = {row["name"]: row for row in participant}
    for reads, name in (
        (estimate.S3_READS.low, "AWS calls, link to clean-up, in a running study"),
        (estimate.S3_READS.high, "AWS calls, link to clean-up, alone, at a minute a page: caches stale"),
    ):
        counted: dict[str, int] = {}
        for calls in rows[name]["detail"].values():
            for call, count in calls.items() if isinstance(calls, dict) else ():
                counted[call] = counted.get(call, 0) + count
        assert reads == pytest.approx(counted["s3:GetObject"], abs=1)
        assert pytest.approx(counted["s3:PutObject"] + counted["s3:ListObjectsV2"], abs=1) == estimate.S3_WRITES
        assert counted["sns:Publish"] == estimate.PUBLISHES


def test_the_estimate_of_costs_takes_the_heaviest_page_of_the_bench() -> None:
    assert round(max(row["value"] for row in pages.weights()) / 1000) == estimate.PAGE_KB


def test_a_small_crowd_comes_to_the_end_of_the_study(tmp_path: Path) -> None:
    pytest.importorskip("local.__main__")
    pages.project_without_game(tmp_path)
    with pages.serving([sys.executable, "-m", "local", ".", "--port", "0"], tmp_path) as address:
        crowd = asyncio.run(pages.send_crowd(address, 3, pages.through_the_study))
    assert len(crowd.waits) == 3 * (2 * len(study_on_moto.ANSWERS) + 1)
    answers = list(tmp_path.glob("data/crowd/users/*/answers/*.json"))
    assert len(answers) == 3 * len(study_on_moto.ANSWERS)


def test_participants_who_get_warm_servers_do_not_wait() -> None:
    arrivals = [warm.OPENS + 90.0 * number for number in range(5)]
    with quiet():
        came, without = (warm.simulated(servers, arrivals, 900, 2400) for servers in (2, 0))
    assert (came.took_warm_server, without.took_warm_server) == (1, 0)
    assert max(came.to_shown) < 10 < min(without.to_shown)
    assert max(came.at_game) < min(without.at_game)
    assert not any(came.world.left().values()), came.world.story()


def test_a_server_in_local_mode_comes_to_its_first_picture(tmp_path: Path) -> None:
    pytest.importorskip("ale_py")
    (took,) = warm.in_local_mode(1, 1)
    assert 0 < took < warm.PATIENCE


def test_a_bill_counts_what_ran_and_on_demand_only_the_servers_cost_more() -> None:
    prices = Prices()
    with quiet():
        world = warm.simulated(0, [0.0, 30.0], 900, 2400).world
    tasks = list(world.platform.tasks.tasks.values())
    assert [task.last for task in tasks] == [Life.STOPPED] * 2
    spot, demand = (bill(world, prices, spot=kind) for kind in (True, False))
    servers, *others = spot
    hours = sum(task.closed - task.born for task in tasks if task.closed) / 3600
    assert demand[servers].likely == pytest.approx(hours * prices.server_hour(1, 2, spot=False).likely)
    assert spot[servers].likely < demand[servers].likely
    assert {spot[other] == demand[other] for other in others} == {True}
    assert all(usd.likely > 0 for usd in spot.values())


def test_the_cost_of_a_crowd_is_given_per_participant(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scale, "MANY", 3)
    with quiet():
        served, sweep, cut_off, cost = scale.many_at_once()
    assert_well_formed([served, sweep, cost])
    assert served["value"] == 100
    assert cut_off["met"] is True
    an_hour = Prices().server_hour(1, 2, spot=True)
    assert an_hour.low < cost["value"] < 2 * an_hour.high, "they play for an hour"


def test_the_bench_and_the_command_agree_on_the_cost_of_warm_servers() -> None:
    (row,) = warm.what_they_cost()
    assert_well_formed([row])
    assert row["value"] == pytest.approx(warm.WARM * Prices().server_hour(1, 2, spot=True).likely)


def test_a_goal_is_about_the_ratio_where_there_is_a_yardstick() -> None:
    over = table.row("a", 30, "ms", yardstick=10, at_most=2)
    assert (over["ratio"], over["goal"], over["met"]) == (3, "≤ 2x", False)
    by_value = table.row("a", 30, "bytes", yardstick=10, at_most=40, judge="value", bound="ours")
    assert (by_value["ratio"], by_value["goal"], by_value["met"]) == (3, "≤ 40", True)
    without = table.row("a", 30, "ms")
    assert (without["ratio"], without["goal"], without["met"]) == (None, None, None)


def test_a_failed_measurement_does_not_stop_the_others() -> None:
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


# Rows that cannot mislead


def test_memory_is_that_of_the_command_and_not_of_its_parent(tmp_path: Path) -> None:
    def held() -> float:
        with (tmp_path / "out").open("wb") as out:
            status, most = memory.run(
                "this", [], env={"PYTHONPATH": f"{tmp_path}:{study_on_moto.ROOT}"}, cwd=tmp_path, out=out, err=out
            )
        assert status == 0
        return most

    (tmp_path / "this.py").write_text("")
    alone = held()
    ballast = bytearray(200 * 2**20)
    ballast[:: 2**12] = b"x" * len(ballast[:: 2**12])
    assert held() == pytest.approx(alone, abs=8)
    del ballast
    (tmp_path / "this.py").write_text("x = bytearray(b'x') * (50 * 2**20)")
    assert held() == pytest.approx(alone + 50, abs=8)


@pytest.fixture(scope="module")
def crowd() -> scale.ServedCrowd:
    with quiet():
        return scale.crowd(7, 100, 10.0)


def test_waiting_counts_from_asking_to_the_page(crowd: scale.ServedCrowd) -> None:
    with quiet():  # slow spans come and go, and would decide the p95 of so few
        rows = [*scale.waiting([scale.crowd(seed, 250, 25.0, Conditions(slow_zone=0.0)) for seed in scale.SEEDS[1:3]])]
    median, p95 = rows
    assert median["ratio"] < 1.2, rows
    assert p95["met"], rows
    assert all(row["yardstick"] < row["value"] for row in rows)
    kept = crowd.world.platform.documents.kept
    for visit, wait in zip(crowd.visits, crowd.waits, strict=True):
        record = json.loads(kept[server.key(ids.server_label("study", visit.user))][0])
        assert wait > scale.seconds_of(record["ready"]) - scale.seconds_of(record["requested"])


def test_a_start_server_with_a_concurrency_of_two_misses_the_goal_of_waiting() -> None:
    """The row counts the waits in the topic, the queue and the function."""
    few = {**world.WIRES, "start_server": world.WIRES["start_server"]._replace(concurrency=2)}
    with quiet():
        rows = [*scale.waiting([scale.crowd(7, 100, 10.0, wires=few)])]
    assert all(row["ratio"] > 1.2 for row in rows)
    assert [row["met"] for row in rows] == [False, False]


def test_the_time_of_aws_depends_on_arrivals_and_seed_alone_and_respects_the_quotas() -> None:
    at_once = [0.0] * 400
    assert aws_bound.aws_alone(at_once, 1) == aws_bound.aws_alone(at_once, 1) != aws_bound.aws_alone(at_once, 2)
    swift = {"starts": (1e-9, 0.0, 0.0), "propagation": (0.0, 0.0), "slow_zone": 0.0, "late_addresses": 0.0}
    instant = Conditions(**swift, busy_zone=(0.0, 0.0))
    waits = sorted(aws_bound.aws_alone(at_once, 1, instant))
    assert waits[19] == 0, "a burst of 20 RunTask"
    assert waits[-1] == pytest.approx((400 - 20) / 20, abs=0.2), "and 20 a second from then on"
    usual = sorted(aws_bound.aws_alone(at_once, 1))
    early = sorted(aws_bound.aws_alone(at_once, 1, early=True))
    assert early[200] < usual[200], "names are made while tasks start"
    busy = Conditions(**swift, busy_zone=(5.0, 5.0))
    assert {round(wait, 3) % 5 for wait in aws_bound.aws_alone(at_once, 1, busy)} == {0.0}


def test_the_wait_after_an_interruption_counts_until_they_play_again() -> None:
    with quiet():
        lost = scale.crowd(7, 10, 10.0, Conditions(interrupted=0.5, interrupted_after=(5.0, 30.0)))
    assert lost.served == 100
    assert sum(visit.interruptions for visit in lost.visits) > 0
    for visit in lost.visits:
        assert len(visit.waits_again) == visit.interruptions
        assert all(wait > 10 for wait in visit.waits_again), "another server has to start"


def test_a_crowd_with_a_stranded_participant_or_a_leftover_misses_its_goal(crowd: scale.ServedCrowd) -> None:
    theirs = {"ready": 0.1, "failed": {}, "both": ["10 %", "9 %"]}
    assert scale.served("a crowd", [crowd], theirs, 1.0)["met"]
    visits = [*crowd.visits[1:], dataclasses.replace(crowd.visits[0], finished=None, reason="waited too long")]
    stranded = dataclasses.replace(crowd, visits=visits)
    assert scale.served("a crowd", [stranded], theirs, 1.0)["met"] is False
    assert scale.served_many(stranded, {})["met"] is False
    assert scale.served_many(crowd, {})["met"] is True
    with pytest.MonkeyPatch.context() as few:
        few.setattr(crowd.world.platform.tasks, "most_interfaces", 99)
        assert scale.served_many(crowd, {})["met"] is False, "its 100 servers were never there at once"
    names = crowd.world.platform.dns
    names.records["s-1.example.org"] = "198.18.0.1"
    try:
        assert scale.served("a crowd", [crowd], theirs, 1.0)["met"] is False
        assert scale.served_many(crowd, {})["met"] is False
    finally:
        del names.records["s-1.example.org"]


@pytest.mark.parametrize(("executions", "within", "met"), [(10, 60.0, True), (3, 1.0, False)])
def test_pages_that_find_no_room_miss_their_goal(
    monkeypatch: pytest.MonkeyPatch, executions: int, within: float, met: bool
) -> None:
    monkeypatch.setattr(scale, "FEW", 15)
    monkeypatch.setattr(scale, "FEW_EXECUTIONS", executions)
    monkeypatch.setattr(scale, "FEW_WITHIN", within)
    with quiet():
        _, first_try = scale.small_account()
    assert first_try["met"] is met


def test_functions_that_run_for_long_miss_their_goal(crowd: scale.ServedCrowd, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = {"billed": 20.0, "throttled": {}}
    assert next(scale.costs(crowd, theirs))["met"]
    monkeypatch.setattr(crowd.world.start_server, "billed", 300.0)
    assert next(scale.costs(crowd, theirs))["met"] is False


def test_assumptions_are_printed_from_the_constants_and_differences_of_worse_conditions() -> None:
    told = scale.assumed(Conditions())
    assert told["zone busy after a change"].startswith("0.2 to 1 s")
    worse = scale.assumed(scale.WORSE["a zone busy for 5 to 15 s"])
    assert list(worse) == ["zone busy after a change"]
    assert worse["zone busy after a change"].startswith("5 to 15 s")
    assert "sold out" in scale.assumed(scale.WORSE["Spot sold out"])["Spot"]
    assert "10% of its tasks" in scale.assumed(scale.WORSE["10 % interruptions"])["Spot"]


def test_ten_thousand_servers_fit_the_network_of_the_template(monkeypatch: pytest.MonkeyPatch) -> None:
    assert ecs.ADDRESSES > 2 * scale.MANY
    monkeypatch.setattr(ecs, "ADDRESSES", 60)
    with quiet():
        full = scale.crowd(7, 80, 10.0)
    assert full.world.platform.tasks.most_interfaces > 60
    assert any("TaskFailedToStart" in text for _, text in full.world.cloud.timeline), "the network is full"


def test_hippos_calls_are_counted_from_what_its_functions_do() -> None:
    steps = {"1": "consent", "2": "game", "finalStep": "debrief"}
    calls = [*hippo.calls(steps, start="1", stop="finalStep")]
    counted = collections.Counter(function for function, _ in calls)
    assert counted == {"next_step": 6 + 6 + 4 + 6, "start_server": 8, "stop_server": 7}
    more = [*hippo.calls(steps, start="1", stop="finalStep", waits=3)]
    assert len(more) - len(calls) == 2 * 6


def test_hippo_gives_up_an_address_after_a_minute_and_a_run_after_three_tries() -> None:
    slow = scale.hippo(3, 1.0, Conditions(starts=(80.0, 0.0, 90.0)))
    assert slow["ready"] == 1, "with the interface, the address is there early"
    late = scale._hippo(3, 1.0, Conditions(starts=(80.0, 0.0, 90.0)), early=False)
    assert late["failed"] == {"no address after a minute": 3}
    full = scale._hippo(3, 1.0, Conditions(no_spot=lambda seconds: True), early=True)
    assert full["failed"] == {"RunTask failed three times": 3}
    assert full["billed"] > 60


def test_hippo_ignores_errors_of_the_request_for_an_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(cloud.QUOTAS, "ec2:DescribeNetworkInterfaces", (1e-9, 0.0))
    found = scale._hippo(2, 1.0, None, early=True)
    assert found["failed"] == {"no address after a minute": 2}, "and Lambda does not invoke the function again"
    assert found["throttled"]["ec2:DescribeNetworkInterfaces"] == 2 * hippo.TRIES * hippo.ATTEMPTS


def test_rows_of_crowds_name_their_assumptions(crowd: scale.ServedCrowd) -> None:
    with quiet():
        pairs = sessions.crowd(sessions.PAIRS, Conditions(s3=(0.1, 0.2)), people=4, within=2.0)
    served = scale.served("a crowd", [crowd], {"ready": 0.1, "failed": {}, "both": ["10 %", "9 %"]}, 1.0)["detail"]
    assert {f"assumed: {of}" for of in scale.assumed(Conditions())} <= set(served)
    assert "after RunTask (our assumption)" in served["assumed of HIPPO's way"]
    together_ = next(sessions.judged("in pairs", pairs))["detail"]
    assert [of for of in together_ if of.startswith("assumed")] == ["assumed: latency of a call"]


def goals(file: Path) -> Iterator[tuple[str, set[str]]]:
    """Yield each call of `row` in a file: its place, and the names of its arguments."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Call) and ast.unparse(node.func) in {"row", "table.row"}:
            yield f"{file.name}:{node.lineno}", {str(keyword.arg) for keyword in node.keywords}


def test_each_row_with_a_goal_has_a_yardstick_or_says_whose_bound_it_is() -> None:
    found = [one for file in (study_on_moto.ROOT / "bench").rglob("*.py") for one in goals(file)]
    assert len(found) > 25
    judged = {where: with_ for where, with_ in found if with_ & {"at_most", "at_least"}}
    assert [where for where, with_ in judged.items() if "bound" not in with_ and "yardstick" not in with_] == []
    assert [where for where, with_ in judged.items() if "judge" in with_ and "bound" not in with_] == []


def test_a_row_says_whether_it_is_compared_or_a_bound_or_information() -> None:
    compared = table.row("a", 3, "s", yardstick=2, at_most=2)
    bound = table.row("b", 3, "s", bound="AWS's", at_most=2)
    beside = table.row("c", 3, "s", yardstick=2)
    assert [row["kind"] for row in (compared, bound, beside)] == ["compared", "bound", "information"]
    by_value = table.row("d", 3, "s", yardstick=2, at_most=2, judge="value", bound="ours")
    assert by_value["kind"] == "bound", "the yardstick beside it decides nothing"
    text = io.StringIO()
    table.show([compared, bound, beside], Console(file=text, width=100))
    assert re.findall("compared|bound|information", text.getvalue())[:3] == ["compared", "bound", "information"]


def test_missed_goals_are_listed_below_the_table() -> None:
    text = io.StringIO()
    rows = [table.row(name, value, "s", at_most=2, bound="ours") for name, value in (("slow", 3), ("quick", 1))]
    table.show([*rows, table.row("information", 1, "s")], Console(file=text, width=100))
    assert text.getvalue().partition("Goals missed: ")[2].split() == ["1", "of", "2", "slow"]


def test_a_goal_that_cannot_be_judged_is_an_error() -> None:
    with pytest.raises(ValueError, match="yardstick is 0"):
        table.row("a", 3, "s", yardstick=0, at_most=5)
    for yardstick in (None, 2):
        with pytest.raises(ValueError, match="whose the bound is"):
            table.row("a", 3, "s", yardstick=yardstick, judge="value", at_least=1)
    assert table.row("a", 3, "s", yardstick=0)["ratio"] is None


@pytest.mark.parametrize("of", ["ratio", "value"])
@pytest.mark.parametrize("goal", ["at_most", "at_least"])
def test_every_goal_can_be_missed_on_both_sides_of_its_bound(of: Any, goal: str) -> None:
    """Every goal is judged with made-up figures. The tests above and below give it those of broken parts."""
    goals: dict[str, Any] = {goal: 1}
    met = [
        table.row("a", value, "", yardstick=10, judge=of, bound="ours", **goals)["met"] for value in (0.5, 1, 5, 10, 20)
    ]
    below = {"ratio": [True, True, True, True, False], "value": [True, True, False, False, False]}[of]
    above = {"ratio": [False, False, False, True, True], "value": [False, True, True, True, True]}[of]
    assert met == (below if goal == "at_most" else above)


def test_steps_of_environments_are_measured_beside_an_echo_and_the_environment_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(gym, "REQUESTS", 200)
    monkeypatch.setattr(gym, "ROUNDS", 1)
    monkeypatch.setattr(gym, "IDLE", 20)
    rows = list(gym.rows())
    assert_well_formed(rows)
    assert sum(row["kind"] == "compared" for row in rows) == 3


def test_all_servers_of_environments_have_the_same_core_and_the_client_another(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[set[int]] = []
    monkeypatch.setattr(os, "sched_setaffinity", lambda _, cores: given.append(set(cores)))
    monkeypatch.setattr(gym, "CORES", [0, 1, 2])
    for _ in range(2):
        with gym.pinned():
            pass
    assert given == [{2}, {0, 1}] * 2


def test_an_expensive_server_of_environments_misses_its_goals() -> None:
    def run(cpu: float) -> gym.GymRun:
        return gym.GymRun(cpu, 1000, [cpu] * 5)

    for count in gym.THEIRS:
        for cpu, met in ((51.9, True), (52.1, False)):
            assert next(gym._single(count, [run(90), run(cpu)], [run(36), run(50)], 4.0))["met"] is met
    for cpu, met in ((6.4 * 64, False), (5.9 * 64, True)):
        assert next(gym._batched([run(cpu)], 4.0))["met"] is met


def test_bench_installs_all_that_it_measures_with() -> None:
    """`make bench` installs them on a fresh clone, too."""
    makefile = (study_on_moto.ROOT / "Makefile").read_text(encoding="utf-8")
    (line,) = [line for line in makefile.splitlines() if line.startswith("bench:")]
    assert {"$(VENV)/dev", "$(MINISTACK)/ready"} <= set(line.split())


def test_frames_are_measured_on_three_kinds_of_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ale_py")
    monkeypatch.setattr(pictures, "FRAMES", 8)
    monkeypatch.setattr(trial, "ROUNDS", 1)
    rows = list(trial.encoding())
    assert_well_formed(rows)
    judged = [row for row in rows if "against JPEG" in row["name"]]
    assert len(judged) == 2 * 3
    assert all(row["yardstick"] and row["goal"] for row in judged)
    assert [row["value"] for row in rows if "unchanged" in row["name"]] == [1.0] * 3


def test_expensive_late_or_changed_frames_miss_their_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "FRAMES", 4)
    monkeypatch.setattr(trial, "ROUNDS", 1)
    kind = "scrolling texture, 600 x 400"
    monkeypatch.setattr(pictures, "KINDS", {kind: pictures.scrolling_texture})
    monkeypatch.setattr(trial, "Encoder", lambda **_: Encoder())  # never a JPEG
    monkeypatch.setattr(trial, "unchanged", lambda frames, sent: 0.75)
    met = {row["name"]: row["met"] for row in trial.encoding()}
    assert met[f"bytes per frame, {kind}, against JPEG in JSON"] is False
    assert met[f"frames that arrive unchanged with `lossless: true`, {kind}"] is False
    rates = dict.fromkeys(trial.RATES, 1.0)
    bare = seen.Seen(rates, rates, rates, [20.0] * 40)
    assert all(row["met"] is not False for row in trial._seen("a game", bare, bare))
    slow = seen.Seen(dict.fromkeys(trial.RATES, 0.5), rates, rates, [20.0] * 40)
    missed = [row["name"] for row in trial._seen("a game", slow, slow) if row["met"] is False]
    assert len(missed) == len(trial.RATES), "a yardstick that is as bad does not help"
    late = seen.Seen(dict.fromkeys(trial.RATES, 0.9), rates, rates, [30.0] * 40)
    missed = [row["name"] for row in trial._seen("a game", late, bare) if row["met"] is False]
    assert len(missed) == len(trial.RATES) + 2


def test_objects_that_are_late_or_large_miss_their_goals() -> None:
    def shown(share: float, wait: float, size: float, weight: int) -> scenes.Shown:
        return scenes.Shown(seen.Seen({scenes.RATE: share}, {}, {scenes.RATE: 1.0}, [wait] * 9), size, weight)

    good, bad = shown(1.0, 30.0, 400.0, 18_000), shown(0.9, 40.0, 4_000.0, 50_000)
    rows = list(scenes.judged(good, shown(1.0, 30.0, 4_000.0, 14_000)))
    assert_well_formed(rows)
    assert all(row["met"] is not False for row in rows)
    assert sum(row["met"] is False for row in scenes.judged(bad, bad)) == sum(row["met"] is not None for row in rows)


def test_trials_that_cost_too_much_or_deliver_too_little_miss_their_goals() -> None:
    def all_rows(share: float, cpu: float, size: float) -> list[table.Row]:
        found = load.ServerLoad(share, cpu, size, size + 15)
        return [load.judged_cpu(found, 0.5), *load.judged_core([found] * 3), load.judged_policy(share, 1.0, 0.9)]

    rows = all_rows(1.0, 1.1, 40.0)
    assert_well_formed(rows)
    assert [row["met"] for row in rows] == [True] * 4
    assert [row["met"] for row in all_rows(0.9, 1.3, 46.0)] == [False] * 4
    good, bad = load.ServerLoad(1.0, 1.1, 40.0, 55.0), load.ServerLoad(0.9, 1.1, 40.0, 55.0)
    assert next(load.judged_core([*[good] * 31, bad]))["met"] is False, "each trial counts"
    assert load.judged_policy(0.5, 0.5, 0.9)["met"] is False, "a yardstick that is as bad does not help"


def test_pictures_that_cost_more_than_hippos_miss_their_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pictures, "KINDS", {"Ms. Pac-Man": list, "a texture": list})
    monkeypatch.setattr(trial, "unchanged", lambda frames, sent: 1.0)
    for flat, other, met in (((0.19, 0.09), (1.19, 1.19), True), ((0.21, 0.11), (1.21, 1.21), False)):
        ours = iter([flat, flat, other, other])
        monkeypatch.setattr(
            trial, "cost", lambda _, encoder, ours=ours: (*next(ours), []) if encoder else (1.0, 1.0, [])
        )
        judged = [row["met"] for row in trial.encoding() if "against JPEG" in row["name"]]
        assert judged == [met] * 4


def test_a_server_that_is_busy_without_participants_misses_its_goal() -> None:
    assert [trial.judged_idle(share)["met"] for share in (0.009, 0.011)] == [True, False]


def test_cold_starts_that_are_slow_miss_their_goals() -> None:
    taken = {"ours": [(0.2, 0.1), (0.4, 0.2), (0.3, 0.15)], "yardstick": [(0.2, 0.1)] * 3}
    assert [row["met"] for row in control.judged_start(taken, 4)] == [True, True]
    assert [row["met"] for row in control.judged_start({**taken, "yardstick": [(0.19, 0.09)] * 3}, 4)] == [False, False]
    imports = [functions.judged_import(name, 0.13, 0.1, {}) for name in functions.CLIENTS]
    assert [row["met"] for row in imports] == [False, *[None] * (len(imports) - 1)], "participants wait for one"
    assert functions.judged_import("next_step", 0.12, 0.1, {})["met"]


def test_requests_with_more_calls_miss_their_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(control, "on_moto", contextlib.nullcontext)
    monkeypatch.setattr(control, "warm", lambda study: None)
    kinds = {"GET step 1": [], "POST step 1": [], "POST step 2": ["sns:Publish"], "poll at step 3": []}
    for more, met in ((2, True), (3, False)):
        costs = [(name, [*calls, *["s3:GetObject"] * more]) for name, calls in kinds.items()]
        monkeypatch.setattr(control, "travel", lambda *_, costs=costs: types.SimpleNamespace(costs=costs))
        assert [row["met"] for row in control.calls_of_requests()] == [met] * 4


def test_answers_that_write_more_each_time_miss_their_goals() -> None:
    assert [row["met"] for row in control.judged_bytes([300, 300], 5000)] == [None, True, True]
    assert [row["met"] for row in control.judged_bytes([300, 301], 300)] == [None, False, False]


def test_a_warm_server_that_is_no_quicker_for_real_misses_its_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    for quick, met in ((0.4, True), (0.6, False)):
        monkeypatch.setattr(warm, "in_local_mode", lambda servers, _, quick=quick: [quick if servers else 1.0] * 3)
        assert [row["met"] for row in warm.for_real()] == [met]


def test_a_sweep_that_its_timeout_cuts_off_misses_its_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of such a sweep is only its timeout."""
    monkeypatch.setitem(world.TIMEOUTS, "sweep", 0.001)
    with quiet():
        found = world.SimulatedWorld(7)
        found.run(700.0)
        longest, cut_off = scale.sweeps(found)
    assert longest["met"] is None
    assert (cut_off["value"], cut_off["met"]) == (2, False)


def test_a_slow_policy_that_was_never_late_proves_nothing() -> None:
    with pytest.raises(RuntimeError, match="never late"):
        load.judged_policy(1.0, 1.0, 0.0)


def test_without_a_browser_the_row_says_how_to_install_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        browser, "chromium_path", lambda: (_ for _ in ()).throw(browser.NoChromium(browser.NO_CHROMIUM))
    )
    (row,) = table.each([trial.in_chromium])
    assert not table.measured(row)
    assert "apt-get install chromium" in row["error"]


def test_memory_that_grows_with_the_study_misses_its_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = {"participants": data.PARTICIPANTS, "problems": 0, "frames": 1, "recordings": 1}

    def measured(people: int) -> tuple[data.DataRun, data.DataRun]:
        ran = data.DataRun(1.0, held[people], {"counts": counts, "run": {"new": 1}})
        return ran, ran

    monkeypatch.setattr(data, "_measured", measured)
    held = {data.FEWER: 200.0, data.PARTICIPANTS: 210.0}
    assert [row["met"] for row in data.download() if "memory" in row["name"]] == [True]
    held[data.PARTICIPANTS] = 600.0
    assert [row["met"] for row in data.download() if "memory" in row["name"]] == [False]


def test_a_participant_whose_server_costs_more_calls_misses_the_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    usual = study_on_moto.MeasuredStudy.invoke

    def chatty(study: study_on_moto.MeasuredStudy, function: types.ModuleType, event: Any) -> dict[str, Any]:
        answer = usual(study, function, event)
        of = study.calls[function.__name__.rpartition(".")[2]]
        of.extend(of[-1:])
        return answer

    monkeypatch.setattr(study_on_moto.MeasuredStudy, "invoke", chatty)
    assert next(control.calls_of_a_participant())["met"] is False


def test_a_heavy_game_page_misses_its_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pages, "GAME_PAGE", 1000)
    assert [row["met"] for row in pages.weights() if "game page" in row["name"]] == [False, False]


def test_a_fault_that_strands_a_participant_misses_its_goal(monkeypatch: pytest.MonkeyPatch) -> None:
    stranded = types.SimpleNamespace(well=False)
    monkeypatch.setattr(scale.faults, "explore", lambda journey, seed: [stranded])
    assert [row["met"] for row in scale.faults_of_journeys()] == [None, False]


def test_warm_servers_that_do_not_help_or_stay_miss_their_goals(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(warm, "hour_of_arrivals", lambda: [warm.OPENS, warm.OPENS + 10])
    usual = warm.simulated
    monkeypatch.setattr(warm, "simulated", lambda servers, arrivals: usual(0, arrivals, 1e9, 460.0))
    with quiet():
        rows = {row["name"].partition(": ")[2]: row["met"] for row in warm.an_hour()}
    assert rows["asked for a server until the page shows it, p50, against none warm"] is False
    assert rows["wait at the game page, p50, against none warm"] is False
    assert rows["left when the study is closed"] is False


# Several participants


def test_games_of_several_that_deliver_too_little_miss_their_goals() -> None:
    def all_rows(share: float) -> list[table.Row]:
        found = together.TogetherLoad([1.0, share], 40.0, 0.7, 30.0)
        return [*together.judged_game(2, found), *together.judged_core([found] * 3)]

    assert_well_formed(all_rows(1.0))
    assert [row["met"] for row in all_rows(1.0)] == [True, None, True, None]
    assert [row["met"] for row in all_rows(0.9)] == [False, None, False, None]


def test_processor_times_say_of_which_python_they_are() -> None:
    alone = load.ServerLoad(1.0, 1.0, 40.0, 50.0)
    several = together.TogetherLoad([1.0, 1.0], 40.0, 0.7, 30.0)
    on_a_core = next(load.judged_core([alone])), next(together.judged_core([several]))
    for found in (load.judged_cpu(alone, 0.5), *on_a_core):
        assert found["detail"]["Python"] == platform.python_version()
        assert found["detail"]["a turn of a plain loop of it, ns"] > 0


def test_views_that_are_late_or_apart_miss_their_goals() -> None:
    good = together.PairSeen([1.0, 1.0], [[30.0] * 9, [31.0] * 9], [0, 1, 1, 0])
    assert_well_formed(list(together.judged_views(good)))
    assert [row["met"] for row in together.judged_views(good)] == [True] * 4
    bad = together.PairSeen([1.0, 0.9], [[39.0] * 9, [40.0] * 9], [0, 2])
    assert [row["met"] for row in together.judged_views(bad)] == [False] * 4


def test_how_far_two_views_are_apart_is_judged_at_each_draw_of_either() -> None:
    assert together.apart([[0, 7], [33, 8], [66, 9]], [[1, 7], [34, 8], [67, 9]]) == [0, 1, 0, 1, 0]
    assert max(together.apart([[0, 7], [33, 8], [66, 9]], [[1, 7], [100, 9]])) == 2
    assert together.apart([[0, 7]], []) == []


def test_a_game_of_two_is_measured_at_a_real_server(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(load, "SETTLE", 0.1)
    monkeypatch.setattr(load, "SECONDS", 1.0)
    with together.server(2) as one:
        (found,) = asyncio.run(together.played([one], 2))
    assert len(found.shares) == 2
    assert min(found.shares) > 0  # how many ticks of a second come, a busy machine decides
    assert found.cpu > 0
    assert 10 < found.bytes_a_tick < 500


def test_a_crowd_of_pairs_with_a_split_group_or_a_stranded_participant_misses_its_goal() -> None:
    with quiet():
        found = sessions.crowd(sessions.PAIRS, people=12, within=6.0)
        rows = [*sessions.judged("in pairs", found), *sessions.costs(found)]
        assert_well_formed(rows)
        assert [row["met"] for row in rows] == [True, None, None, None]
        assert rows[3]["value"] < 0.01
        assert_well_formed([sessions.waits_of([found, found])])
        assert len(found.at_best) == len(found.waits) == 12
        assert sum(found.at_best) < sum(found.waits), "nobody is served before a server is ready"
        found.came[0].visit.finished = None
        assert next(sessions.judged("in pairs", found))["met"] is False
        found.came[0].visit.reason = "left by themselves"
        assert next(sessions.judged("in pairs", found))["met"] is True
        found.came[0].asked_at.clear()
        assert next(sessions.judged("in pairs", found))["met"] is False
        nobody = sessions.crowd(sessions.PAIRS, Conditions(stillborn=1.0), people=2, within=1.0)
        assert next(sessions.judged("in pairs", nobody))["value"] == 0, "both are told, and nobody plays"
        assert min(nobody.waits) > 60
    assert sessions.judged_faults(0)["met"] is True
    assert sessions.judged_faults(1)["met"] is False


def test_clients_of_the_bench_acknowledge_as_the_page_does(monkeypatch: pytest.MonkeyPatch) -> None:
    async def acknowledged(times: list[float]) -> list[int]:
        told: list[str] = []

        async def send(text: str) -> None:
            told.append(text)

        acknowledging, loop = load.Acknowledging(send), asyncio.get_running_loop()
        plain = loop.time
        for picture, now in enumerate(times, 1):
            monkeypatch.setattr(loop, "time", lambda now=now: now)
            await acknowledging.drawn(picture)
        monkeypatch.setattr(loop, "time", plain)
        await until_async(lambda: told and json.loads(told[-1])["ack"] >= len(times))
        return [json.loads(text)["ack"] for text in told]

    assert asyncio.run(acknowledged([5.0, 5.03, 5.06, 5.09, 5.12, 5.3, 5.33, 5.36])) == [1, 3, 5, 6, 8]
    assert asyncio.run(acknowledged([5.0, 5.03])) == [1, 2], "no other picture came"
    told = re.search(r"const ACK_WAIT = (\d+);", (pictures.ROOT / "web/game/connection.js").read_text(encoding="utf-8"))
    assert told is not None
    assert int(told[1]) == 1000 * load.TOGETHER


# Each goal


SEEN_MISSED: dict[str, Any] = {
    "control.calls_of_requests": test_requests_with_more_calls_miss_their_goals,
    "control.calls_of_a_participant": test_a_participant_whose_server_costs_more_calls_misses_the_goal,
    "control.judged_bytes": test_answers_that_write_more_each_time_miss_their_goals,
    "control.judged_start": test_cold_starts_that_are_slow_miss_their_goals,
    "data.download": test_memory_that_grows_with_the_study_misses_its_goal,
    "functions.judged_import": test_cold_starts_that_are_slow_miss_their_goals,
    "gym._single": test_an_expensive_server_of_environments_misses_its_goals,
    "gym._batched": test_an_expensive_server_of_environments_misses_its_goals,
    "load.judged_cpu": test_trials_that_cost_too_much_or_deliver_too_little_miss_their_goals,
    "load.judged_core": test_trials_that_cost_too_much_or_deliver_too_little_miss_their_goals,
    "load.judged_policy": test_trials_that_cost_too_much_or_deliver_too_little_miss_their_goals,
    "pages.weights": test_a_heavy_game_page_misses_its_goal,
    "scale.costs": test_functions_that_run_for_long_miss_their_goal,
    "scale.faults_of_journeys": test_a_fault_that_strands_a_participant_misses_its_goal,
    "scale.served": test_a_crowd_with_a_stranded_participant_or_a_leftover_misses_its_goal,
    "scale.served_many": test_a_crowd_with_a_stranded_participant_or_a_leftover_misses_its_goal,
    "scale.small_account": test_pages_that_find_no_room_miss_their_goal,
    "scale.sweeps": test_a_sweep_that_its_timeout_cuts_off_misses_its_goal,
    "scale.waiting": test_a_start_server_with_a_concurrency_of_two_misses_the_goal_of_waiting,
    "scenes.judged": test_objects_that_are_late_or_large_miss_their_goals,
    "sessions.judged": test_a_crowd_of_pairs_with_a_split_group_or_a_stranded_participant_misses_its_goal,
    "sessions.judged_faults": test_a_crowd_of_pairs_with_a_split_group_or_a_stranded_participant_misses_its_goal,
    "together.judged_game": test_games_of_several_that_deliver_too_little_miss_their_goals,
    "together.judged_core": test_games_of_several_that_deliver_too_little_miss_their_goals,
    "together.judged_views": test_views_that_are_late_or_apart_miss_their_goals,
    "trial._seen": test_expensive_late_or_changed_frames_miss_their_goals,
    "trial.encoding": test_pictures_that_cost_more_than_hippos_miss_their_goals,
    "trial.judged_idle": test_a_server_that_is_busy_without_participants_misses_its_goal,
    "warm._compared": test_warm_servers_that_do_not_help_or_stay_miss_their_goals,
    "warm.an_hour": test_warm_servers_that_do_not_help_or_stay_miss_their_goals,
    "warm.for_real": test_a_warm_server_that_is_no_quicker_for_real_misses_its_goal,
}


def test_each_goal_has_a_test_that_reports_it_as_missed() -> None:
    """A new goal needs a test, and a line in SEEN_MISSED."""
    functions_with_goals = set()
    for file in (study_on_moto.ROOT / "bench").glob("*.py"):
        for node in ast.parse(file.read_text(encoding="utf-8")).body:
            calls = [call for call in ast.walk(node) if isinstance(call, ast.Call) and ast.unparse(call.func) == "row"]
            if {keyword.arg for call in calls for keyword in call.keywords} & {"at_most", "at_least"}:
                functions_with_goals.add(f"{file.stem}.{getattr(node, 'name', '')}")
    assert functions_with_goals == set(SEEN_MISSED)
