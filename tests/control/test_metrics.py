"""The metrics that functions write for CloudWatch; the template's alarms and dashboard read exactly these."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control import metrics
from hippodrome.control.model import ids
from hippodrome.control.model.messages import StartServer
from hippodrome.control.ports import Refused
from hippodrome.control.servers.causes import Cause, FailureCategory
from hippodrome.control.servers.sweep import RunningServers, Sweep, SweepResult
from hippodrome.functions import start_server, sweep, task_changed
from testing import template as cfn
from testing.aws_events import queue_event, task_event
from testing.fake_platform import FakePlatform
from testing.servers import Servers

ROOT = Path(__file__).resolve().parents[2]
USERS = ("R_alice", "R_bob")


def metrics_line(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """Return the one line of metrics on stdout, among the log's lines."""
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    (found,) = [line for line in lines if "_aws" in line]
    return found


def ours(kind: str) -> list[dict[str, Any]]:
    """Return the template's resources of this type that watch Hippodrome's own metrics."""
    return [one for one in cfn.resources(kind).values() if one["Namespace"] == metrics.NAMESPACE]


def start(platform: FakePlatform, *users: str) -> None:
    for user in users:
        Servers(platform).start(StartServer("maze", user))


def test_the_census_counts_our_servers_and_the_age_of_the_oldest(platform: FakePlatform) -> None:
    start(platform, USERS[0])
    platform.clock += timedelta(minutes=25)
    start(platform, USERS[1])
    platform.clock += timedelta(minutes=5)
    stranger = ids.server_name(ids.server_label("somebody-elses", "R_carol"), 1)
    platform.tasks.running["arn:stranger"] = replace(next(iter(platform.tasks.running.values())), name=stranger)
    done = Sweep(platform)
    done.run()
    assert done.running == RunningServers(count=2, oldest=timedelta(minutes=30))


def test_without_servers_the_count_and_the_age_are_zero(platform: FakePlatform) -> None:
    done = Sweep(platform)
    done.run()
    assert done.running == RunningServers(0, timedelta())


def test_a_sweep_writes_its_findings_as_metrics(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STACK", "hippodrome-2")
    start(platform, *USERS)
    platform.clock += timedelta(minutes=90)
    sweep.handler({}, None)
    line = metrics_line(capsys)
    assert line["Stack"] == "hippodrome-2"
    assert (line["Servers"], line["OldestServer"], line["ServersOverdue"]) == ([2.0], [90.0], [2.0])
    (described,) = line["_aws"]["CloudWatchMetrics"]
    assert (described["Namespace"], described["Dimensions"]) == ("Hippodrome", [["Stack"]])
    text = json.dumps(line)
    assert not any(secret in text for secret in (*USERS, "maze", ids.server_label("maze", USERS[0])))


def test_without_a_stack_no_metrics_are_written(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("STACK", raising=False)
    sweep.handler({}, None)
    assert "_aws" not in capsys.readouterr().out


def failed_task(name: str, stop_code: str, reason: str) -> dict[str, Any]:
    return task_event("arn:task", name, "STOPPED", "STOPPED", stop_code=stop_code, reason=reason)


def test_failed_servers_are_counted_once_by_who_can_mend_the_cause(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STACK", "hippodrome-2")
    start(platform, *USERS)
    events = [
        failed_task(ids.server_name(ids.server_label("maze", user), 1), "TaskFailedToStart", "CannotPullContainerError")
        for user in USERS
    ]
    for _ in range(2):  # events may come twice
        task_changed.handler(queue_event(events), None)
    line = metrics_line(capsys)
    assert (line["Stack"], line["Fault"], line["ServersFailed"]) == ("hippodrome-2", "image", [2.0])
    assert line["causes"] == {"image": 2}
    (described,) = line["_aws"]["CloudWatchMetrics"]
    assert (described["Namespace"], described["Dimensions"]) == (metrics.NAMESPACE, [["Stack", "Fault"]])


def test_a_server_that_aws_refuses_is_counted_at_its_start(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STACK", "hippodrome-2")
    platform.tasks.fail = [Refused("ClientException: TaskDefinition not found.")]
    message = {"projectId": "maze", "userId": USERS[0], "attempt": 1}
    start_server.handler(queue_event([message]), None)
    assert metrics_line(capsys)["causes"] == {"no task definition": 1}


def test_without_failures_no_metrics_of_failures_are_written(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STACK", "hippodrome-2")
    start(platform, USERS[0])
    name = ids.server_name(ids.server_label("maze", USERS[0]), 1)
    task_changed.handler(queue_event([failed_task(name, "UserInitiated", "hippodrome: stopped")]), None)
    assert "_aws" not in capsys.readouterr().out


def test_the_functions_that_start_servers_do_not_import_the_metrics() -> None:
    code = (
        "import lambdas.task_changed, lambdas.start_server, sys; sys.exit('hippodrome.control.metrics' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0


def test_every_cause_has_a_category_with_an_alarm_and_a_sentence() -> None:
    watched = {a["Dimensions"][1]["Value"] for a in ours("AWS::CloudWatch::Alarm") if len(a["Dimensions"]) > 1}
    assert {cause.category for cause in Cause} == watched
    assert all(cause.sentence.endswith(".") for cause in Cause)


def test_alarms_and_dashboard_read_exactly_the_metrics_that_are_written(capsys: pytest.CaptureFixture[str]) -> None:
    metrics.report(
        "hippodrome",
        RunningServers(1, timedelta(minutes=7)),
        SweepResult(tasks=1, names=2, timers=3, clusters=4, failed=9),
    )
    line = metrics_line(capsys)
    assert (line["LeftoversRemoved"], line["SweepFailures"]) == ([10.0], [9.0])
    names = {metric["Name"] for metric in line["_aws"]["CloudWatchMetrics"][0]["Metrics"]}

    oldest, *faults = sorted(ours("AWS::CloudWatch::Alarm"), key=lambda a: a["MetricName"])
    assert (oldest["MetricName"], oldest["Threshold"]) == ("OldestServer", {"Ref": "MaxRuntime"})
    assert {a["MetricName"] for a in faults} == {"ServersFailed"}
    assert {a["Dimensions"][0]["Name"] for a in (oldest, *faults)} == {metrics.DIMENSION}
    assert sorted(a["Dimensions"][1]["Value"] for a in faults) == sorted(FailureCategory)
    body = json.loads(
        cfn.ReferenceValues().resolve(cfn.resources("AWS::CloudWatch::Dashboard")["Dashboard"]["DashboardBody"])
    )
    shown: set[str] = set()
    for widget in body["widgets"]:
        space = ""
        # "..." stands for the metric before it.
        for metric in (m for m in widget["properties"].get("metrics", []) if m[0] != "..."):
            space = metric[0] if metric[0] != "." else space
            shown |= {metric[1]} if space == metrics.NAMESPACE else set()
    assert shown == names | {"ServersFailed"}
