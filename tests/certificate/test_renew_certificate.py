"""The function `renew_certificate`, which a timer calls, with a real authority."""

from datetime import timedelta
from types import SimpleNamespace

import pytest

from hippodrome.control.certificates.rules import ACCOUNT, OrderFailed
from hippodrome.control.ports import Settings
from hippodrome.functions import installed
from hippodrome.functions.renew_certificate import MARGIN, handler
from tests.certificate.conftest import DOMAIN, PLACE, PRIVKEY
from tests.certificate.pebble import answer_as_route_53


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
            settings=Settings(root_domain="example.org", servers_host="servers"),
        )
    )
    yield lambda context=None: handler({"source": "aws.events"}, context or Context())
    installed.use(None)


def test_without_an_earlier_order_the_function_orders_nothing(function, place, log):
    assert function() == {"certificate": "none"}
    assert "nothing to renew" in log.getvalue()


def test_a_due_certificate_is_renewed_at_its_own_authority(function, place, log):
    place.obtain()
    first, account = place.key, place.read(ACCOUNT)
    assert function()["certificate"] == "fresh"
    assert place.key == first
    place.ahead = timedelta(days=61)
    said = function()
    assert said["certificate"] == "ordered"
    assert said["notAfter"] == place.renewal().read()[1].not_after.isoformat()
    assert place.key != first
    assert place.read(ACCOUNT) == account
    assert not place.challenges.present
    for line in place.key.splitlines():
        assert line not in log.getvalue()


def test_a_failure_is_raised_for_the_alarm_and_then_the_function_waits(function, place, log):
    place.obtain()
    place.lose_account()
    place.ahead, place.challenges.lies = timedelta(days=61), True
    with pytest.raises(OrderFailed):
        function()
    assert function()["certificate"] == "wait"
    place.ahead += timedelta(days=1)
    place.challenges.lies = False
    assert function()["certificate"] == "ordered"


def test_the_function_ends_before_lambdas_timeout(function, place):
    """When little time is left, the function ends by its own timeout and cleans up, before Lambda's timeout."""
    place.obtain()
    place.lose_account()
    place.ahead = timedelta(days=61)
    place.challenges.put = lambda name, values, seconds: (_ for _ in ()).throw(OrderFailed("timeout", f"{seconds}"))
    with pytest.raises(OrderFailed):
        function(Context(seconds=MARGIN + 30))
    assert place.state.claim == ""
    assert float(place.state.failures[-1].text) < 30.0


def test_a_certificate_that_was_put_there_by_hand_is_not_renewed(function, place, tmp_path):
    place.documents.create(PRIVKEY, b"-----BEGIN PRIVATE KEY-----\n")
    assert function() == {"certificate": "none"}
    assert place.key.startswith("-----BEGIN PRIVATE")


def test_the_functions_role_allows_its_calls_and_no_other_role_allows_its_writes(moto_world, pebble, monkeypatch):
    """Route 53 and S3 on moto; the roles in infra/template.yml must allow each call (see testing/iam/enforcement.py)."""
    from hippodrome.control.certificates.renewal import Renewal
    from hippodrome.control.certificates.rules import RenewalRequest
    from testing.iam.actions import asks

    if moto_world.iam is None:
        pytest.skip("the evaluator of roles is not installed (tests/infra/test_enforcement.py)")
    answer_as_route_53(pebble, monkeypatch)
    platform = moto_world.platform
    Renewal(platform.documents, platform.challenges, platform.now, PLACE).obtain(
        RenewalRequest(DOMAIN, pebble.directory, trusted=pebble.trusted)
    )
    platform.documents.delete(ACCOUNT)  # so that all must be proved again (see `lose_account`)
    now = platform.now
    monkeypatch.setattr(platform, "now", lambda: now() + timedelta(days=61))
    installed.use(platform)
    try:
        with moto_world.recording() as calls:
            assert handler({"source": "aws.events"}, Context())["certificate"] == "ordered"
    finally:
        installed.use(None)
    wanted = [ask for call in calls for ask in asks(call.service, call.operation, call.params, moto_world.iam)]
    judge = moto_world.iam._judge
    assert {ask.kind.split()[0] for ask in wanted} >= {"s3:GetObject", "s3:PutObject", "route53:GetChange"}
    for ask in wanted:
        assert judge.may("renew_certificate", ask), ask
        if ask.kind.split()[0] in {"s3:PutObject", "route53:ChangeResourceRecordSets"} or "SSL" in str(ask.resource):
            served = ask.kind.split()[0] == "s3:GetObject" and str(ask.resource).endswith(".pem")
            signs = {"sign_requests"} if served else set()  # the documents that servers get by presigned requests
            shared = {"certify_server"} if str(ask.resource).endswith("/account.json") else set()
            assert set(judge.who_may(ask)) == {"renew_certificate"} | signs | shared, ask
