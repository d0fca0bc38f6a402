"""What the sweep tells CloudWatch, and that the template's alarms and dashboard read just that."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from datetime import timedelta
from typing import Any

import pytest

from hippodrome import ids, metrics
from hippodrome.messages import StartServer
from hippodrome.servers import Servers
from hippodrome.sweep import Census, Sweep, Swept
from lambdas import installed as place
from lambdas import sweep
from tests.fake_platform import FakePlatform
from tests.infra import template as cfn
from tests.studies import installed

USERS = ("R_alice", "R_bob")


@pytest.fixture
def platform() -> Iterator[FakePlatform]:
    made = installed()
    place.use(made)
    yield made
    place.use(None)


def told(capsys: pytest.CaptureFixture[str]) -> dict[str, Any]:
    """The one line of metrics on stdout, among the log's lines."""
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines() if line.startswith("{")]
    (found,) = [line for line in lines if "_aws" in line]
    return found


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
    assert done.census == Census(servers=2, oldest=timedelta(minutes=30))


def test_without_servers_there_is_none_and_no_age(platform: FakePlatform) -> None:
    done = Sweep(platform)
    done.run()
    assert done.census == Census(0, timedelta())


def test_a_sweep_tells_what_it_found(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("STACK", "hippodrome-2")
    start(platform, *USERS)
    platform.clock += timedelta(minutes=90)
    sweep.handler({}, None)
    line = told(capsys)
    assert line["Stack"] == "hippodrome-2"
    assert (line["Servers"], line["OldestServer"], line["ServersOverdue"]) == ([2.0], [90.0], [2.0])
    (described,) = line["_aws"]["CloudWatchMetrics"]
    assert (described["Namespace"], described["Dimensions"]) == ("Hippodrome", [["Stack"]])
    text = json.dumps(line)
    assert not any(secret in text for secret in (*USERS, "maze", ids.server_label("maze", USERS[0])))


def test_without_a_stack_nothing_is_told(
    platform: FakePlatform, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv("STACK", raising=False)
    sweep.handler({}, None)
    assert "_aws" not in capsys.readouterr().out


def test_alarms_and_dashboard_read_what_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    metrics.report(
        "hippodrome", Census(1, timedelta(minutes=7)), Swept(tasks=1, names=2, timers=3, clusters=4, failed=9)
    )
    line = told(capsys)
    assert (line["LeftoversRemoved"], line["SweepFailures"]) == ([10.0], [9.0])
    names = {metric["Name"] for metric in line["_aws"]["CloudWatchMetrics"][0]["Metrics"]}

    alarms = [a for a in cfn.resources("AWS::CloudWatch::Alarm").values() if a["Namespace"] == metrics.NAMESPACE]
    assert [(a["MetricName"], a["Threshold"], a["Dimensions"][0]["Name"]) for a in alarms] == [
        ("OldestServer", {"Ref": "MaxRuntime"}, metrics.DIMENSION)
    ]
    body = json.loads(cfn.Account().resolve(cfn.resources("AWS::CloudWatch::Dashboard")["Dashboard"]["DashboardBody"]))
    shown: set[str] = set()
    for widget in body["widgets"]:
        space = ""
        for metric in widget["properties"].get("metrics", []):
            space = metric[0] if metric[0] not in (".", "...") else space
            shown |= {metric[1]} if space == metrics.NAMESPACE else set()
    assert shown == names
