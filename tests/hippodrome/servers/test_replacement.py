"""Which attempt follows a closed server: automatically, or at the participant's request."""

from __future__ import annotations

import msgspec
import pytest

from hippodrome.model import server
from hippodrome.model.server import Reason
from hippodrome.servers.replacement import next_attempt, requestable_attempt
from tests.hippodrome.model.test_server import LATER, WARM_SERVER, claimed


@pytest.mark.parametrize("reason", list(Reason))
def test_which_attempt_follows_automatically_and_which_may_be_requested(reason: Reason) -> None:
    def following(attempt: int) -> tuple[int | None, int | None]:
        closed = server.close(claimed(attempt=attempt), reason, LATER)
        return next_attempt(closed), requestable_attempt(closed)

    replaced, full = reason in (Reason.LOST, Reason.NO_CAPACITY), reason is Reason.FULL
    assert following(1) == ((2, None) if replaced else (None, 1 if full else 2))
    assert following(2) == ((3, None) if replaced else (None, 2 if full else 3))
    assert following(3) == (None, 3 if full else 4)
    assert following(7) == (None, 7 if full else 8)
    assert following(8) == (None, 8 if full else None)


def test_nothing_follows_an_open_server_nor_a_warm_server() -> None:
    assert (next_attempt(claimed()), requestable_attempt(claimed())) == (None, None)
    assert next_attempt(server.close(claimed(WARM_SERVER), Reason.LOST, LATER)) is None
    closed = msgspec.structs.replace(server.close(claimed(), Reason.LOST, LATER), reason=None)
    assert next_attempt(closed) is None
