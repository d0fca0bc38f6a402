"""The function on the timer, with a real authority."""

from datetime import timedelta
from types import SimpleNamespace

import pytest

from hippodrome.certificate import ACCOUNT, OrderFailed
from hippodrome.platform import Settings
from lambdas import installed
from lambdas.renew_certificate import handler
from tests.certificate.conftest import DOMAIN


class Context:
    def __init__(self, seconds=600):
        self._seconds = seconds

    def get_remaining_time_in_millis(self):
        return int(self._seconds * 1000)


@pytest.fixture
def function(place):
    installed.use(
        SimpleNamespace(
            documents=place.documents,
            challenges=place.challenges,
            now=place.now,
            settings=Settings(root_domain=DOMAIN),
        )
    )
    yield lambda context=None: handler({"source": "aws.events"}, context or Context())
    installed.use(None)


def test_nothing_was_ever_ordered(function, place, log):
    assert function() == {"certificate": "none"}
    assert "nothing to renew" in log.getvalue()


def test_it_renews_when_it_is_time_from_where_it_came(function, place, log):
    place.obtain()
    first, account = place.key, place.read(ACCOUNT)
    assert function()["certificate"] == "fresh"
    assert place.key == first
    place.ahead = timedelta(days=61)
    said = function()
    assert said["certificate"] == "ordered"
    assert said["notAfter"] == place.state.not_after.isoformat()
    assert place.key != first
    assert place.read(ACCOUNT) == account
    assert not place.challenges.present
    for line in place.key.splitlines():
        assert line not in log.getvalue()


def test_a_failure_is_raised_for_the_alarm_and_then_it_waits(function, place, log):
    place.obtain()
    place.ahead, place.challenges.lies = timedelta(days=61), True
    with pytest.raises(OrderFailed):
        function()
    assert function()["certificate"] == "wait"
    place.ahead += timedelta(days=1)
    place.challenges.lies = False
    assert function()["certificate"] == "ordered"


def test_it_ends_before_it_is_ended(function, place):
    """Little time left: a timeout of its own, with everything tidied up, and not Lambda's."""
    place.obtain()
    place.ahead = timedelta(days=61)
    place.challenges.put = lambda name, values, seconds: (_ for _ in ()).throw(OrderFailed("timeout", f"{seconds}"))
    with pytest.raises(OrderFailed):
        function(Context(seconds=61))
    assert place.state.claim == ""
    assert float(place.state.failures[-1].text) < 1.0


def test_it_stops_where_there_is_no_certificate_of_ours(function, place, tmp_path):
    from hippodrome.certificate import PRIVKEY

    place.documents.create(PRIVKEY, b"-----BEGIN PRIVATE KEY-----\n")
    assert function() == {"certificate": "none"}
    assert place.key.startswith("-----BEGIN PRIVATE")
