"""Which messages of a client are read, and which end its connection."""

from __future__ import annotations

import pytest

from hippodrome.trial.core.messages import BadMessage, CloseConnection
from hippodrome.trial.core.timing import Window
from hippodrome.trial.wire.inbound import MESSAGES_A_SECOND, Inbound


def test_acknowledgements_count_among_the_messages_of_a_second() -> None:
    window = Window()
    window.sent(1, 0.0)
    inbound = Inbound(window)
    for _ in range(MESSAGES_A_SECOND):
        assert inbound.read('{"ack": 1}', 5.0).ack == 1
    with pytest.raises(CloseConnection):
        inbound.read('{"ack": 1}', 5.0)


def test_a_frame_that_was_not_sent_cannot_be_acknowledged() -> None:
    with pytest.raises(BadMessage):
        Inbound(Window()).read('{"ack": 1}', 5.0)
