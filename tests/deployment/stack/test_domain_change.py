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
    stands = {"RootDomain": "example.org", "HostedZoneId": world.env["HOSTED_ZONE_ID"], "SiteHost": "study"}
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


@pytest.mark.parametrize("moved", [{}, {"RootDomain": "pilot.example.org"}])
def test_running_servers_stop_a_change_of_their_domain(world: Installed, moved: dict[str, str]) -> None:
    world.record("alice")
    with pytest.raises(Problem, match=r"Servers run below games\.example\.org") as caught:
        domain_change.check(prepared(world, **moved))
    assert "hippodrome stop --all" in caught.value.advice
    world.record("alice", ServerState.CLOSED)
    domain_change.check(prepared(world, **moved))


@pytest.mark.parametrize("state", [ServerState.STARTING, ServerState.READY, ServerState.DRAINING])
def test_running_servers_stop_a_change_of_the_site(world: Installed, state: ServerState) -> None:
    world.record("alice", state)
    for moved in (prepared(world, SiteHost="lab"), prepared(world, RootDomain="pilot.example.org")):
        with pytest.raises(Problem, match=r"their pages are at study\.example\.org, which would be gone") as caught:
            domain_change.check_site(moved)
        assert "hippodrome stop --all" in caught.value.advice
        assert caught.value.details == ("1 of them",)
    with world.recording() as calls:
        domain_change.check_site(prepared(world))
    assert calls == []  # the site does not change
    world.record("alice", ServerState.CLOSED)
    domain_change.check_site(prepared(world, SiteHost="lab"))


def test_running_servers_stop_a_change_of_the_network(world: Installed) -> None:
    world.record("alice")
    own = prepared(world, VpcId="")
    with world.recording() as calls:
        domain_change.check_network(own)
    assert calls == []
    with pytest.raises(Problem, match="lose their way out") as caught:
        domain_change.check_network(prepared(world, VpcId="vpc-1"))
    assert "hippodrome stop --all" in caught.value.advice
    world.record("alice", ServerState.CLOSED)
    domain_change.check_network(prepared(world, VpcId="vpc-1"))


@pytest.mark.parametrize(("site", "vpc"), [("lab", ""), ("study", "vpc-1")])
def test_preflight_finds_servers_that_stop_a_change_of_site_or_network(world: Installed, site: str, vpc: str) -> None:
    world.record("alice")
    moved = prepared(world, ServersHost="games", SiteHost=site, VpcId=vpc, SubnetIds="subnet-1")
    found = preflight.look_at(moved)
    assert [one.mark for one in found if one.check == "servers"] == [Mark.BAD]


def test_without_new_names_nothing_is_checked(world: Installed) -> None:
    world.record("alice", dns="alice.example.org")
    with world.recording() as calls:
        domain_change.check(prepared(world, ServersHost="games"))
        domain_change.certify(prepared(world, ServersHost="games"))
    assert calls == []


def test_servers_cannot_have_names_below_a_delegated_level(world: Installed) -> None:
    record = {"Name": "servers.example.org", "Type": "NS", "TTL": 60, "ResourceRecords": [{"Value": "ns.example.net."}]}
    world.client("route53").change_resource_record_sets(
        HostedZoneId=world.env["HOSTED_ZONE_ID"],
        ChangeBatch={"Changes": [{"Action": "CREATE", "ResourceRecordSet": record}]},
    )
    with pytest.raises(Problem, match=r"Names below servers\.example\.org are answered elsewhere"):
        domain_change.check(prepared(world))
    domain_change.check(prepared(world, ServersHost="lab"))


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
    with pytest.raises(Problem, match="would be for the site of the other: this one and other"):
        domain_change.check(prepared(world))


def test_a_manual_certificate_needs_another_for_the_new_names(world: Installed) -> None:
    domain_change.certify(prepared(world))  # no certificate: nobody can play, so nothing has to go on
    world.put("SSL/games.example.org/privkey.pem", b"-----BEGIN PRIVATE KEY-----\n")
    with pytest.raises(Problem, match=r"there is none for \*\.servers\.example\.org") as caught:
        domain_change.certify(prepared(world))
    assert "SSL/servers.example.org/privkey.pem" in caught.value.advice
    world.put("SSL/servers.example.org/privkey.pem", b"-----BEGIN PRIVATE KEY-----\n")
    domain_change.certify(prepared(world))
