"""An installation whose servers get names in another domain: the certificate for these names is ordered first."""

# ruff: noqa: F401, F811 - fixtures are imported, and asked for by their names

import pytest

from hippodrome.console.problem import Problem
from hippodrome.control.aws.challenges import Route53Challenges
from hippodrome.control.certificates.order import read_stored
from hippodrome.control.certificates.rules import FailureReason, OrderFailed, location
from hippodrome.deployment.stack import domain_change
from tests.certificate.test_command import own
from tests.deployment.installation import access_keys
from tests.deployment.stack.test_domain_change import prepared, world

OLD, NEW = location("games.example.org"), location("servers.example.org")


@pytest.fixture
def before(world, own, capsys):
    """An installation with a certificate for *.games.example.org."""
    ran = world.run(capsys, "certificate", *own)
    assert ran.code == 0, ran.err
    assert names(world, OLD) == ("*.games.example.org",)
    return world


def names(world, where):
    return read_stored(world.get(where.privkey)).names


def test_the_certificate_of_the_new_names_is_ordered_before_servers_get_them(before, pebble):
    domain_change.certify(prepared(before))
    assert names(before, NEW) == ("*.servers.example.org",)
    orders = pebble.orders()
    domain_change.certify(prepared(before))
    assert pebble.orders() == orders, "an apply that was cut off goes on"


def test_without_the_new_certificate_the_stack_is_not_changed(before, monkeypatch):
    def fails(self, name, values, seconds):
        raise OrderFailed(FailureReason.DNS, "no")

    monkeypatch.setattr(Route53Challenges, "put", fails)
    with pytest.raises(Problem, match=r"^The stack stays as it was: there is no certificate for names below servers"):
        domain_change.certify(prepared(before))
    assert before.keys("SSL/servers.example.org/") == [NEW.state]
