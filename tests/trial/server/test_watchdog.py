"""When the watchdog ends a server: without a participant who plays, or at its deadline."""

from trial.server.watchdog import Watchdog


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
