"""Roles judge every call: functions have the permissions that they need, and no others.

All tests that run handlers on `MotoWorld` are judged (`testing/iam/enforcement.py`). Here a walk through everything
proves that some function needs each row of `WHO_MAY`, and that a call fails if its permission is taken away. Further
tests try what no walk tries.
"""

from __future__ import annotations

import copy
import functools
import json
import os
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any
from unittest import mock
from urllib.parse import urlencode, urlsplit

import pytest

from hippodrome.control.lobby import matcher
from hippodrome.control.model import ids, server
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.functions import (
    installed,
    send_start_server_message,
    send_stop_server_message,
    sign_requests,
    start_server,
    stop_server,
    sweep,
)
from hippodrome.protocol.keys import groups_key, waiting_key
from testing import aws_events
from testing import template as cfn
from testing.iam.actions import Ask, asks, normalized
from testing.iam.enforcement import CERTIFY, RENEW, SIGN, WHO_MAY, ApiCall, IamEnforcement
from testing.iam.judge import MISSING, Judge, evaluator
from testing.moto_study import GAME, PAIRS, PROJECT, MotoMember, Person, StudyOnMoto, come, meet
from testing.moto_world import MotoWorld
from tests.control.test_moto_journey import run

BUCKET = "arn:aws:s3:::the-bucket"
TEXTS = {"RootDomain": "example.org", "HostedZoneId": "Z1"}
CONDITIONS = ("IfNoneMatch", "IfMatch")
HASHED = "sabcdefghijklmnopqrst-1.servers.example.org"


def test_ministack_is_installed_where_it_is_required() -> None:
    """Without ministack no test judges roles; CI sets REQUIRE_MINISTACK."""
    if evaluator() is None:
        if os.environ.get("REQUIRE_MINISTACK"):
            pytest.fail(MISSING)
        pytest.skip(MISSING)


@pytest.fixture
def judge(judged: None) -> Judge:
    return Judge(cfn.ReferenceValues(parameters=TEXTS, known={"Bucket": "the-bucket"}))


def relay(handler: Callable[..., Any], user: str, body: dict[str, Any]) -> int:
    event = aws_events.load("http_post_json")
    query = urlencode({"projectId": PROJECT, "userId": user})
    event |= {"rawQueryString": query, "body": json.dumps(body), "isBase64Encoded": False}
    return int(handler(event, None)["statusCode"])


def served(world: MotoWorld, user: str, *wishes: tuple[str, str]) -> None:
    """What the participant's server does: asks for presigned requests for these of its documents, and makes them.

    Moto judges no signature: the requests are judged as what they are, calls of who has signed them.
    """
    label = ids.server_label(PROJECT, user)
    record = json.loads(world.client("s3").get_object(Bucket=world.env["BUCKET"], Key=server.key(label))["Body"].read())
    name = record.get("warmServerName") or ids.server_name(label, record["attempt"])
    task = next(world.task(arn) for arn in world.task_arns() if world.task(arn).started_by == name)
    told = {one["name"]: one["value"] for one in task.overrides["containerOverrides"][0]["environment"]}
    places = {"folder": f"{PROJECT}/users/{user}", "label": label, "attempt": record["attempt"], "name": name}
    keys = [(method, key.format(**places)) for method, key in wishes]
    requests = [{"method": method, "key": key, "size": 2} for method, key in keys]
    event = aws_events.load("http_post_json")
    body = json.dumps({"server": told["SERVER"], "credential": told["CREDENTIAL"], "requests": requests})
    event |= {"rawPath": "/sign", "rawQueryString": "", "body": body, "isBase64Encoded": False}
    event["headers"].pop("accept-encoding", None)
    answer = sign_requests.handler(event, None)
    assert answer["statusCode"] == 200, answer
    assert world.iam
    for (method, key), request in zip(keys, json.loads(answer["body"])["requests"], strict=True):
        assert urlsplit(request["url"]).path == f"/{key}"
        condition = {"IfNoneMatch": request["headers"]["If-None-Match"]} if method == "PUT" else {}
        world.iam.signed(
            ApiCall("s3", f"{method.title()}Object", {"Bucket": world.env["BUCKET"], "Key": key, **condition})
        )


def walk(world: MotoWorld, cluster: str) -> None:
    """Make the functions do everything once: three studies, relays, lost servers, leftovers, sweeps."""
    study = StudyOnMoto(world, cluster=cluster)
    page = "<p>{{ answers['2'].age }}, {{ participant.completionCode }}, {{ participant.link }}</p>"
    study.put(f"{PROJECT}/steps/debrief.html", page.encode())
    alice, bob, carol = (Person(study, f"R_{name}") for name in ("alice", "bob", "carol"))
    for person in (alice, bob, carol):
        person.to_the_game()
    assert relay(send_start_server_message.handler, alice.user, alice.hidden) == 202
    study.deliver()
    alice.poll()
    answer, recording = (
        f"{{folder}}/answers/{GAME}.json",
        f"{{folder}}/trials/{{label}}-{{attempt}}/{GAME}-trial.jsonl.gz",
    )
    served(
        world,
        alice.user,
        ("GET", "SSL/servers.example.org/privkey.pem"),
        ("GET", answer),
        ("PUT", recording),
        ("PUT", answer),
    )
    alice.play()
    alice.answer(fun="5")
    assert relay(send_stop_server_message.handler, bob.user, {"token": bob.poll()["token"], "delay": 60}) == 202
    assert relay(send_stop_server_message.handler, bob.user, {"token": bob.poll()["token"], "delay": 90}) == 202
    assert relay(send_stop_server_message.handler, bob.user, {"token": bob.poll()["token"]}) == 202
    study.deliver()
    (task,) = study.living()
    study.lose(task)  # Carol's, which is replaced
    study.deliver()
    served(world, carol.user, ("GET", f"{{folder}}/trials/{{label}}-1/{GAME}-trial.jsonl.gz"))

    dave = Person(study, "R_dave")  # their server is stopped before it runs, and their task starts too late
    dave.to_the_game()
    study.deliver("start")
    late = [arn for arn in study.living() if arn not in study.begun]
    study.begun.update(late)
    dave.play()
    study.deliver("stop")
    for arn in late:
        world.task(arn).desired_status = "RUNNING"
        study.happen(world.task_event(arn, "RUNNING"))
    study.deliver()

    erin = Person(study, "R_erin")  # there is no capacity for this participant
    erin.to_the_game()
    full = {"tasks": [], "failures": [{"reason": "Capacity is unavailable at this time."}]}
    world.answer("ecs:RunTask", full, times=2)
    study.deliver("start")
    study.deliver()
    sweeps(world, study, carol, dave)


def sweeps(world: MotoWorld, study: StudyOnMoto, carol: Person, dave: Person) -> None:
    """Leftovers of each kind, a server past its deadline, one that lost its task."""
    leftover = ids.server_name(ids.server_label(PROJECT, dave.user), 1)
    world.client("ecs").create_cluster(clusterName=leftover, capacityProviders=["FARGATE"])
    record = {
        "Name": f"{leftover}.servers.example.org",
        "Type": "A",
        "TTL": 60,
        "ResourceRecords": [{"Value": "203.0.113.9"}],
    }
    world.client("route53").change_resource_record_sets(
        HostedZoneId=world.ids["zone"], ChangeBatch={"Changes": [{"Action": "UPSERT", "ResourceRecordSet": record}]}
    )
    run(world, leftover)
    world.platform.timers.set(leftover, datetime.now(UTC) + timedelta(hours=1), {"projectId": PROJECT})
    swept = sweep.handler({}, None)
    assert all(swept[kind] for kind in ("tasks", "names", "timers", "clusters")), swept

    for person, change in ((carol, {"deadline": "2026-01-01T00:00:00Z"}), (Person(study, "R_erin"), None)):
        if change:
            kept = {**study.record(person.user), **change}
            study.put(server.key(ids.server_label(PROJECT, person.user)), json.dumps(kept).encode())
    for arn in study.living():
        if world.task(arn).started_by.startswith(ids.server_label(PROJECT, "R_erin")):
            world.task_event(arn, "STOPPED")
            study.ended.add(arn)
            kept = {**study.record("R_erin"), "requested": "2026-01-01T00:00:00Z"}
            study.put(server.key(ids.server_label(PROJECT, "R_erin")), json.dumps(kept).encode())
    frank = Person(study, "R_frank")  # no function has got the event of this task
    frank.to_the_game()
    study.deliver("start")
    study.put(
        server.key(ids.server_label(PROJECT, frank.user)),
        json.dumps({**study.record(frank.user), "requested": minutes_ago(5)}).encode(),
    )
    (unheard,) = [arn for arn in study.living() if arn not in study.begun]
    world.task_event(unheard, "RUNNING")
    study.begun.add(unheard)
    swept = sweep.handler({}, None)
    counted = (swept["overdue"] > 0, swept["lost"] > 0, swept["asked"], swept["failed"])
    assert counted == (True, True, 1, 0), swept
    study.deliver()
    assert frank.poll()["state"] == "ready"
    stop_server.handler(aws_events.queue_event([{"userId": frank.user}]), None)  # no project: all of them
    assert study.record(frank.user)["state"] == "closed"


def minutes_ago(minutes: int) -> str:
    return (datetime.now(UTC) - timedelta(minutes=minutes)).isoformat()


LIMITS = {"maxParticipants": 3, "maxServers": 2, "maxServerHours": 10}


def limited(world: MotoWorld) -> None:
    """A study with limits: a server that is lost and replaced, one that finds no place, a place that was forgotten."""
    study = StudyOnMoto(world, **LIMITS)
    study.put(f"{PROJECT}/users/R_before/participant.json", b"{}")
    StudyOnMoto(world, **LIMITS)  # counts who came before
    alice = Person(study, "R_alice")
    alice.to_the_game()
    study.deliver()
    study.lose(study.living()[0])
    study.deliver()
    kept = world.platform.documents.get(f"_slots/{PROJECT}.json")
    assert kept is not None
    places = json.loads(kept.body)
    places["slots"]["saaaaaaaaaaaaaaaaaaaa"] = {"attempt": 1}
    study.put(f"_slots/{PROJECT}.json", json.dumps(places).encode())
    assert sweep.handler({}, None)["slots"] == 1
    alice.play()
    alice.answer(fun="5")
    study.settle()
    assert study.stored(f"_slots/{PROJECT}.json")["used"] > 0
    assert "slots" not in study.stored(f"_slots/{PROJECT}.json")


def waiting(world: MotoWorld) -> None:
    """A study with a warm server: taken, lost, taken again, expired, swept, and gone when the study closes."""
    study = StudyOnMoto(world, warmServers=1)
    study.deliver()
    alice, bob = Person(study, "R_alice"), Person(study, "R_bob")
    alice.to_the_game()
    study.deliver()
    assert alice.poll()["state"] == "ready"
    served(world, alice.user, ("GET", f"{PROJECT}/handovers/{{name}}.json"), ("PUT", f"{{folder}}/answers/{GAME}.json"))
    first = study.record(alice.user)["warmServerName"]
    study.lose(study.record(alice.user)["task"])
    study.deliver()
    assert alice.poll()["state"] == "ready"
    assert study.record(alice.user)["warmServerName"] != first
    alice.play()
    alice.answer(fun="5")
    study.deliver()
    (name,) = world.timers()
    world.fire_timer(name)
    study.deliver()
    assert name not in world.timers()

    bob.to_the_game()
    study.deliver("start")
    study.put(f"{PROJECT}/handovers/{first}.json", b"{}")  # of a server that has ended
    assert sweep.handler({}, None)["handovers"] == 1
    study.deliver()
    bob.play()
    bob.answer(fun="5")
    study.deliver()
    StudyOnMoto(world, warmServers=1, live=False)
    study.settle()
    assert study.stored(f"_warm/{PROJECT}.json").get("warmServers", {}) == {}


def together(world: MotoWorld) -> None:
    """A study of pairs: matched, lost, replaced, recorded, left one by one; one who waits alone, and who leaves."""
    study = StudyOnMoto(world, **PAIRS)
    alice, bob = MotoMember(study, "R_alice"), MotoMember(study, "R_bob")
    come(study, alice, bob)
    meet(alice, bob)
    session = alice.membership["session"]
    folder = f"{PROJECT}/sessions/{session}"
    recording = f"{folder}/trials/{{label}}-1/{GAME}-trial.jsonl.gz"
    answer = f"{PROJECT}/users/{alice.user}/answers/{GAME}.json"
    served(world, session, ("GET", f"{folder}/session.json"), ("PUT", recording), ("PUT", answer))
    study.lose(study.living()[0])
    study.deliver()
    served(world, session, ("GET", recording))
    token = alice.poll()["token"]
    assert relay(send_stop_server_message.handler, alice.user, {"token": token}) == 202
    assert relay(send_start_server_message.handler, bob.user, bob.hidden) == 202
    study.deliver()
    assert len(study.living()) == 1
    alice.play()
    study.deliver()
    assert len(study.living()) == 1
    bob.play()
    study.settle()

    carol, dave = MotoMember(study, "R_carol"), MotoMember(study, "R_dave")
    come(study, carol)
    assert carol.poll()["state"] == "lobby"
    carol.leave()
    come(study, dave)
    dave.poll()
    swept = sweep.handler({}, None)
    assert swept["failed"] == 0, swept
    stop_server.handler(aws_events.queue_event([{"userId": person.user} for person in (carol, dave)]), None)
    swept = sweep.handler({}, None)
    assert swept["failed"] == 0, swept
    study.settle()


def matched_by_a_function(world: MotoWorld) -> None:
    """A study whose function `match` says who plays with whom, on a server that was started ahead."""
    study = StudyOnMoto(world, **PAIRS, matching="match")
    alice, bob = MotoMember(study, "R_alice"), MotoMember(study, "R_bob")
    come(study, alice, bob)
    assert [alice.poll()["state"], bob.poll()["state"]] == ["lobby", "lobby"]
    question = study.stored(waiting_key(PROJECT))
    (ahead, *_) = study.stored(f"_lobbies/{PROJECT}.json")["open"]
    answer = groups_key(PROJECT, question["id"])
    served(world, ahead["id"], ("GET", waiting_key(PROJECT)), ("PUT", answer))
    study.put(answer, json.dumps({"groups": [[one["id"] for one in question["waiting"]]]}).encode())
    meet(alice, bob)
    assert alice.membership["session"] == bob.membership["session"] == ahead["id"]
    with mock.patch.object(matcher, "FORGOTTEN", timedelta(minutes=-1)):
        assert sweep.handler({}, None)["failed"] == 0
    assert study.stored(waiting_key(PROJECT)) is None
    assert study.stored(answer) is None
    alice.play()
    bob.play()
    study.settle()


DESIGN = {
    "conditions": [{"name": "ghosts", "levels": {"slow": "slow", "fast": "fast"}}],
    "ends": [{"name": "declined", "when": ['answers["1"].adult == "no"']}],
}


def designed(world: MotoWorld) -> None:
    """A study with conditions and an end: assigned, played, lost, without capacity, declined."""
    study = StudyOnMoto(world, **DESIGN)
    alice, bob, carol = (Person(study, f"R_{name}") for name in ("alice", "bob", "carol"))
    alice.to_the_game()
    assert relay(send_start_server_message.handler, alice.user, alice.hidden) == 202
    study.deliver()
    served(world, alice.user, ("GET", "{folder}/assignment.json"))
    study.lose(study.living()[0])
    study.deliver()
    bob.to_the_game()
    full = {"tasks": [], "failures": [{"reason": "Capacity is unavailable at this time."}]}
    world.answer("ecs:RunTask", full, times=2)
    study.deliver("start")
    study.deliver()
    carol.look()
    carol.answer(adult="no")
    assert study.stored(f"{PROJECT}/users/R_carol/end.json")["end"] == "declined"
    carol.look()
    for person in (alice, bob):
        person.play()
        person.answer(fun="5")
    study.settle()


WALKS: dict[str, Callable[[MotoWorld], None]] = {
    "a study of pairs": together,
    "a study with a function that matches": matched_by_a_function,
    "a study with warm servers": waiting,
    "a study with limits": limited,
    "a study with a design": designed,
    "everything, in the installation's cluster": lambda world: walk(world, "installation"),
    "everything, in a cluster for each participant": lambda world: walk(world, "participant"),
}


@functools.cache
def walked(name: str) -> IamEnforcement:
    """The enforcement that has judged this walk; each worker makes it once."""
    with MotoWorld() as world:
        try:
            WALKS[name](world)
        finally:
            installed.use(None)
        assert world.iam
        return world.iam


@pytest.mark.parametrize("name", WALKS)
def test_the_functions_have_the_permissions_for_their_calls_and_no_more(judged: None, name: str) -> None:
    assert walked(name).findings() == []


def test_every_row_of_who_may_is_needed(judged: None) -> None:
    assert set(WHO_MAY) == frozenset[str]().union(*(walked(name).kinds for name in WALKS))


def test_a_missing_permission_is_noticed(world: MotoWorld) -> None:
    less = copy.deepcopy(cfn.template())
    (document,) = cfn.role_documents("StartServerRole", less)
    document["Statement"] = [s for s in document["Statement"] if s["Action"] != "ecs:RunTask"]
    world.enforce(IamEnforcement(world, less))
    study = StudyOnMoto(world)
    Person(study, "R_alice").to_the_game()
    event = world.receive("start")
    assert start_server.handler(event, None)["batchItemFailures"] == []
    assert world.task_arns() == []
    assert world.iam
    (finding,) = world.iam.findings()
    assert finding.startswith(
        "start_server may not ecs:RunTask on arn:aws:ecs:us-east-1:123456789012:task-definition/hippodrome:1"
    )
    world.iam = None  # this finding was wanted


def test_a_missing_permission_to_pass_a_role_is_noticed(world: MotoWorld) -> None:
    world.ids["task_execution_role"] = "arn:aws:iam::123456789012:role/somebody-elses"
    world.enforce(IamEnforcement(world))
    Person(StudyOnMoto(world), "R_alice").to_the_game()
    start_server.handler(world.receive("start"), None)
    assert world.task_arns() == []
    assert world.iam
    assert "start_server may not iam:PassRole" in world.iam.findings()[0]
    world.iam = None


def test_a_needless_permission_is_noticed(world: MotoWorld) -> None:
    more = copy.deepcopy(cfn.template())
    (document,) = cfn.role_documents("SendStartServerMessageRole", more)
    document["Statement"].append({"Effect": "Allow", "Action": "sns:Publish", "Resource": {"Ref": "StopServerTopic"}})
    world.enforce(IamEnforcement(world, more))
    study = StudyOnMoto(world)
    alice = Person(study, "R_alice")
    alice.to_the_game()
    alice.play()
    assert world.iam
    assert world.iam.findings() == ["send_start_server_message may sns:Publish stop as well, which is not needed"]
    world.iam = None


def test_a_variable_that_is_missing_in_the_template_is_noticed(world: MotoWorld) -> None:
    less = copy.deepcopy(cfn.template())
    del less["Resources"]["StartServer"]["Properties"]["Environment"]["Variables"]["SECURITY_GROUP"]
    world.enforce(IamEnforcement(world, less))
    Person(StudyOnMoto(world), "R_alice").to_the_game()
    assert start_server.handler(world.receive("start"), None)["batchItemFailures"]
    assert world.task_arns() == []


# Calls that the walk does not make


class Facts:
    """The ids of an installation, for invented calls."""

    region, account = "us-east-1", "123456789012"

    def exists(self, bucket: str, key: str) -> bool:
        return False

    def definition(self, name: str) -> tuple[str, list[str]]:
        return f"arn:aws:ecs:us-east-1:123456789012:task-definition/{name}", []

    def short_name(self, arn: str) -> str:
        return arn


def names(action: str, kind: str, *labels: str) -> Ask:
    changes = [{"Action": action, "ResourceRecordSet": {"Name": name, "Type": kind}} for name in labels]
    (ask,) = asks(
        "route53", "ChangeResourceRecordSets", {"HostedZoneId": "Z1", "ChangeBatch": {"Changes": changes}}, Facts()
    )
    return ask


ZONE = "arn:aws:route53:::hostedzone/Z1"


def test_names_of_servers_and_no_others_are_changed(judge: Judge) -> None:
    assert judge.who_may(names("UPSERT", "A", HASHED)) == {"task_changed"}
    assert judge.who_may(names("DELETE", "A", HASHED)) == {"task_changed", "stop_server", "sweep"}
    for other in (
        names("UPSERT", "A", "alice.servers.example.org"),
        names("UPSERT", "A", "sabcdefghijklmnopqrst-1.example.org"),
        names("UPSERT", "A", "servers.example.org"),
        names("UPSERT", "A", "www.example.org"),
        names("UPSERT", "A", "study.example.org"),
        names("UPSERT", "A", "*.example.org"),
        names("UPSERT", "A", HASHED, "www.example.org"),
        names("UPSERT", "AAAA", HASHED),
        names("DELETE", "A", "example.org"),
        names("DELETE", "NS", "example.org"),
        names("CREATE", "A", HASHED),
    ):
        assert judge.who_may(other) == frozenset(), other


def test_names_after_ids_are_changed_on_the_servers_own_level_alone(judged: None) -> None:
    judge = Judge(cfn.ReferenceValues(parameters={**TEXTS, "ServerNames": "userId"}, known={"Bucket": "the-bucket"}))
    alice = "alice.servers.example.org"
    assert judge.who_may(names("UPSERT", "A", alice)) == {"task_changed"}
    assert judge.who_may(names("UPSERT", "A", alice, HASHED)) == {"task_changed"}
    for other in ("study.example.org", "Study.example.org.", "www.example.org", "alice.example.org", "example.org"):
        for action in ("UPSERT", "DELETE"):
            assert judge.who_may(names(action, "A", other)) == frozenset(), other
            assert judge.who_may(names(action, "A", alice, other)) == frozenset(), other
    for other in ("servers.example.org", "alice.servers.example.net"):
        assert judge.who_may(names("UPSERT", "A", other)) == frozenset(), other


def test_the_certificates_challenge_is_one_functions_and_all_that_it_may(judge: Judge) -> None:
    challenge = "_acme-challenge.servers.example.org"
    for action in ("UPSERT", "DELETE"):
        assert judge.who_may(names(action, "TXT", challenge)) == {RENEW}
        assert judge.who_may(names(action, "A", challenge)) == frozenset()
        for other in ("example.org", "_acme-challenge.example.org", "servers.example.org"):
            assert judge.who_may(names(action, "TXT", other)) == frozenset()
        assert judge.who_may(names(action, "TXT", challenge, "example.org")) == frozenset()
    own = [f"servers.example.org/{name}" for name in ("fullchain.pem", "privkey.pem", "certificate.json")]
    for file in (*own, "fullchain.pem", "privkey.pem", "account.json", "certificate.json"):
        for action in ("s3:GetObject", "s3:PutObject"):
            reads = {own[0]: {SIGN}, own[1]: {SIGN}, "account.json": {CERTIFY}} if action == "s3:GetObject" else {}
            assert judge.who_may(Ask(action, f"{BUCKET}/SSL/{file}")) == {RENEW, *reads.get(file, ())}
    assert judge.who_may(Ask("route53:GetChange", "arn:aws:route53:::change/C1")) == {RENEW, "task_changed"}


def test_answers_cannot_be_overwritten(judge: Judge) -> None:
    theirs = {
        f"{PROJECT}/users/R_alice/answers/1.json": {"next_step", SIGN},
        f"{PROJECT}/users/R_alice/trials/a-1/3-trial.jsonl.gz": {SIGN},
        f"{PROJECT}/users/R_alice/participant.json": {"next_step"},
    }
    for key, who in theirs.items():
        new, again = {"s3:if-none-match": "*"}, {"s3:if-match": '"e"'}
        assert judge.who_may(Ask("s3:PutObject", f"{BUCKET}/{key}", new)) == who
        for context in ({}, again):
            assert judge.who_may(Ask("s3:PutObject", f"{BUCKET}/{key}", context)) == frozenset()
        for action in ("s3:DeleteObject", "s3:DeleteObjectVersion", "s3:GetObjectVersion"):
            assert judge.who_may(Ask(action, f"{BUCKET}/{key}")) == frozenset()


def test_a_write_with_if_match_reads_as_well() -> None:
    params = {"Bucket": "the-bucket", "Key": f"_lobbies/{PROJECT}.json"}
    wanted = {condition: asks("s3", "PutObject", params | {condition: "x"}, Facts()) for condition in CONDITIONS}
    actions = {condition: [ask.action for ask in asked] for condition, asked in wanted.items()}
    assert actions == {"IfNoneMatch": ["s3:PutObject"], "IfMatch": ["s3:PutObject", "s3:GetObject"]}


def test_only_the_control_plane_writes_memberships_and_only_once(judge: Judge) -> None:
    """And no server of a session may change it, nor what is decided in the lobby."""
    theirs = {
        f"{PROJECT}/users/R_alice/session.json": {"next_step", "sweep"},
        f"{PROJECT}/sessions/s.00000000000000000001/session.json": {"next_step", "sweep"},
        f"{PROJECT}/sessions/s.00000000000000000001/trials/a-1/3-trial.jsonl.gz": {SIGN},
    }
    for key, who in theirs.items():
        assert judge.who_may(Ask("s3:PutObject", f"{BUCKET}/{key}", {"s3:if-none-match": "*"})) == who
        for context in ({}, {"s3:if-match": '"e"'}):
            assert judge.who_may(Ask("s3:PutObject", f"{BUCKET}/{key}", context)) == frozenset()
        assert judge.who_may(Ask("s3:DeleteObject", f"{BUCKET}/{key}")) == frozenset()
    lobby = f"{BUCKET}/_lobbies/{PROJECT}.json"
    for context in ({"s3:if-none-match": "*"}, {"s3:if-match": '"e"'}):
        assert judge.who_may(Ask("s3:PutObject", lobby, context)) == {"next_step", "start_server", "sweep"}
    for action in ("s3:PutObject", "s3:DeleteObject"):
        assert judge.who_may(Ask(action, lobby)) == frozenset()


def test_the_control_plane_writes_the_question_of_match_and_a_server_one_answer(judge: Judge) -> None:
    new, again = {"s3:if-none-match": "*"}, {"s3:if-match": '"e"'}
    question, answer = (f"{BUCKET}/{key}" for key in (waiting_key(PROJECT), groups_key(PROJECT, "0" * 20)))
    for context in (new, again):
        assert judge.who_may(Ask("s3:PutObject", question, context)) == {"next_step"}
    assert judge.who_may(Ask("s3:PutObject", answer, new)) == {SIGN}
    for context in ({}, again):
        assert judge.who_may(Ask("s3:PutObject", answer, context)) == frozenset()
    assert judge.who_may(Ask("s3:PutObject", question)) == frozenset()
    for key in (question, answer):
        assert judge.who_may(Ask("s3:DeleteObject", key)) == {"sweep"}


@pytest.mark.parametrize("key", ["participant.json", "answers/3.json", "trials/a-1/3-trial.jsonl.gz", "session.json"])
def test_a_participant_with_the_id_lobby_is_a_participant(judge: Judge, key: str) -> None:
    theirs = f"{BUCKET}/{PROJECT}/users/lobby/{key}"
    assert judge.who_may(Ask("s3:DeleteObject", theirs)) == frozenset()
    alices = judge.who_may(Ask("s3:PutObject", f"{BUCKET}/{PROJECT}/users/R_alice/{key}", {"s3:if-none-match": "*"}))
    assert judge.who_may(Ask("s3:PutObject", theirs, {"s3:if-none-match": "*"})) == alices


def test_slots_are_written_only_with_if_match_or_if_none_match(judge: Judge) -> None:
    theirs = {
        f"{PROJECT}/slots/3.json": {"next_step", "update_project_master_list"},
        f"_slots/{PROJECT}.json": {"start_server", "task_changed", "stop_server", "sweep"},
        f"_warm/{PROJECT}.json": {"start_server", "task_changed", "stop_server", "sweep"},
    }
    for key, who in theirs.items():
        for context in ({"s3:if-none-match": "*"}, {"s3:if-match": '"e"'}):
            assert judge.who_may(Ask("s3:PutObject", f"{BUCKET}/{key}", context)) == who
        for action in ("s3:PutObject", "s3:DeleteObject"):
            assert judge.who_may(Ask(action, f"{BUCKET}/{key}")) == frozenset()


REPOSITORY = "arn:aws:ecr:us-east-1:123456789012:repository/hippodrome-Repository"
LOGS = "arn:aws:logs:us-east-1:123456789012:log-group:/hippodrome/hippodrome"
PULLING = ("BatchCheckLayerAvailability", "GetDownloadUrlForLayer", "BatchGetImage")
FARGATES = [
    *((f"ecr:{action}", REPOSITORY, {}) for action in PULLING),
    *((f"logs:{action}", f"{LOGS}/trial:log-stream:p/trial/1", {}) for action in ("CreateLogStream", "PutLogEvents")),
]
"""What Fargate does with the execution role (AmazonECSTaskExecutionRolePolicy, AWS's own policy for it)."""
PUSHING = ("InitiateLayerUpload", "UploadLayerPart", "CompleteLayerUpload", "PutImage")
"""What a push does (ECR User Guide, "IAM permissions for pushing an image")."""


@pytest.mark.parametrize(
    ("who", "allowed", "refused"),
    [
        (
            "certify_server",
            [
                ("s3:GetObject", f"{BUCKET}/_secret.json", {}),
                ("s3:GetObject", f"{BUCKET}/_servers/s.json", {}),
                *(
                    (action, f"{BUCKET}/SSL/{name}.json", condition)
                    for name in ("account", "addresses")
                    for action, condition in (
                        ("s3:GetObject", {}),
                        ("s3:PutObject", {"s3:if-none-match": "*"}),
                        ("s3:PutObject", {"s3:if-match": '"e"'}),
                    )
                ),
            ],
            [
                ("s3:PutObject", f"{BUCKET}/SSL/account.json", {}),
                ("s3:GetObject", f"{BUCKET}/SSL/servers.example.org/privkey.pem", {}),
                ("s3:PutObject", f"{BUCKET}/_servers/s.json", {"s3:if-match": '"e"'}),
                ("s3:GetObject", f"{BUCKET}/project_master_list.json", {}),
                ("s3:GetObject", f"{BUCKET}/p/users/u/participant.json", {}),
            ],
        ),
        (
            "sign_requests",
            [
                ("s3:GetObject", f"{BUCKET}/SSL/servers.example.org/privkey.pem", {}),
                ("s3:GetObject", f"{BUCKET}/SSL/servers.example.org/fullchain.pem", {}),
                ("s3:GetObject", f"{BUCKET}/p/users/u/trials/a.jsonl.gz", {}),
                ("s3:GetObject", f"{BUCKET}/p/handovers/sabcdefghijklmnopqrst-1.json", {}),
                *(
                    ("s3:PutObject", f"{BUCKET}/{project}/users/{user}/{name}", {"s3:if-none-match": "*"})
                    for project in ("p", "slots", "handovers", "steps", "SSL-study")
                    for user in ("u", "users", "slots", "handovers", "steps", "lobby", "_slots")
                    for name in ("answers/3.json", "trials/a-0001.jsonl.gz")
                ),
            ],
            [
                ("s3:GetObject", f"{BUCKET}/SSL/account.json", {}),
                ("s3:PutObject", f"{BUCKET}/_servers/s.json", {"s3:if-none-match": "*"}),
                ("s3:PutObject", f"{BUCKET}/_secret.json", {"s3:if-none-match": "*"}),
                ("s3:PutObject", f"{BUCKET}/SSL/privkey.pem", {"s3:if-none-match": "*"}),
                ("s3:PutObject", f"{BUCKET}/p/handovers/sabcdefghijklmnopqrst-1.json", {"s3:if-none-match": "*"}),
                ("s3:GetObject", f"{BUCKET}/project_master_list.json", {}),
                ("s3:GetObject", f"{BUCKET}/p/users/u/participant.json", {}),
                ("s3:DeleteObject", f"{BUCKET}/p/users/u/answers/3.json", {}),
                ("s3:PutObject", f"{BUCKET}/p/users/u/trials/a.jsonl.gz", {"s3:if-match": '"e"'}),
                ("s3:PutObject", f"{BUCKET}/p/users/u/answers/3.json", {}),
                ("s3:PutObject", f"{BUCKET}/p/users/u/participant.json", {"s3:if-none-match": "*"}),
                ("s3:PutObject", f"{BUCKET}/p/steps/a.html", {"s3:if-none-match": "*"}),
                *(
                    ("s3:PutObject", f"{BUCKET}/{folder}/users/x/{name}", {"s3:if-none-match": "*"})
                    for folder in (
                        "_slots", "_servers", "_warm", "_", "_slots/p/q", "SSL", "SSL/a",
                        "p/slots", "p/slots/a", "p/handovers", "p/handovers/sabcdefghijklmnopqrst-1.json", "p/steps", "p/steps/a/b",
                    )
                    for name in ("answers/y.json", "trials/y.json")
                ),
                *(("s3:GetObject", f"{BUCKET}/{folder}/users/x/answers/y.json", {}) for folder in ("_slots", "_warm", "_lobby", "_lobbies")),
                ("s3:PutObject", f"{BUCKET}/p/sessions/s.1/session.json", {"s3:if-none-match": "*"}),
                ("s3:PutObject", f"{BUCKET}/_match/p/waiting.json", {"s3:if-none-match": "*"}),
                *(("s3:PutObject", f"{BUCKET}/{folder}/lobby/groups/y.json", {"s3:if-none-match": "*"}) for folder in ("_lobby", "_servers", "SSL", "p/steps", "p/slots", "p/handovers")),
                *(("s3:PutObject", f"{BUCKET}/{folder}/sessions/s.1/trials/y.json", {"s3:if-none-match": "*"}) for folder in ("_lobby", "_servers", "SSL", "p/steps", "p/slots", "p/handovers")),
                ("ecs:StopTask", "arn:aws:ecs:us-east-1:123456789012:task/hippodrome/1", {}),
            ],
        ),
        (
            "next_step",
            [("s3:GetObject", f"{BUCKET}/p/{page}", {}) for page in ("consent.html", "steps/consent.html", "steps/a.png")],
            [
                *(("s3:GetObject", f"{BUCKET}/{key}", {}) for key in (
                    "_servers.html", "p/users/u.html", "p/users/u/a.html", "p/users/u/answers.html", "p/a.json", "a.html",
                    "p/users/u/trials/a.html", "SSL/privkey.pem",
                )),
                ("s3:PutObject", f"{BUCKET}/p/consent.html", {"s3:if-none-match": "*"}),
                ("s3:DeleteObject", f"{BUCKET}/p/consent.html", {}),
            ],
        ),
        (
            "ScheduleRole",
            [("sns:Publish", "arn:aws:sns:us-east-1:123456789012:hippodrome-stop-server", {})],
            [("sns:Publish", "arn:aws:sns:us-east-1:123456789012:hippodrome-start-server", {})],
        ),
        (
            "TaskExecutionRole",
            [("ecr:GetAuthorizationToken", "*", {}), *FARGATES],
            [("s3:GetObject", f"{BUCKET}/SSL/privkey.pem", {}), ("ecr:PutImage", "arn:aws:ecr:us-east-1:123456789012:repository/hippodrome-Repository", {})],
        ),
        (
            "ResearcherPolicy",
            [
                ("lambda:InvokeFunction", "arn:aws:lambda:us-east-1:123456789012:function:hippodrome-update_project_master_list", {}),
                ("s3:GetObject", f"{BUCKET}/p/users/u/trials/a.jsonl.gz", {}),
                ("s3:PutObject", f"{BUCKET}/p/steps/a.html", {}),
                ("s3:PutObject", f"{BUCKET}/p/a.html", {}),
                ("ecs:RegisterTaskDefinition", "arn:aws:ecs:us-east-1:123456789012:task-definition/hippodrome-p", {}),
                ("ecr:GetAuthorizationToken", "*", {}),
                *((f"ecr:{action}", REPOSITORY, {}) for action in (*PULLING, *PUSHING)),
            ],
            [
                ("lambda:InvokeFunction", "arn:aws:lambda:us-east-1:123456789012:function:hippodrome-sweep", {}),
                ("ecr:PutImage", "arn:aws:ecr:us-east-1:123456789012:repository/another", {}),
                ("s3:GetObject", f"{BUCKET}/SSL/privkey.pem", {}),
                ("s3:PutObject", f"{BUCKET}/SSL/privkey.pem", {}),
                ("s3:PutObject", f"{BUCKET}/project_master_list.json", {}),
                ("s3:PutObject", f"{BUCKET}/p/users/u/answers/1.json", {}),
                ("s3:PutObject", f"{BUCKET}/p/users/u/a.html", {}),
                ("s3:PutObject", f"{BUCKET}/_servers/a.html", {}),
                ("s3:DeleteObject", f"{BUCKET}/p/a.html", {}),
                ("s3:DeleteObject", f"{BUCKET}/p/users/u/answers/1.json", {}),
                ("sqs:ReceiveMessage", "arn:aws:sqs:us-east-1:123456789012:hippodrome-tasks-dead-letters", {}),
                ("sns:Publish", "arn:aws:sns:us-east-1:123456789012:hippodrome-stop-server", {}),
                ("ecs:RunTask", "arn:aws:ecs:us-east-1:123456789012:task-definition/hippodrome-p:1", {}),
                ("iam:PassRole", "arn:aws:iam::123456789012:role/hippodrome-StartServerRole", {"iam:PassedToService": "ecs-tasks.amazonaws.com"}),
                ("ecs:RegisterTaskDefinition", "arn:aws:ecs:us-east-1:123456789012:task-definition/another-p", {}),
            ],
        ),
    ],
)  # fmt: skip
def test_other_roles(judge: Judge, who: str, allowed: list[Any], refused: list[Any]) -> None:
    assert [one for one in allowed if not judge.may(who, Ask(*one))] == []
    assert [one for one in refused if judge.may(who, Ask(*one))] == []


def test_each_function_reads_its_own_queue_and_writes_its_own_log(judge: Judge) -> None:
    mappings = {
        next(n for n, logical in judge.functions.items() if logical == m["FunctionName"]["Ref"]): m["EventSourceArn"]["Fn::GetAtt"][0]
        for m in cfn.resources("AWS::Lambda::EventSourceMapping").values()
    }  # fmt: skip
    account = cfn.ReferenceValues()
    for queue in cfn.resources("AWS::SQS::Queue"):
        reader = {name for name, its in mappings.items() if its == queue}
        for action in ("sqs:ReceiveMessage", "sqs:DeleteMessage", "sqs:GetQueueAttributes"):
            assert judge.who_may(Ask(action, account.attribute(queue, "Arn"))) == reader, queue
    for name in judge.functions:
        for action in ("logs:CreateLogStream", "logs:PutLogEvents"):
            log = f"arn:aws:logs:us-east-1:123456789012:log-group:/hippodrome/hippodrome/{name}:log-stream:x"
            assert judge.who_may(Ask(action, log)) == {name}


@pytest.mark.parametrize(
    "other",
    [
        Ask("ecs:RunTask", "arn:aws:ecs:us-east-1:123456789012:task-definition/hippodrome-p:1", {"ecs:cluster": "arn:aws:ecs:us-east-1:123456789012:cluster/production"}),
        Ask("ecs:RunTask", "arn:aws:ecs:us-east-1:123456789012:task-definition/production:1", {"ecs:cluster": "arn:aws:ecs:us-east-1:123456789012:cluster/hippodrome"}),
        Ask("ecs:StopTask", "arn:aws:ecs:us-east-1:123456789012:task/production/1", {"ecs:cluster": "arn:aws:ecs:us-east-1:123456789012:cluster/production"}),
        Ask("ecs:ListTasks", "*", {"ecs:cluster": "arn:aws:ecs:us-east-1:123456789012:cluster/production"}),
        Ask("ecs:DeleteCluster", "arn:aws:ecs:us-east-1:123456789012:cluster/hippodrome"),
        Ask("ecs:DeleteCluster", "arn:aws:ecs:us-east-1:123456789012:cluster/production"),
        Ask("scheduler:DeleteSchedule", "arn:aws:scheduler:us-east-1:123456789012:schedule/default/backup"),
        Ask("iam:PassRole", "arn:aws:iam::123456789012:role/admin", {"iam:PassedToService": "ecs-tasks.amazonaws.com"}),
        Ask("iam:PassRole", "arn:aws:iam::123456789012:role/hippodrome-TaskExecutionRole", {"iam:PassedToService": "ec2.amazonaws.com"}),
        Ask("sns:Publish", "arn:aws:sns:us-east-1:123456789012:hippodrome-alarms"),
        Ask("s3:GetObject", "arn:aws:s3:::another-bucket/project_master_list.json"),
        Ask("s3:DeleteObject", f"{BUCKET}/_servers/s.json"),
        Ask("route53:DeleteHostedZone", ZONE),
    ],
    ids=lambda ask: f"{ask.action} {ask.resource.rpartition(':')[2]}",
)  # fmt: skip
def test_no_role_may_make_these_calls(judge: Judge, other: Ask) -> None:
    assert judge.who_may(other) == frozenset()


def test_names_are_normalized_as_route_53_does() -> None:
    assert normalized("Alice.Example.ORG.") == "alice.example.org"
    assert normalized("*.example.org") == "\\052.example.org"


def test_an_unknown_call_is_refused(world: MotoWorld, monkeypatch: pytest.MonkeyPatch) -> None:
    study = StudyOnMoto(world)
    assert world.iam
    assert world.iam.judge(ApiCall("s3", "DeleteBucket", {})) is None, "not by a function"
    monkeypatch.setattr(ProjectCache, "project", lambda *_: study.world.platform._client("s3").list_buckets())
    assert Person(study, "R_alice").send("http_get")["statusCode"] == 500
    assert world.iam.findings() == ["next_step calls s3:ListBuckets, which actions.py does not describe"]
    world.iam = None
