"""How often a member may connect: a phone in a tunnel always may."""

import pytest

from hippodrome.trial.server.admission import SECONDS_EACH, Reconnects


@pytest.mark.parametrize("every", [2, 5, 11])
def test_a_phone_that_is_cut_off_every_few_seconds_for_an_hour_is_always_let_in(every):
    """Our page waits half a second after a loss, and notices a dead connection after 7 seconds."""
    reconnects = Reconnects()
    assert all(reconnects.allowed("anna", now) for now in range(100, 3700, every))


def test_a_phone_that_is_cut_off_twice_a_second_in_a_tunnel_is_let_in_for_a_quarter_of_a_minute():
    reconnects = Reconnects()
    assert all(reconnects.allowed("anna", 100 + number / 2) for number in range(30))


def test_a_member_who_has_used_all_connections_is_let_in_again_at_the_rate_of_the_limit():
    reconnects = Reconnects()
    assert [reconnects.allowed("anna", 100) for _ in range(31)] == [True] * 30 + [False]
    for wait in (1, 2, 3):
        now = 100 + wait * SECONDS_EACH
        assert not reconnects.allowed("anna", now - 0.01)
        assert reconnects.allowed("anna", now)
        assert not reconnects.allowed("anna", now)
