"""`hippodrome logs`: it shows the lines of all functions and servers in the order of time."""

from __future__ import annotations

import contextlib
import json
from datetime import UTC, datetime, timedelta
from typing import Any

import msgspec
import pytest

from hippodrome.console.problem import Exit
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.operate import logs
from hippodrome.deployment.operate.logs import moment, read
from testing import template as cfn
from testing.studies import study
from tests.deployment.installation import Installed, process

NOW = datetime.now(UTC)


def put_messages(
    world: Installed, source: str, *messages: str, ago: float = 60, stream: str = "a", step: float = 0.001
) -> None:
    """Put messages into the log of a function, the first of them `ago` seconds ago."""
    client, group = world.client("logs"), resource_names.log_group("hippodrome", source)
    for create, names in (
        (client.create_log_group, {"logGroupName": group}),
        (client.create_log_stream, {"logGroupName": group, "logStreamName": stream}),
    ):
        with contextlib.suppress(client.exceptions.ResourceAlreadyExistsException):
            create(**names)
    start = datetime.now(UTC).timestamp() - ago
    events = [{"timestamp": int((start + n * step) * 1000), "message": m} for n, m in enumerate(messages)]
    for at in range(0, len(events), 10_000):
        client.put_log_events(logGroupName=group, logStreamName=stream, logEvents=events[at : at + 10_000])


def log_message(level: str, message: str, **fields: object) -> str:
    return json.dumps({"level": level, "location": "x:1", "message": message, "service": "hippodrome", **fields})


def test_each_log_group_of_the_template_has_a_source() -> None:
    names = {group["LogGroupName"]["Fn::Sub"] for group in cfn.resources("AWS::Logs::LogGroup").values()}
    groups = {name.replace("${AWS::StackName}", "lab") for name in names}
    assert {resource_names.log_group("lab", resource_names.log_source("lab", group)) for group in groups} == groups
    assert all(group.startswith(resource_names.log_prefixes("lab")) for group in groups)


def test_the_sites_access_log_is_read_with_the_others(installed: Installed, capsys: Any) -> None:
    put_messages(installed, "next_step", log_message("INFO", "first"), ago=50)
    put_messages(installed, "api", '{"route":"GET /next","status":"200"}', ago=40)
    assert [one["source"] for one in lines(installed.run(capsys, "logs", "--all", "--json"))] == ["next_step", "api"]
    assert [one["source"] for one in lines(installed.run(capsys, "logs", "--all", "--function", "api", "--json"))] == [
        "api"
    ]


def lines(ran: Any) -> list[dict[str, Any]]:
    return [json.loads(line) for line in ran.out.splitlines()]


def test_lines_of_all_groups_come_in_the_order_of_time(installed: Installed, capsys: Any) -> None:
    put_messages(installed, "start_server", log_message("INFO", "first", server="s1"), ago=50)
    put_messages(installed, "trial", "2026-11-21 17:26:57,496 WARNING second", ago=40, stream="maze/trial/1")
    put_messages(
        installed, "next_step", "START RequestId: 1 Version: 1", log_message("ERROR", "third", code="SlowDown"), ago=30
    )
    put_messages(installed, "start_server", "fourth, of no known form", ago=20, stream="b")
    ran = installed.run(capsys, "logs", "--all", "--json")
    assert [(one["source"], one["level"], one["message"]) for one in lines(ran)] == [
        ("start_server", "INFO", "first"),
        ("trial", "WARNING", "second"),
        ("next_step", "ERROR", "third"),
        ("start_server", "", "fourth, of no known form"),
    ]
    text = installed.run(capsys, "logs", "--all", "--everything").out
    assert "START RequestId" in text
    assert "ERROR   third  code=SlowDown" in text


def test_lines_with_metrics_are_not_shown(installed: Installed, capsys: Any) -> None:
    metrics = json.dumps({"_aws": {"CloudWatchMetrics": []}, "Stack": "hippodrome", "Servers": [4.0]})
    put_messages(installed, "sweep", log_message("INFO", "swept", tasks=0), metrics)
    assert [one["message"] for one in lines(installed.run(capsys, "logs", "--all", "--json"))] == ["swept"]
    assert "metrics  Stack=hippodrome Servers=[4.0]" in installed.run(capsys, "logs", "--all", "--everything").out


def test_logs_says_that_there_are_no_lines(installed: Installed, capsys: Any) -> None:
    put_messages(installed, "sweep", log_message("INFO", "swept"))
    ran = installed.run(capsys, "logs", "--all", "--errors", "--since", "10m")
    assert (ran.code, ran.out) == (Exit.DONE, "")
    assert "No errors were logged since" in ran.err
    assert installed.run(capsys, "logs", "--all").err == ""


def test_lines_of_more_than_a_page_are_all_shown(installed: Installed, capsys: Any) -> None:
    put_messages(installed, "next_step", *[log_message("INFO", f"line {n}") for n in range(10_500)], ago=600)
    ran = installed.run(capsys, "logs", "--all", "--function", "next_step", "--json")
    assert [one["message"] for one in lines(ran)] == [f"line {n}" for n in range(10_500)]


def test_errors_can_be_shown_alone_with_the_tracebacks_of_trials(installed: Installed, capsys: Any) -> None:
    trial = ["t 1 INFO fine", "2026-11-21 17:26:57 INFO fine", "2026-11-21 17:26:58 ERROR the agent failed"]
    put_messages(
        installed,
        "trial",
        *trial,
        "Traceback (most recent call last):",
        "  KeyError",
        "2026-11-21 17:27:00 INFO on",
        "plain",
    )
    put_messages(
        installed, "sweep", "2026-11-21T10:00:00Z 1-2 Task timed out after 30.03 seconds", log_message("INFO", "swept")
    )
    put_messages(installed, "stop_server", "[ERROR] Runtime.ImportModuleError: Unable to import module")
    ran = installed.run(capsys, "logs", "--all", "--errors", "--json")
    assert sorted(one["message"] for one in lines(ran)) == [
        "  KeyError",
        "2026-11-21T10:00:00Z 1-2 Task timed out after 30.03 seconds",
        "Traceback (most recent call last):",
        "[ERROR] Runtime.ImportModuleError: Unable to import module",
        "the agent failed",
    ]


def test_the_lines_of_one_project_can_be_shown_alone(installed: Installed, capsys: Any) -> None:
    other = msgspec.structs.replace(study(), id="other")
    installed.register(study(), other)
    mine, theirs = installed.record("alice"), installed.record("alice", project=other)
    put_messages(
        installed,
        "start_server",
        *[log_message("INFO", "starting", server=r.name) for r in (mine, theirs)],
        log_message("INFO", "odd"),
    )
    put_messages(installed, "trial", "2026-11-21 17:26:57 INFO mine", stream="maze/trial/1")
    put_messages(installed, "trial", "2026-11-21 17:26:57 INFO theirs", stream="other/trial/2")
    shown = lines(installed.run(capsys, "logs", "maze", "--json"))
    assert [(one["message"], one.get("fields", {}).get("server")) for one in shown] == [
        ("starting", mine.name),
        ("mine", None),
    ]
    assert "No project named labyrinth" in installed.run(capsys, "logs", "labyrinth").err


def test_without_permission_to_list_groups_those_of_the_template_are_read(installed: Installed, capsys: Any) -> None:
    put_messages(installed, "stop_server", log_message("INFO", "hello"))
    installed.fail("logs:DescribeLogGroups", "AccessDeniedException", status=400)
    assert [one["message"] for one in lines(installed.run(capsys, "logs", "--all", "--json"))] == ["hello"]


def test_since_says_how_far_back_lines_are_shown(installed: Installed, capsys: Any) -> None:
    put_messages(installed, "sweep", log_message("INFO", "old"), ago=7200)
    put_messages(installed, "sweep", log_message("INFO", "new"), ago=5)
    assert [one["message"] for one in lines(installed.run(capsys, "logs", "--all", "--json"))] == ["new"]
    assert [one["message"] for one in lines(installed.run(capsys, "logs", "--all", "--json", "--since", "3h"))] == [
        "old",
        "new",
    ]
    ran = installed.run(capsys, "logs", "--all", "--since", "yesterday")
    assert (ran.code, ran.out) == (Exit.FAILED, "")
    assert "--since yesterday is no time" in ran.err
    assert "There is: sweep" in installed.run(capsys, "logs", "--all", "--function", "nonsense").err


@pytest.mark.parametrize(
    ("text", "ago"),
    [
        ("90s", timedelta(seconds=90)),
        ("30m", timedelta(minutes=30)),
        (" 2d ", timedelta(days=2)),
        ("1w", timedelta(weeks=1)),
    ],
)
def test_since_takes_spans_and_times(text: str, ago: timedelta) -> None:
    assert NOW - moment(text, NOW) == ago


@pytest.mark.parametrize("text", ["", "h", "1y", "-1h", "99999w", "2026-13-01"])
def test_other_values_of_since_are_refused(text: str) -> None:
    with pytest.raises(ValueError):
        moment(text, NOW)


@pytest.mark.parametrize(
    "message",
    [
        "",
        "{",
        "[" * 5000,
        "null",
        '{"level": 7, "message": {"a": 1}}',
        "\x00\x1b[31m",
    ],
)
def test_hostile_lines_hold_no_escape_sequences_and_become_valid_json(message: str) -> None:
    line = read({"timestamp": 1, "message": message}, "next_step")
    assert "\x1b" not in line.as_text()
    json.dumps(line.as_json())


def test_following_shows_each_event_once_including_late_ones(
    installed: Installed, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_messages(installed, "sweep", log_message("INFO", "one"), ago=20)
    reader = logs.Reader(installed.client("logs"), "hippodrome")
    more = [(log_message("INFO", "two"), 2.0), (log_message("INFO", "late"), 15.0)]
    shown: list[str] = []

    def sleep(_: float) -> None:
        if not more:
            raise KeyboardInterrupt
        message, ago = more.pop(0)
        put_messages(installed, "sweep", message, ago=ago)

    monkeypatch.setattr(logs.time, "sleep", sleep)
    with pytest.raises(KeyboardInterrupt):
        logs.follow(
            lambda since: reader.events(["sweep"], since),
            NOW - timedelta(hours=1),
            lambda line: shown.append(line.message),
        )
    assert shown == ["one", "two", "late"]


def test_as_a_process(installed: Installed) -> None:
    put_messages(
        installed, "start_server", log_message("INFO", "starting", server="s"), log_message("ERROR", "it failed")
    )
    with installed.served() as env:
        ran = process(env, "logs", "--all", "--json")
        plain = process(env, "logs", "--all", "--errors")
    assert (ran.code, [one["message"] for one in lines(ran)]) == (Exit.DONE, ["starting", "it failed"])
    assert plain.code == Exit.DONE
    assert plain.out.endswith("start_server   ERROR   it failed\n")
