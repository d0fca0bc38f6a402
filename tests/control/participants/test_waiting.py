"""The state of a server that the waiting page gets, field by field."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from typing import Any

import msgspec
import pytest

from hippodrome.control.model import server
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.participants.waiting import FAILURES, ServerStates
from hippodrome.control.ports import Address
from hippodrome.control.storage.secret import SecretCache
from testing.fake_platform import FakePlatform
from testing.studies import study
from testing.visitors import visit_of

NOW = datetime(2026, 11, 21, 12, tzinfo=UTC)
PLATFORM = FakePlatform()
SECRETS = SecretCache(PLATFORM.documents)


def started(attempt: int = 1, **changes: object) -> Server:
    record = server.new_attempt(study(), "alice", attempt, nonce="n", settings=PLATFORM.settings, now=NOW)
    return msgspec.structs.replace(record, **changes)


def running(seconds: float) -> Server:
    named = server.naming(started(), "task", Address("192.0.2.1", 5000), NOW)
    return server.ready(named, NOW + timedelta(seconds=seconds))


def state_of(record: Server | None, waiting: ServerStates | None = None, **changes: Any) -> dict[str, Any]:
    visit = visit_of(study(), NOW + timedelta(seconds=7.4))
    return (waiting or ServerStates(PLATFORM, SECRETS)).state(visit, visit.project.steps[2], record, **changes)


def test_before_there_is_a_server_the_state_is_queued_since_the_participant_came() -> None:
    assert state_of(None, since=NOW) == {
        "state": "queued",
        "attempt": 1,
        "again": False,
        "without": False,
        "reason": None,
        "replaces": False,
        "userId": "alice",
        "step": "3",
        "seconds": 7,
        "typical": None,
    }
    assert state_of(None)["seconds"] == 0
    assert state_of(None, since=NOW + timedelta(minutes=1))["seconds"] == 0, "clocks may differ"


def test_a_participant_who_is_not_at_a_game_step_gets_the_first_game_step() -> None:
    waiting, project = ServerStates(PLATFORM, SECRETS), study()
    assert waiting.state(visit_of(project), None, None)["step"] == "3"
    no_game = study(steps=[project.steps[0], project.steps[-1]])
    assert waiting.state(visit_of(no_game), None, None)["step"] is None


def test_the_wait_for_a_server_counts_from_its_request() -> None:
    state = state_of(started(2, state=ServerState.NAMING), since=NOW - timedelta(hours=1))
    assert (state["state"], state["attempt"], state["seconds"], "url" in state) == ("naming", 2, 7, False)


def test_only_a_ready_server_gives_its_address_and_token() -> None:
    token = SECRETS.get_or_create().token(running(60))
    state = state_of(running(60))
    assert state["state"] == "ready"
    host = PLATFORM.dns.browser_host(running(60).dns_record)  # type: ignore[arg-type]
    assert (state["url"], state["token"]) == (f"{PLATFORM.settings.game_scheme}://{host}:5000/", token)
    assert len(token) == 48
    for record in (
        started(),
        started(state=ServerState.READY),
        started(state=ServerState.NAMING, host="192.0.2.1", port=5000),
    ):
        assert not {"url", "token"} & state_of(record).keys()


def test_the_typical_wait_is_the_median_of_the_last_fifty_starts() -> None:
    waiting = ServerStates(PLATFORM, SECRETS)
    assert state_of(running(10), waiting)["typical"] == 10
    for seconds in (30, 20.4, 60, 70):
        state_of(running(seconds), waiting)
    assert state_of(None, waiting)["typical"] == 30
    for _ in range(46):
        state_of(running(90), waiting)
    assert len(waiting._start_times) == 50
    assert waiting._start_times[0] == 30, "the oldest is forgotten"
    assert state_of(None, waiting)["typical"] == 90
    state_of(msgspec.structs.replace(running(1), ready=None), waiting)
    assert waiting._start_times[-1] == 90, "a start whose end nobody wrote down tells nothing"


@pytest.mark.parametrize("reason", [Reason.LOST, Reason.NO_CAPACITY])
def test_a_server_that_is_replaced_automatically_is_queued_again(reason: Reason) -> None:
    state = state_of(server.close(started(2), reason, NOW))
    assert (state["state"], state["attempt"], state["again"]) == ("queued", 3, False)
    assert state["replaces"] is (reason is Reason.LOST)


@pytest.mark.parametrize("reason", [reason for reason in Reason if reason is not Reason.ASSIGNED])
def test_a_closed_server_has_failed_or_ended_and_may_be_asked_for_again(reason: Reason) -> None:
    state = state_of(server.close(started(3), reason, NOW))
    failed = reason in (Reason.LOST, Reason.NO_CAPACITY, Reason.REFUSED, Reason.FULL)
    assert (state["state"], state["reason"]) == ("failed" if failed else "ended", reason)
    assert (state["again"], state["replaces"], reason in FAILURES) == (True, False, failed)
    assert state["without"] is (failed and reason is not Reason.FULL)
    last = state_of(server.close(started(8), reason, NOW))
    assert (last["again"], last["without"]) == (reason is Reason.FULL, failed and reason is not Reason.FULL)


@pytest.mark.parametrize(("reason", "replaces"), [(Reason.LOST, True), (Reason.STOPPED, False)])
def test_a_server_after_a_lost_one_is_shown_as_its_replacement(reason: Reason, replaces: bool) -> None:
    assert state_of(server.replacing(server.close(started(), reason, NOW), started(2)))["replaces"] is replaces
    assert state_of(started())["replaces"] is False
    second = server.replacing(server.close(started(), reason, NOW), started(2))
    third = server.replacing(server.close(second, Reason.STOPPED, NOW), started(3))
    assert state_of(third)["replaces"] is False, "the latest of the earlier ones counts"
