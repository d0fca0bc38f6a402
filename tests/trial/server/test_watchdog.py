"""When the watchdog ends a server: without a participant who plays, or at its deadline."""

import math

from hippodrome.trial.server.lifetime import Watchdog


def test_the_watchdog_ends_a_server_by_idle_time_grace_or_deadline():
    dog = Watchdog(now=0, idle=10, grace=60, deadline=1000)
    assert dog.verdict(9) is None
    assert dog.verdict(10) == "idle"
    dog.came()
    assert dog.verdict(999) is None
    assert dog.verdict(1000) == "deadline"
    dog.wait(500)
    assert dog.verdict(559) is None
    assert dog.verdict(560) == "idle"
    assert Watchdog(now=0, idle=10, grace=0, deadline=None).expires() == 10


def test_no_wait_for_a_participant_goes_beyond_the_deadline():
    dog = Watchdog(now=0, idle=10, grace=60, deadline=5)
    assert (dog.expires(), dog.verdict(4.9), dog.verdict(5)) == (5, None, "deadline")
    dog.came()
    dog.wait(1)
    assert (dog.expires(), dog.verdict(5)) == (5, "deadline")


def test_while_a_participant_is_there_only_the_deadline_ends_a_server():
    dog = Watchdog(now=0, idle=10, grace=60, deadline=None)
    dog.came()
    assert (dog.expires(), dog.verdict(1e9)) == (math.inf, None)
    assert Watchdog(now=None, idle=10, grace=60, deadline=None).expires() == math.inf
