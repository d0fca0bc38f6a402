"""A server's record, transition by transition: what each one changes, and that it leaves everything else."""

from __future__ import annotations

from dataclasses import replace
from datetime import UTC, datetime, timedelta

import msgspec
import pytest

from hippodrome.control.model import ids, server
from hippodrome.control.model.project import AwsSetup
from hippodrome.control.model.server import Reason, Server, ServerState, TaskStopped
from hippodrome.control.ports import Address, DnsRecord
from hippodrome.control.servers.causes import Cause
from testing.fake_platform import FakePlatform
from testing.studies import study

NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)
LATER = NOW + timedelta(minutes=1)
SETTINGS = FakePlatform().settings
LABEL = ids.server_label("maze", "alice")
WARM_SERVER = ids.warm_id("maze", NOW, 0)


def new_record(user: str = "alice", attempt: int = 1, **project: object) -> Server:
    return server.new_attempt(study(**project), user, attempt, nonce="n", settings=SETTINGS, now=NOW)


def changes(before: Server, after: Server) -> dict[str, object]:
    """Return the fields in which two records differ, as the second has them."""
    old, new = msgspec.structs.asdict(before), msgspec.structs.asdict(after)
    return {name: new[name] for name in new if new[name] != old[name]}


def test_a_new_record_holds_all_that_is_known_before_anything_starts() -> None:
    record = new_record(aws_setup=AwsSetup(cpu=4, memory=16))
    assert record == Server(
        project_id="maze",
        user_id="alice",
        attempt=1,
        state=ServerState.STARTING,
        requested=NOW,
        deadline=NOW + timedelta(minutes=30),
        cluster=SETTINGS.cluster,
        dns=f"{LABEL}-1.{SETTINGS.servers_domain}",
        port=5000,
        spot=True,
        cpu=4,
        memory=16,
        nonce="n",
        game_steps=("3",),
    )
    assert (record.label, record.name, record.is_warm_server, record.is_closed) == (LABEL, f"{LABEL}-1", False, False)


@pytest.mark.parametrize(
    ("players", "matching", "may_match"), [(3, "match", True), (3, "arrival", False), (1, "match", False)]
)
def test_only_a_sessions_server_has_players_and_may_call_match(players: int, matching: str, may_match: bool) -> None:
    of_session = new_record(ids.new_session_id(), players=players, matching=matching)
    assert (of_session.players, of_session.may_match) == (players, may_match)
    assert (own := new_record(players=players, matching=matching)).players == 0
    assert not own.may_match


@pytest.mark.parametrize(
    ("user", "first"),
    [
        ("alice", "alice"),
        ("R_3fGx", "r_3fgx"),
        ("x" * 63, "x" * 63),
        ("x" * 64, None),
        ("-alice", None),
        ("_dmarc", None),
        ("XN--alice", None),
        ("study", "study"),
        ("S" + "A" * 20 + "-1", None),
    ],
)
def test_only_an_id_that_is_a_host_label_names_a_server(user: str, first: str | None) -> None:
    settings = replace(SETTINGS, user_id_names=True)
    record = server.new_attempt(study(subdomain="userId"), user, 1, nonce="t", settings=settings, now=NOW)
    assert record.dns == f"{first or record.name}.{SETTINGS.servers_domain}"
    assert record.has_default_name is (first is None)


def test_a_server_whose_name_is_refused_gets_its_default_name() -> None:
    record = server.new_attempt(
        study(subdomain="userId"), "alice", 2, nonce="t", settings=replace(SETTINGS, user_id_names=True), now=NOW
    )
    assert changes(record, server.with_default_name(record)) == {"dns": f"{LABEL}-2.{SETTINGS.servers_domain}"}
    assert server.with_default_name(record).has_default_name


@pytest.mark.parametrize(("attempt", "spot"), [(1, True), (2, True), (3, False), (8, False)])
def test_spot_is_for_the_attempts_before_the_last_automatic_one(attempt: int, spot: bool) -> None:
    assert new_record(attempt=attempt).spot is spot


@pytest.mark.parametrize(
    ("limits", "counted"),
    [({}, False), ({"max_servers": 0}, True), ({"max_server_hours": 5}, True), ({"max_participants": 5}, False)],
)
def test_a_server_is_counted_where_servers_are_limited(limits: dict[str, int], counted: bool) -> None:
    assert new_record(**limits).counted is counted


def test_an_attempt_is_open_until_it_is_closed_and_owns_resources_of_its_name() -> None:
    record = new_record(attempt=2)
    assert [record.is_open(attempt) for attempt in (1, 2, 3)] == [False, True, False]
    assert [record.owns(name) for name in (f"{LABEL}-1", f"{LABEL}-2")] == [False, True]
    closed = server.close(record, Reason.STOPPED, LATER)
    assert (closed.is_closed, closed.is_open(2), closed.owns(f"{LABEL}-2")) == (True, False, False)


def test_only_a_participants_own_server_lacks_a_step_that_was_registered_after_it_started() -> None:
    own, of_session = new_record(), new_record(ids.new_session_id(), players=2)
    assert [own.lacks(step) for step in ("3", "4")] == [False, True]
    assert [of_session.lacks(step) for step in ("3", "4")] == [False, False], "others play on it"


def test_a_server_owns_its_dns_record_once_it_has_an_address() -> None:
    assert new_record().dns_record is None
    named = server.naming(new_record(), "task", Address("192.0.2.1", 5000), LATER)
    assert named.dns_record == DnsRecord(f"{LABEL}-1.{SETTINGS.servers_domain}", "192.0.2.1")


def test_a_cluster_of_the_servers_name_is_the_servers_own() -> None:
    own = new_record(cluster="participant")
    assert (own.cluster, own.has_own_cluster) == (f"{LABEL}-1", True)
    assert not new_record().has_own_cluster


def test_the_transitions_from_starting_to_ready_and_closed() -> None:
    first = new_record()
    assert changes(first, server.on_demand(first)) == {"spot": False}
    named = server.naming(first, "task", Address("192.0.2.1", 5001), LATER)
    assert changes(first, named) == {
        "state": ServerState.NAMING,
        "task": "task",
        "host": "192.0.2.1",
        "port": 5001,
        "running": LATER,
    }
    assert changes(named, server.ready(named, LATER)) == {"state": ServerState.READY, "ready": LATER}
    assert changes(named, server.close(named, Reason.LOST, LATER, "spot")) == {
        "state": ServerState.CLOSED,
        "closed": LATER,
        "reason": Reason.LOST,
        "cause": "spot",
    }
    assert server.close(named, Reason.LOST, LATER).cause == ""


def test_a_servers_port_is_that_of_its_task_or_else_the_registered_one() -> None:
    told = new_record(server_port=443)
    assert server.naming(told, "task", Address("192.0.2.1"), LATER).port == 443
    assert server.naming(told, "task", Address("192.0.2.1", 40000), LATER).port == 40000


def test_a_tombstone_is_closed_from_the_beginning() -> None:
    assert server.stopped_before_start("maze", "alice", 2, NOW) == Server(
        project_id="maze",
        user_id="alice",
        attempt=2,
        state=ServerState.CLOSED,
        requested=NOW,
        deadline=NOW,
        cluster="",
        closed=NOW,
        reason=Reason.STOPPED,
    )


def test_the_record_keeps_the_fields_of_earlier_attempts() -> None:
    first = msgspec.structs.replace(
        new_record(aws_setup=AwsSetup(cpu=2, memory=4)),
        running=LATER,
        spot=False,
        warm_server_name="s" + "a" * 20 + "-1",
    )
    closed = server.close(first, Reason.LOST, LATER, "spot")
    second = server.replacing(closed, new_record(attempt=2))
    assert second.earlier == (
        server.PastAttempt(
            attempt=1,
            requested=NOW,
            running=LATER,
            closed=LATER,
            cpu=2,
            memory=4,
            spot=False,
            reason=Reason.LOST,
            cause="spot",
            warm_server_name="s" + "a" * 20 + "-1",
            nonce="n",
            game_steps=("3",),
        ),
    )
    third = server.replacing(server.close(second, Reason.LOST, LATER), new_record(attempt=3))
    assert [run.attempt for run in third.earlier] == [1, 2]


def test_an_attempt_that_found_no_slot_is_repeated_and_is_no_earlier_attempt() -> None:
    second = server.replacing(server.close(new_record(), Reason.LOST, NOW), new_record(attempt=2))
    full = server.close(second, Reason.FULL, LATER)
    assert [server.found_no_slot(full, attempt) for attempt in (1, 2, 3)] == [False, True, False]
    assert not server.found_no_slot(server.close(second, Reason.LOST, LATER), 2)
    assert not server.found_no_slot(msgspec.structs.replace(full, state=ServerState.STARTING), 2)
    assert server.repeating(full, new_record(attempt=2)).earlier == second.earlier


@pytest.mark.parametrize(
    ("attempt", "reason", "automatic", "on_request"),
    [
        (1, Reason.LOST, 2, None),
        (2, Reason.LOST, 3, None),
        (3, Reason.LOST, None, 4),
        (7, Reason.LOST, None, 8),
        (8, Reason.LOST, None, None),
        (1, Reason.ENDED, None, 2),
        (1, Reason.STOPPED, None, 2),
        (2, Reason.FULL, None, 2),
        (8, Reason.FULL, None, 8),
    ],
)
def test_a_lost_server_is_replaced_twice_by_itself_and_then_on_request(
    attempt: int, reason: Reason, automatic: int | None, on_request: int | None
) -> None:
    closed = server.close(new_record(attempt=attempt), reason, LATER)
    assert (server.next_attempt(closed), server.requestable_attempt(closed)) == (automatic, on_request)
    assert server.plays_on(closed) is (automatic is not None)


def test_the_causes_after_which_one_more_server_is_tried_are_causes() -> None:
    assert set(server.CANNOT_START) <= set(Cause)


def test_an_open_server_plays_on_and_has_no_next_attempt() -> None:
    assert server.plays_on(new_record())
    assert server.next_attempt(new_record()) is None
    assert server.requestable_attempt(new_record()) is None


# Warm servers


def warm_server() -> Server:
    named = server.naming(new_record(WARM_SERVER), "arn", Address("192.0.2.9", 5001), NOW)
    return msgspec.structs.replace(server.ready(named, NOW), nonce="spare's", spot=False, cluster="other")


def test_a_server_takes_over_a_warm_servers_resources_and_gives_them_up_again() -> None:
    own, waiting = new_record(), warm_server()
    wanting = server.reserving(own, waiting)
    assert changes(own, wanting) == {
        "warm_server_name": waiting.name,
        "task": "arn",
        "host": "192.0.2.9",
        "port": 5001,
        "dns": waiting.dns,
        "cluster": "other",
        "spot": False,
    }
    assert (wanting.name, wanting.warm_server_label) == (waiting.name, waiting.label)
    assert own.warm_server_label == ""
    given = server.assigned(wanting, waiting, LATER)
    assert changes(wanting, given) == {"state": ServerState.READY, "nonce": "spare's", "running": LATER, "ready": LATER}
    fresh = msgspec.structs.replace(new_record(), nonce="another")
    assert server.without_warm_server(wanting, fresh) == own, "the nonce stays: a task may have been started with it"


def test_a_warm_server_is_assigned_or_drained() -> None:
    waiting = warm_server()
    assert changes(waiting, server.handed_over(waiting, LABEL, LATER)) == {
        "state": ServerState.CLOSED,
        "closed": LATER,
        "reason": Reason.ASSIGNED,
        "assigned_to": LABEL,
    }
    assert changes(waiting, server.draining(waiting)) == {"state": ServerState.DRAINING}
    assert waiting.is_warm_server
    assert server.next_attempt(server.close(waiting, Reason.LOST, LATER)) is None, "its pool starts another"


# After the end


@pytest.mark.parametrize(
    ("code", "exit_code", "reason"),
    [
        ("UserInitiated", 137, Reason.STOPPED),
        ("EssentialContainerExited", 0, Reason.ENDED),
        ("EssentialContainerExited", 1, Reason.LOST),
        ("EssentialContainerExited", None, Reason.LOST),
        ("SpotInterruption", 0, Reason.LOST),
        (None, 0, Reason.LOST),
    ],
)
def test_the_reason_of_a_closed_server_follows_from_how_its_task_ended(
    code: str | None, exit_code: int | None, reason: Reason
) -> None:
    assert server.reason_for(TaskStopped(code, exit_code)) is reason


def test_the_values_of_states_and_reasons_stay_as_they_are_in_stored_records() -> None:
    assert list(ServerState) == ["queued", "starting", "naming", "ready", "draining", "closed"]
    assert list(Reason) == ["stopped", "deadline", "ended", "lost", "refused", "no capacity", "full", "assigned"]
    assert server.key(LABEL) == f"_servers/{LABEL}.json"
