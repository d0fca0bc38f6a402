"""Pairs on moto's AWS: from their links to their answers, until nothing is left."""

from __future__ import annotations

import json
from collections.abc import Iterator
from urllib.parse import urlsplit

import pytest

from hippodrome.control.model import ids
from hippodrome.functions import sign_requests, stop_server, sweep
from hippodrome.protocol.session import member_token, parse
from testing import aws_events
from testing.moto_study import (
    AFTER,
    GAME,
    PAIRS,
    PROJECT,
    MotoMember,
    StudyOnMoto,
    come,
    meet,
    play_together,
)
from testing.moto_world import MotoWorld


@pytest.fixture
def study() -> Iterator[StudyOnMoto]:
    with MotoWorld() as world:
        yield StudyOnMoto(world, **PAIRS)


@pytest.fixture
def pair(study: StudyOnMoto) -> tuple[MotoMember, MotoMember]:
    return MotoMember(study, "R_alice"), MotoMember(study, "R_bob")


def environment(study: StudyOnMoto, task: str) -> dict[str, str]:
    told = study.world.task(task).overrides["containerOverrides"][0]["environment"]
    return {one["name"]: one["value"] for one in told}


def session_of(study: StudyOnMoto, member: MotoMember) -> str:
    return str(member.membership["session"])


def test_a_pair_plays_from_two_links_to_the_end_and_nothing_is_left(
    study: StudyOnMoto, pair: tuple[MotoMember, MotoMember]
) -> None:
    alice, bob = pair
    come(study, *pair)
    (task,) = study.living()  # one server for both, started ahead
    told = environment(study, task)
    assert told.keys().isdisjoint({"USER_ID", "GROUP"})

    states = meet(alice, bob)
    assert [state["state"] for state in states] == ["ready", "ready"]
    assert [(state["players"], state["members"]) for state in states] == [(2, 2), (2, 2)]
    session = session_of(study, alice)
    assert session == session_of(study, bob) == told["SESSION"]
    assert study.living() == [task]
    assert states[0]["url"] == states[1]["url"]
    assert [state["token"] for state in states] == [member_token(told["TOKEN"], member.user) for member in pair]

    document = parse(json.dumps(study.stored(f"{PROJECT}/sessions/{session}/session.json")).encode())
    assert {member.user_id: member.seat for member in document.members} == {
        member.user: member.membership["seat"] for member in pair
    }
    play_together(study, *pair)
    study.settle()
    for member in pair:
        assert member.at == AFTER
        member.answer(fun="5")
        assert "You have finished the study" in member.page
    study.deliver()
    assert len(study.world.task_arns()) == 1
    assert sweep.handler({}, None)["failed"] == 0
    study.assert_nothing_left()


def test_a_pair_that_is_faster_than_the_start_messages_gets_one_server(
    study: StudyOnMoto, pair: tuple[MotoMember, MotoMember]
) -> None:
    for member in pair:
        member.to_the_game()
    assert [state["state"] for state in meet(*pair)] == ["queued", "queued"]
    study.deliver()
    assert len(study.living()) == 1
    assert [member.poll()["state"] for member in pair] == ["ready", "ready"]
    play_together(study, *pair)
    study.settle()


def test_the_first_member_who_finishes_leaves_the_server_to_the_other(
    study: StudyOnMoto, pair: tuple[MotoMember, MotoMember]
) -> None:
    come(study, *pair)
    meet(*pair)
    alice, bob = pair
    study.put(f"{PROJECT}/users/{alice.user}/answers/{GAME}.json", b'{"step": "3", "answers": {"outcome": "left"}}')
    alice.look()
    assert alice.at == AFTER
    study.deliver()
    assert len(study.living()) == 1
    assert bob.poll()["state"] == "ready"
    play_together(study, bob)
    study.settle()


def test_a_lost_server_is_replaced_for_both_members(study: StudyOnMoto, pair: tuple[MotoMember, MotoMember]) -> None:
    come(study, *pair)
    before = meet(*pair)
    study.lose(study.living()[0])
    study.deliver()
    (task,) = study.living()
    after = [member.poll() for member in pair]
    assert [state["state"] for state in after] == ["ready", "ready"]
    assert [state["attempt"] for state in after] == [2, 2]
    assert {state["url"] for state in after}.isdisjoint({state["url"] for state in before})
    assert environment(study, task)["SESSION"] == session_of(study, pair[0])
    play_together(study, *pair)
    study.settle()


def test_four_people_are_two_pairs_on_two_servers(study: StudyOnMoto) -> None:
    people = [MotoMember(study, f"R_{number}") for number in range(4)]
    come(study, *people)
    assert len(study.living()) == 2
    meet(*people)
    sessions = [session_of(study, member) for member in people]
    assert sorted(sessions.count(one) for one in sessions) == [2, 2, 2, 2]
    play_together(study, *people)
    study.settle()


def test_a_pair_is_handed_a_warm_server() -> None:
    with MotoWorld() as world:
        study = StudyOnMoto(world, **PAIRS, warmServers=1)
        study.deliver()
        pair = MotoMember(study, "R_alice"), MotoMember(study, "R_bob")
        come(study, *pair)
        states = meet(*pair)
        assert [state["state"] for state in states] == ["ready", "ready"]
        session = session_of(study, pair[0])
        name = study.record(session)["warmServerName"]
        assert study.stored(f"{PROJECT}/handovers/{name}.json")["userId"] == session
        play_together(study, *pair)
        study.deliver()
        assert study.stored(f"{PROJECT}/handovers/{name}.json") is None


def test_a_server_ahead_is_stopped_if_its_participant_gives_up(study: StudyOnMoto) -> None:
    alice = MotoMember(study, "R_alice")
    come(study, alice)
    assert len(study.living()) == 1
    assert alice.poll()["state"] == "lobby"
    assert alice.poll()["here"] == 1
    event = aws_events.queue_event([{"projectId": PROJECT, "userId": alice.user}])
    assert stop_server.handler(event, None) == {"batchItemFailures": []}
    sweep.handler({}, None)
    study.settle()


def test_a_sessions_server_gets_requests_for_both_answers(
    study: StudyOnMoto, pair: tuple[MotoMember, MotoMember]
) -> None:
    come(study, *pair)
    meet(*pair)
    (task,) = study.living()
    told, session = environment(study, task), session_of(study, pair[0])
    recording = f"{PROJECT}/sessions/{session}/trials/{ids.server_name(ids.server_label(PROJECT, session), 1)}/{GAME}-trial.jsonl.gz"
    wishes = [{"method": "GET", "key": f"{PROJECT}/sessions/{session}/session.json"}]
    wishes += [{"method": "PUT", "key": f"{PROJECT}/users/{member.user}/answers/{GAME}.json"} for member in pair]
    wishes += [{"method": "PUT", "key": recording}]
    body = {
        "server": told["SERVER"],
        "credential": told["CREDENTIAL"],
        "requests": [{**one, "size": 2} for one in wishes],
    }
    event = aws_events.load("http_post_json")
    event |= {"rawPath": "/sign", "rawQueryString": "", "body": json.dumps(body), "isBase64Encoded": False}
    event["headers"].pop("accept-encoding", None)
    answer = sign_requests.handler(event, None)
    assert answer["statusCode"] == 200, answer
    signed = [urlsplit(one["url"]).path for one in json.loads(answer["body"])["requests"]]
    assert signed == [f"/{one['key']}" for one in wishes]
