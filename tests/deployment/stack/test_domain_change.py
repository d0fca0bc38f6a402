"""Changes of the servers' names, the site or the network of an installation: what `apply` checks beforehand."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from moto.route53.models import HostedZoneIdentifier

from hippodrome.console.problem import Problem
from hippodrome.control.model.server import ServerState
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.core.finding import Mark
from hippodrome.deployment.lifecycle import preflight
from hippodrome.deployment.stack import domain_change
from hippodrome.deployment.stack.changes import Prepared
from hippodrome.deployment.stack.stack import Stack
from tests.deployment.installation import Installed, account_here


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch, access_keys: None) -> Iterator[Installed]:
    """An installation whose servers have names below games.example.org."""
    # Gap: moto's hosted zones have ids that begin with anything. AWS's begin with Z.
    monkeypatch.setattr(HostedZoneIdentifier, "generate", lambda *_, **__: "Z0123456789ABCDEFGHIJ")
    with Installed(ServersHost="games") as made:
        yield made


def prepared(world: Installed, account: Account | None = None, **changed: str) -> Prepared:
    """Return a prepared apply that gives the servers names below servers.example.org, or other changes."""
    stands = {
        "RootDomain": "example.org",
        "HostedZoneId": world.env["HOSTED_ZONE_ID"],
        "SiteHost": "study",
        "ServersHost": "games",
    }
    outputs = [{"OutputKey": key, "OutputValue": value} for key, value in world.outputs.items()]
    parameters = [{"ParameterKey": key, "ParameterValue": value} for key, value in stands.items()]
    found = {
        **{"StackName": "hippodrome", "StackStatus": "UPDATE_COMPLETE"},
        **{"Outputs": outputs, "Parameters": parameters},
    }
    account = account or account_here()
    nothing: Any = None
    wanted = {**stands, "ServersHost": "servers", **changed}
    return Prepared(account, Stack(account, "hippodrome"), found, nothing, (), wanted, nothing)


def servers_in_the_way(world: Installed, **changed: str) -> str:
    """Return what preflight says about the servers that run; "" if they are not in the way."""
    found = [finding for finding in preflight.look_at(prepared(world, **changed)) if finding.check == "servers"]
    assert all(finding.mark is Mark.BAD and "hippodrome stop --all" in finding.advice for finding in found)
    return " ".join(finding.text for finding in found)


STAYS = {"ServersHost": "games"}


@pytest.mark.parametrize(
    ("changed", "why"),
    [
        ({}, "their names below games.example.org"),
        ({"RootDomain": "pilot.example.org"}, "their names below games.example.org"),
        (STAYS | {"SiteHost": "lab"}, "the address of participants' pages, study.example.org"),
        (STAYS | {"VpcId": "vpc-1", "SubnetIds": "subnet-1"}, "their network"),
    ],
)
@pytest.mark.parametrize("state", [ServerState.STARTING, ServerState.READY, ServerState.DRAINING])
def test_running_servers_stop_a_change_of_their_domain_site_or_network(
    world: Installed, state: ServerState, changed: dict[str, str], why: str
) -> None:
    world.record("alice", state)
    changed = {"VpcId": "", "SubnetIds": ""} | changed
    said = servers_in_the_way(world, **changed)
    assert "while 1 server runs" in said
    assert why in said
    world.record("alice", ServerState.CLOSED)
    assert servers_in_the_way(world, **changed) == ""


def test_running_servers_are_not_in_the_way_if_nothing_of_theirs_changes(world: Installed) -> None:
    world.record("alice")
    with world.recording() as calls:
        assert servers_in_the_way(world, ServersHost="games", VpcId="", SubnetIds="") == ""
    assert calls == []


def test_without_new_names_no_certificate_is_ordered(world: Installed) -> None:
    world.record("alice", dns="alice.example.org")
    with world.recording() as calls:
        domain_change.certify(prepared(world, ServersHost="games"))
    assert calls == []


@pytest.mark.parametrize(
    ("domain", "level"),
    [("servers.example.org", "servers"), ("org", "example")],
    ids=["its site below our servers", "our site below its servers"],
)
def test_a_site_cannot_have_a_name_that_the_certificate_of_other_servers_covers(
    world: Installed, domain: str, level: str
) -> None:
    text = {"RootDomain": {"Type": "String", "Default": domain}, "ServersHost": {"Type": "String", "Default": level}}
    topic = {"Type": "AWS::SNS::Topic", "Properties": {"TopicName": "other"}}
    world.stack({"Parameters": text, "Resources": {"Topic": topic}}, "other")
    found = preflight.look_at(prepared(world, VpcId="", SubnetIds=""))
    (finding,) = [finding for finding in found if finding.check == "servers' names"]
    assert finding.mark is Mark.BAD
    assert "would be for the site of the other: this one and other" in finding.text


def test_a_manual_certificate_needs_another_for_the_new_names(world: Installed) -> None:
    domain_change.certify(prepared(world))  # no certificate: nobody can play, so nothing has to go on
    world.put("SSL/games.example.org/privkey.pem", b"-----BEGIN PRIVATE KEY-----\n")
    with pytest.raises(Problem, match=r"there is none for \*\.servers\.example\.org") as caught:
        domain_change.certify(prepared(world))
    assert "SSL/servers.example.org/privkey.pem" in caught.value.advice
    world.put("SSL/servers.example.org/privkey.pem", b"-----BEGIN PRIVATE KEY-----\n")
    domain_change.certify(prepared(world))
