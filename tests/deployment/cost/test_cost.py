"""`hippodrome cost`: before a study without an account, after it from the servers' own records."""

from __future__ import annotations

import json
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import msgspec
import pytest

from hippodrome import cli
from hippodrome.console.problem import Exit
from hippodrome.control.config import read_project
from hippodrome.control.model.server import PastAttempt, Reason, Server, ServerState
from hippodrome.deployment.code.template import Template
from hippodrome.deployment.cost import estimate, prices
from hippodrome.deployment.cost.cost import _study, _warm
from hippodrome.deployment.cost.estimate import (
    POLLS,
    StudyToEstimate,
    assumptions,
    month_lines,
    study_lines,
    total,
)
from hippodrome.deployment.cost.prices import DATE, REGION, Range, note
from hippodrome.deployment.cost.spent import spent
from testing.studies import study
from tests.deployment.installation import ROOT, Installed, environment, process

NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)
MAZE = StudyToEstimate(participants=100, steps=5, cpu=1, memory=2, max_runtime=30, minutes=15)
PAIRS = StudyToEstimate(participants=100, steps=5, cpu=1, memory=2, max_runtime=30, minutes=15, players=2)
HOUR = 0.04048 + 2 * 0.004445


# Before


def test_the_servers_cost_what_fargate_charges_for_their_time() -> None:
    servers, addresses = study_lines(MAZE)[:2]
    assert servers.usd.likely == pytest.approx(25 * HOUR * 0.35)
    assert servers.usd.low == pytest.approx(25 * HOUR * 0.30)
    assert servers.usd.high == pytest.approx(50 * HOUR)  # until maxRuntime, and without capacity on Spot
    assert addresses.usd == Range(25 * 0.005, 25 * 0.005, 50 * 0.005)
    assert study_lines(MAZE.__class__(**{**vars(MAZE), "spot": False}))[0].usd.low == pytest.approx(25 * HOUR)


def test_every_line_has_low_likely_and_high_in_order_and_grows_with_the_participants() -> None:
    few, many = (
        study_lines(MAZE),
        study_lines(StudyToEstimate(**{**vars(MAZE), "participants": 1000})),
    )
    for one, ten in zip(few, many, strict=True):
        assert one.usd.low <= one.usd.likely <= one.usd.high, one
        assert ten.usd.likely == pytest.approx(10 * one.usd.likely)
    month = month_lines()
    assert all(line.usd.low <= line.usd.likely <= line.usd.high for line in month)
    assert 0.5 < total(month).likely < 10


def test_signing_requests_of_servers_are_counted() -> None:
    """A server has at least four requests signed: two for the certificate, one for the answer, one for a recording."""
    lines = {line.what: line for line in study_lines(MAZE)}
    looks = MAZE.participants * (2 * MAZE.steps - 1 + POLLS.likely)
    assert lines["HTTP API"].usd.likely >= (looks + 4 * MAZE.participants) * prices.HTTP_REQUEST
    none = {line.what: line for line in study_lines(StudyToEstimate(**{**vars(MAZE), "games": False}))}
    assert none["HTTP API"].usd.likely == pytest.approx(MAZE.participants * (2 * MAZE.steps - 1) * prices.HTTP_REQUEST)


def test_five_pollers_ask_each_queue_all_the_time() -> None:
    """Lambda reduces the pollers of a quiet queue only for mappings without a maximum concurrency."""
    (queues,) = [line for line in month_lines() if "SQS" in line.what]
    asked = 3 * 5 * 730 * 3600 / 20
    assert queues.usd.likely == pytest.approx((asked - 1e6) * prices.SQS_REQUEST)
    assert queues.usd.high == pytest.approx(asked * prices.SQS_REQUEST)


def test_the_documentation_states_the_cost_of_an_idle_installation() -> None:
    """About two and a half dollars are likely; about nine if the rest of the account has used up the free tier."""
    idle = total(month_lines())
    assert 2.25 < idle.likely < 2.75
    assert round(idle.high) == 9
    for page in ("docs/aws.md", "docs/running.md"):
        assert "about two and a half dollars" in (ROOT / page).read_text(encoding="utf-8"), page


def test_the_estimate_names_one_participant_in_the_singular() -> None:
    assert assumptions(MAZE)[0].startswith("100 participants, ")
    assert assumptions(replace(MAZE, participants=1))[0].startswith("1 participant, ")


def test_a_study_without_a_game_needs_no_servers() -> None:
    lines = {line.what: line for line in study_lines(StudyToEstimate(**{**vars(MAZE), "games": False}))}
    assert not any(what.startswith(("Servers", "Public")) for what in lines)
    assert lines["Messages and DNS (SNS, SQS, Route 53)"].usd.high == 0
    assert lines["HTTP API"].usd.likely > 0


def test_the_estimate_says_that_every_opened_link_starts_a_server(tmp_path: Path) -> None:
    """People who open the link and leave are not counted as participants, so no figure includes their servers."""
    said = "Every opened link starts a server."
    assert not any(said in line for line in assumptions(MAZE))
    assert any(said in line for line in assumptions(StudyToEstimate(**{**vars(MAZE), "at_link": True})))
    (tmp_path / "steps").mkdir()
    for page in ("consent", "rules", "thanks"):
        (tmp_path / "steps" / f"{page}.html").write_text("x")
    text = "project: {id: maze, steps: {1: consent, 2: rules, 3: game, 4: thanks}%s}\ntrial: {game: maze}\n"
    for events, expected in (
        ("", False),
        (", events: {startServerStep: 1}", True),
        (", events: {startServerStep: 2}", False),
    ):
        (tmp_path / "config.yml").write_text(text % events)
        assert _study(read_project(tmp_path), 1, None, spot=True).at_link is expected


@pytest.mark.parametrize(
    ("price", "said"),
    [
        (
            ", price: {input: 0.5, output: 1.5}",
            "about 0.03 at most for each participant, and 15.00 for 500 participants:",
        ),
        ("", "is not known: config.yml has no llm.price."),
    ],
)
def test_the_estimate_says_that_the_language_model_comes_on_top(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], price: str, said: str
) -> None:
    (tmp_path / "steps").mkdir()
    for page in ("consent", "thanks"):
        (tmp_path / "steps" / f"{page}.html").write_text("x")
    text = "project: {id: maze, steps: {1: consent, 2: game, 3: thanks}}\ntrial: {game: maze%s}\n"
    (tmp_path / "config.yml").write_text(text % "")
    assert cli.main(["cost", str(tmp_path)]) == Exit.DONE
    assert "language model" not in capsys.readouterr().out
    (tmp_path / "config.yml").write_text(
        text % f', llm: {{url: "https://x.example/v1", model: small, maxTokens: 20000{price}}}'
    )
    assert cli.main(["cost", str(tmp_path), "--participants", "500", "--json"]) == Exit.DONE
    (line,) = [line for line in json.loads(capsys.readouterr().out)["assumptions"] if "language model" in line]
    assert said in line
    assert line.endswith("The other figures are without it.")


def test_the_high_estimate_is_for_moving_textures_and_says_so() -> None:
    sent = {line.what: line.usd for line in study_lines(MAZE)}["Data to participants"]
    seconds = 30 * 60  # up to maxRuntime
    jpegs = MAZE.participants * seconds * MAZE.frame_rate * 77_000 / 1e9  # GB: the JPEG of a texture, 600 x 400 pixels
    assert sent.high == pytest.approx(jpegs * prices.OUT_GB, rel=0.02)
    (said,) = [line for line in assumptions(MAZE) if line.startswith("Pictures")]
    assert all(word in said for word in ("0.5 kB", "77 kB", "lossless"))


def test_a_month_is_counted_from_the_template() -> None:
    resources = Template.read().resources({"AlarmEmail": "", "MonthlyBudget": "0"})
    kinds = [resource["Type"] for resource in resources.values()]
    assert kinds.count("AWS::CloudWatch::Alarm") == estimate.ALARMS
    assert kinds.count("AWS::CloudWatch::Dashboard") == estimate.DASHBOARDS
    assert kinds.count("AWS::Lambda::EventSourceMapping") == estimate.QUEUES
    assert "AWS::EC2::NatGateway" not in kinds  # the estimate says that there is none
    assert "AWS::ElasticLoadBalancingV2::LoadBalancer" not in kinds


def test_the_estimate_has_the_templates_memory_sizes() -> None:
    from hippodrome.deployment.cost.estimate import NEXT_STEP_GB, WORKER_GB

    resources = Template.read().resources({})
    sizes = {r["Properties"]["FunctionName"]["Fn::Sub"]: r["Properties"]["MemorySize"] / 1024
             for r in resources.values() if r["Type"] == "AWS::Lambda::Function"}  # fmt: skip
    assert sizes.pop("${AWS::StackName}-next_step") == NEXT_STEP_GB
    assert {
        sizes[f"${{AWS::StackName}}-{name}"] for name in ("start_server", "task_changed", "stop_server", "sweep")
    } == {WORKER_GB}


@pytest.mark.parametrize(
    ("region", "later", "said"),
    [(REGION, 0, ()), ("ca-central-1", 0, ("a third more",)), (REGION, 400, ("more than a year old",))],
)
def test_the_note_says_how_well_the_prices_fit(region: str, later: int, said: tuple[str, ...]) -> None:
    text = note(region, DATE + timedelta(days=later))
    assert text.startswith(f"List prices of us-east-1, {DATE}")
    assert [word for word in ("a third more", "more than a year old") if word in text] == [*said]


# After


def ran(minutes: float, *, spot: bool = False, earlier: tuple[PastAttempt, ...] = (), **changes: Any) -> Server:
    start = NOW - timedelta(hours=5)
    given = {
        "project_id": "maze",
        "user_id": "alice",
        "attempt": 1 + len(earlier),
        "state": ServerState.CLOSED,
        "nonce": "",
        "requested": start,
        "deadline": start + timedelta(hours=1),
        "cluster": "hippodrome",
        "spot": spot,
        "cpu": 1.0,
        "memory": 2.0,
        "running": start + timedelta(seconds=40),
        "closed": start + timedelta(minutes=minutes),
        "reason": Reason.ENDED,
        "earlier": earlier,
        **changes,
    }
    return Server(**given)


def test_spending_counts_each_attempt() -> None:
    start = NOW - timedelta(hours=6)
    first = PastAttempt(
        1, start, start + timedelta(seconds=30), start + timedelta(minutes=6), 2.0, 4.0, False, Reason.LOST
    )
    refused = PastAttempt(2, start, None, start + timedelta(minutes=7), 1.0, 2.0, True, Reason.NO_CAPACITY)
    found = spent([ran(30, earlier=(first, refused))], NOW)
    assert (found.attempts, found.never_ran) == (2, 1)
    assert found.hours == pytest.approx(0.6)
    assert found.usd.likely == pytest.approx(0.5 * (HOUR + 0.005) + 0.1 * (2 * HOUR + 0.005))


def test_at_least_a_minute_is_billed_and_running_servers_cost_up_to_now() -> None:
    assert spent([ran(0.1)], NOW).hours == pytest.approx(1 / 60)
    still = ran(0, closed=None, state=ServerState.READY, reason=None)
    assert spent([still], NOW).hours == pytest.approx(5)
    assert spent([still], NOW, since=NOW - timedelta(hours=2)).hours == pytest.approx(2)
    assert spent([ran(30)], NOW, since=NOW).hours == 0


def test_the_cost_on_spot_lies_between_its_discounts() -> None:
    usd = spent([ran(60, spot=True)], NOW).usd
    assert usd.low == pytest.approx(HOUR * 0.30 + 0.005)
    assert usd.low < usd.likely < usd.high < HOUR


WARM_SERVER = "~0123456789abcdef0123"


def test_waiting_and_play_of_a_warm_server_are_each_counted_once() -> None:
    begin = NOW - timedelta(hours=4)
    taken, over = begin + timedelta(hours=2), begin + timedelta(hours=2, minutes=30)
    name = "sxxxxxxxxxxxxxxxxxxxx-1"
    waited = ran(0, user_id=WARM_SERVER, requested=begin, closed=taken, reason=Reason.ASSIGNED)
    played = ran(0, warm_server_name=name, requested=taken, running=taken, closed=over)
    together = spent([waited, played], NOW)
    assert together.hours == pytest.approx(2.5)
    assert together.usd.likely == pytest.approx(2.5 * (HOUR + 0.005))
    assert together.attempts == 1  # one task
    assert spent([waited], NOW).hours == pytest.approx(2)


def test_the_minimum_of_a_minute_is_for_waiting_and_play_together() -> None:
    taken = NOW - timedelta(hours=1)
    waited = ran(0, user_id=WARM_SERVER, requested=taken - timedelta(seconds=50), closed=taken, reason=Reason.ASSIGNED)
    played = ran(0, warm_server_name="s-1", requested=taken, running=taken, closed=taken + timedelta(seconds=20))
    assert spent([waited, played], NOW).hours == pytest.approx(70 / 3600)


def test_a_warm_server_without_a_participant_costs_its_whole_time() -> None:
    found = spent([ran(720, user_id=WARM_SERVER, reason=Reason.DEADLINE)], NOW)
    assert (found.hours, found.attempts) == (pytest.approx(12), 1)


def test_an_earlier_attempt_on_the_same_warm_server_is_not_counted_twice() -> None:
    start = NOW - timedelta(hours=6)
    first = PastAttempt(
        1, start, start, start + timedelta(minutes=6), 1.0, 2.0, False, Reason.LOST, warm_server_name="s-1"
    )
    found = spent([ran(30, earlier=(first,))], NOW)
    assert (found.hours, found.attempts) == (pytest.approx(0.6), 1)


def test_the_cost_of_four_warm_servers_is_that_calculated_by_hand() -> None:
    (found,) = _warm("maze", 4, 1, 2)
    assert found["onDemandHour"]["likely"] == pytest.approx(0.2175)  # 4 x (0.04048 + 2 x 0.004445 + 0.005)
    assert found["spotHour"]["likely"] == pytest.approx(0.0891)  # 4 x (0.35 x 0.04937 + 0.005)


# The command


WARM_STUDY = """\
project:
  id: maze
  warmServers: 4
  useAWS: true
  awsSetup: {cpu: 1, memory: 2}
  steps: {1: consent, 2: game, 3: thanks}
trial: {game: Maze-v0}
"""


def test_the_estimate_says_what_warm_servers_cost_an_hour_and_a_day(
    installed: Installed, capsys: Any, tmp_path: Path
) -> None:
    (tmp_path / "steps").mkdir()
    for page in ("consent", "thanks"):
        (tmp_path / "steps" / f"{page}.html").touch()
    (tmp_path / "config.yml").write_text(WARM_STUDY)
    cold = installed.run(capsys, "cost", "--json").json
    found = installed.run(capsys, "cost", str(tmp_path), "--json").json
    assert cold["warmServers"] == []
    (waiting,) = found["warmServers"]
    assert (waiting["project"], waiting["servers"]) == ("maze", 4)
    assert (waiting["spotHour"]["likely"], waiting["onDemandHour"]["likely"]) == (0.0891, 0.2175)
    text = installed.run(capsys, "cost", str(tmp_path)).out
    spot, demand = (line.split() for line in text.splitlines() if line.startswith("maze "))
    assert (spot[-2:], demand[-2:]) == (["0.089", "2.14"], ["0.22", "5.22"])


def test_spending_has_a_line_for_waiting_and_the_present_cost_of_live_projects(
    installed: Installed, capsys: Any
) -> None:
    live = study(warm_servers=4)
    closed = msgspec.structs.replace(study(warm_servers=2), id="closed", live=False)
    installed.register(live, closed)
    now = datetime.now(UTC)
    installed.record(WARM_SERVER, ServerState.CLOSED, closed=now, reason=Reason.ASSIGNED, spot=False)
    installed.record(
        "alice",
        ServerState.CLOSED,
        requested=now,
        closed=now + timedelta(minutes=20),
        warm_server_name="s-1",
        spot=False,
    )
    ran = installed.run(capsys, "cost", "maze", "--spent", "--json").json
    maze = ran["projects"]["maze"]
    assert (maze["servers"], maze["waiting"]["servers"]) == (1, 1)
    assert maze["hours"] == pytest.approx(0.5, rel=0.02)
    assert maze["waiting"]["hours"] == pytest.approx(1 / 6, rel=0.02)
    assert [(one["project"], one["servers"]) for one in ran["warmServers"]] == [("maze", 4)]
    assert installed.run(capsys, "cost", "closed", "--spent", "--json").json["warmServers"] == []
    text = installed.run(capsys, "cost", "maze", "--spent").out
    assert "of it, waiting (warm servers)" in text
    assert "4 of 1 vCPU, 2 GB, on Spot" in text


def test_the_estimate_needs_no_account(capsys: Any, monkeypatch: Any) -> None:
    ran = process(
        {**environment("http://127.0.0.1:9"), "AWS_ACCESS_KEY_ID": ""},
        "cost",
        "--participants",
        "250",
        "--minutes",
        "12",
        "--json",
    )
    assert ran.code == Exit.DONE, ran.err
    found = ran.json
    assert found["participants"] == 250
    assert found["total"]["low"] <= found["total"]["likely"] <= found["total"]["high"]
    assert found["perParticipant"]["likely"] == pytest.approx(found["total"]["likely"] / 250, rel=0.05)
    assert found["study"][0]["amount"] == "50.0 h"
    assert found["prices"]["region"] == "us-east-1"


def test_cost_reports_mistakes_in_config_yml(installed: Installed, capsys: Any, tmp_path: Path) -> None:
    (tmp_path / "config.yml").write_text("project:\n  id: maze\n  maxRuntime: soon\n")
    ran = installed.run(capsys, "cost", str(tmp_path))
    assert (ran.code, ran.out) == (Exit.FAILED, "")
    assert "config.yml:3" in ran.err


def test_games_longer_than_max_runtime_are_refused(installed: Installed, capsys: Any) -> None:
    ran = installed.run(capsys, "cost", "--minutes", "30.5")
    assert (ran.code, ran.out) == (Exit.FAILED, "")
    assert "runs 30.5 minutes: its maxRuntime is 30" in ran.err
    assert installed.run(capsys, "cost", "--minutes", "30").code == Exit.DONE


def test_cost_counts_the_servers_of_one_project(installed: Installed, capsys: Any) -> None:
    other = msgspec.structs.replace(study(), id="other")
    installed.register(study(), other)
    for number in range(3):
        installed.record(f"p{number}", ServerState.CLOSED, closed=datetime.now(UTC), reason=Reason.ENDED, spot=False)
    installed.record("x", ServerState.CLOSED, project=other, closed=datetime.now(UTC), reason=Reason.ENDED, spot=False)
    installed.put("_servers/sbbbbbbbbbbbbbbbbbbbb.json", b"?")
    found = installed.run(capsys, "cost", "maze", "--spent", "--json").json
    assert set(found["projects"]) == {"maze"}
    maze = found["projects"]["maze"]
    assert (maze["servers"], found["unreadable"]) == (3, 1)
    assert maze["usd"]["likely"] == pytest.approx(0.5 * (HOUR + 0.005), rel=0.02)
    text = installed.run(capsys, "cost", "maze", "--spent").out
    assert "1 record cannot be read" in text.replace("\n", " ")
    assert "No project named labyrinth" in installed.run(capsys, "cost", "labyrinth", "--spent").err


def test_cost_takes_the_folder_of_a_project(installed: Installed, capsys: Any, tmp_path: Path) -> None:
    installed.register(study())
    installed.record("alice", ServerState.CLOSED, closed=datetime.now(UTC), reason=Reason.ENDED)
    (tmp_path / "config.yml").write_text("project:\n  id: maze\n")
    ran = installed.run(capsys, "cost", f"{tmp_path}/", "--spent", "--json")
    assert (ran.code, list(ran.json["projects"])) == (Exit.DONE, ["maze"])


def answer_bill(world: Installed, *answers: dict[str, float]) -> None:
    """Let Cost Explorer answer the next requests with these costs by service."""
    for services in answers:
        groups = [
            {"Keys": [name], "Metrics": {"UnblendedCost": {"Amount": str(usd), "Unit": "USD"}}}
            for name, usd in services.items()
        ]
        world.answer("ce:GetCostAndUsage", {"ResultsByTime": [{"Groups": groups}]})


def test_cost_shows_what_aws_has_billed(installed: Installed, capsys: Any) -> None:
    installed.register(study())
    answer_bill(installed, {"AWS Lambda": 0.25, "Amazon Elastic Container Service": 12.5})
    with installed.recording() as calls:
        found = installed.run(capsys, "cost", "--spent", "--all", "--billed", "--json").json["billed"]
    asked = [call.params["Filter"] for call in calls if call.operation == "GetCostAndUsage"]
    assert asked[0]["Tags"] == {"Key": "hippodrome:stack", "Values": ["hippodrome"], "MatchOptions": ["EQUALS"]}
    assert found == {"AWS Lambda": 0.25, "Amazon Elastic Container Service": 12.5}
    answer_bill(installed, {})
    assert "make it a cost allocation tag" in installed.run(capsys, "cost", "--spent", "--all", "--billed").out


def test_without_cost_explorer_only_the_bill_is_missing(installed: Installed, capsys: Any) -> None:
    says = "These credentials may not get cost and usage."
    installed.register(study())
    installed.record("alice", ServerState.CLOSED, closed=datetime.now(UTC), reason=Reason.ENDED)
    installed.fail("ce:GetCostAndUsage", "AccessDeniedException", times=2)
    ran = installed.run(capsys, "cost", "--spent", "--all", "--billed", "--json")
    assert (ran.code, ran.json["projects"]["maze"]["servers"], ran.json["billed"]) == (Exit.DONE, 1, None)
    assert says in ran.json["problems"]["bill"]
    shown = installed.run(capsys, "cost", "--spent", "--all", "--billed")
    assert (shown.code, "✗" in shown.err) == (Exit.DONE, False)
    assert "Servers, from their own records" in shown.out
    assert f"! No bill: {says}" in shown.out


def test_as_a_process(installed: Installed) -> None:
    installed.register(study())
    installed.record("alice", ServerState.CLOSED, closed=datetime.now(UTC), reason=Reason.ENDED)
    with installed.served() as env:
        ran = process(env, "cost", "maze", "--spent", "--json")
        plain = process(env, "cost", "maze", "--spent")
    assert (ran.code, ran.json["projects"]["maze"]["servers"]) == (Exit.DONE, 1)
    assert "Servers, from their own records" in plain.out


def test_participants_in_a_session_share_a_server_and_wait_in_a_lobby() -> None:
    alone, pairs = ({line.what: line for line in study_lines(one)} for one in (MAZE, PAIRS))
    servers = "Servers (Fargate Spot, 1 vCPU, 2 GB)"
    assert pairs[servers].usd.likely == pytest.approx(alone[servers].usd.likely / 2)
    assert pairs["S3 requests"].usd.likely > alone["S3 requests"].usd.likely
    assert pairs["HTTP API"].usd.likely > alone["HTTP API"].usd.likely
    assert any("A server for each 2: 15 minutes likely" in line for line in assumptions(PAIRS))
    assert not any("lobby" in line for line in assumptions(MAZE))
    assert StudyToEstimate(participants=5, steps=5, cpu=1, memory=2, max_runtime=30, players=2).servers == 3


def test_the_longest_wait_in_a_lobby_is_the_patience_of_the_study() -> None:
    hour = replace(PAIRS, patience=3600)
    assert hour.lobby_polls.high == 100 * 1800
    assert hour.lobby_polls.likely == PAIRS.lobby_polls.likely
    assert any("3600 at most" in line for line in assumptions(hour))
    assert replace(PAIRS, patience=10).lobby_polls.likely == 100 * 5  # nobody waits longer than the patience


def test_a_lobby_of_thirty_for_an_hour_costs_less_than_a_dollar() -> None:
    """Each poll lists and writes (at the price of two PUTs), and reads the decisions and the membership."""
    study = replace(PAIRS, participants=30, patience=3600)
    looks = study.lobby_polls.high
    assert looks == 54_000
    each = 2 * prices.S3_WRITE + 2 * prices.S3_READ
    none = replace(study, patience=0)
    (s3,) = (line.usd.high for line in study_lines(study) if line.what == "S3 requests")
    (without,) = (line.usd.high for line in study_lines(none) if line.what == "S3 requests")
    assert s3 - without == pytest.approx(looks * each)
    assert 0.5 < s3 - without < 1


def test_the_estimate_takes_the_patience_of_config_yml(tmp_path: Path) -> None:
    (tmp_path / "steps").mkdir()
    (tmp_path / "steps" / "consent.html").write_text("x")
    (tmp_path / "steps" / "thanks.html").write_text("x")
    text = (
        "project: {id: maze, players: 2, patience: 900, steps: {1: consent, 2: game, 3: thanks}}\n"
        "trial: {game: maze, players: {player_0: human, player_1: human}}\n"
    )
    (tmp_path / "config.yml").write_text(text)
    assert _study(read_project(tmp_path), 1, None, spot=True).patience == 900


def test_the_estimate_says_what_servers_cost_that_start_ahead_for_groups_that_do_not_come() -> None:
    lines = assumptions(replace(PAIRS, at_link=True))
    assert any("Every 2 opened links start" in line and "35 minutes" in line for line in lines)
