"""Which attempt follows a closed server, automatically or at the participant's request, and what replaces its record."""

from __future__ import annotations

import msgspec
import pytest

from hippodrome.control.model import server
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Events, Project
from hippodrome.control.model.server import Reason, Server, next_attempt, requestable_attempt
from hippodrome.control.ports import Conflict, Topic
from hippodrome.control.servers.replacement import Replacement
from hippodrome.control.servers.services import ServerServices
from hippodrome.protocol.keys import answer_key
from testing.studies import installed, study
from tests.control.model.test_server import LATER, WARM_SERVER, new_record


@pytest.mark.parametrize("reason", list(Reason))
def test_which_attempt_follows_automatically_and_which_may_be_requested(reason: Reason) -> None:
    def following(attempt: int) -> tuple[int | None, int | None]:
        closed = server.close(new_record(attempt=attempt), reason, LATER)
        return next_attempt(closed), requestable_attempt(closed)

    replaced, full = reason in (Reason.LOST, Reason.NO_CAPACITY), reason is Reason.FULL
    assert following(1) == ((2, None) if replaced else (None, 1 if full else 2))
    assert following(2) == ((3, None) if replaced else (None, 2 if full else 3))
    assert following(3) == (None, 3 if full else 4)
    assert following(7) == (None, 7 if full else 8)
    assert following(8) == (None, 8 if full else None)


def test_nothing_follows_an_open_server_nor_a_warm_server() -> None:
    assert (next_attempt(new_record()), requestable_attempt(new_record())) == (None, None)
    assert next_attempt(server.close(new_record(WARM_SERVER), Reason.LOST, LATER)) is None
    closed = msgspec.structs.replace(server.close(new_record(), Reason.LOST, LATER), reason=None)
    assert next_attempt(closed) is None


TWO_GAMES = study(
    steps=[Step("1", "game"), Step("2", "game"), Step("finalStep", "debrief")], events=Events("1", "finalStep")
)
NO_GAME = study(steps=[Step("1", "questionnaire"), Step("finalStep", "debrief")], events=Events("1", "finalStep"))
LOST = server.close(new_record(), Reason.LOST, LATER)


@pytest.mark.parametrize(
    ("project", "answered", "requested"),
    [
        (TWO_GAMES, [], [2]),
        (TWO_GAMES, ["1"], [2]),
        (TWO_GAMES, ["1", "2"], []),
        (NO_GAME, [], [2]),
        (study(live=False), ["3"], [2]),  # start_server drops the message unless the study is live again
    ],
)
def test_a_lost_server_is_replaced_unless_all_its_games_are_answered(
    project: Project, answered: list[str], requested: list[int]
) -> None:
    platform = installed(project)
    for step in answered:
        platform.documents.put(answer_key("maze", "alice", step), b"{}")
    Replacement(ServerServices(platform)).request(LOST)
    assert platform.bus.sent == [
        (Topic.START, {"projectId": "maze", "userId": "alice", "attempt": attempt}) for attempt in requested
    ]


def test_the_next_attempts_record_keeps_the_closed_one() -> None:
    services = ServerServices(installed())
    services.repository.create(LOST)
    written = Replacement(services).write_record(new_record(attempt=2)).server
    assert (written.attempt, [one.reason for one in written.earlier]) == (2, [Reason.LOST])
    assert services.repository.server_of("maze", "alice") == written


@pytest.mark.parametrize(
    ("before", "attempt"),
    [(None, 2), (new_record(), 2), (LOST, 3), (server.close(new_record(attempt=2), Reason.LOST, LATER), 2)],
)
def test_only_the_closed_record_of_the_attempt_before_is_replaced(before: Server | None, attempt: int) -> None:
    services = ServerServices(installed())
    if before:
        services.repository.create(before)
    with pytest.raises(Conflict):
        Replacement(services).write_record(new_record(attempt=attempt))
    assert services.repository.server_of("maze", "alice") == before
