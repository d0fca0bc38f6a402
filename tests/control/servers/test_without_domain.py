"""An installation without a domain: servers have no names, and are ready once their certificate is issued."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta

import msgspec
import pytest

from hippodrome.control.certificates.rules import ADDRESS_ORDERS, MAX_ORDERS_AT_START, AddressOrders, CountedOrder
from hippodrome.control.model import ids, server
from hippodrome.control.model.design import Step
from hippodrome.control.model.messages import DnsChanged, ServerAttempt, StartServer, StopServer, TaskChanged
from hippodrome.control.model.project import MASTER_LIST, MasterList, Project
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Reason, Server, ServerState
from hippodrome.control.ports import Settings
from hippodrome.control.servers.overdue import LOST_AFTER, Remedy, remedy
from hippodrome.protocol import environment
from testing.fake_platform import FakePlatform
from testing.servers import Servers
from testing.visitors import Browser

LABEL = ids.server_label("maze", "alice")
NAME = ids.server_name(LABEL, 1)
URL = "https://a1b2c3.execute-api.us-east-1.amazonaws.com/certificate"


@pytest.fixture
def platform() -> FakePlatform:
    platform = FakePlatform()
    platform.settings = replace(
        platform.settings, root_domain="", servers_host="servers", game_sources="", certificate_url=URL
    )
    project = Project(id="maze", steps=[Step(key="1", page="game"), Step(key="2", page="end")], live=True, secret="0")
    platform.documents.put(MASTER_LIST, to_json(MasterList(projects=[project])))
    return platform


@pytest.fixture
def servers(platform: FakePlatform) -> Servers:
    servers = Servers(platform)
    servers.start(StartServer("maze", "alice"))
    return servers


def run(platform: FakePlatform, servers: Servers) -> None:
    (task,) = platform.tasks.running
    assert servers.tasks_changed([TaskChanged(task, "hippodrome", NAME, "RUNNING", "eni-0", None, "", None)]) == []


def record(platform: FakePlatform) -> Server:
    return from_json(platform.documents.kept[server.key(LABEL)][0], Server)


def policy(platform: FakePlatform) -> str:
    """The Content-Security-Policy of the participant's page."""
    return str(Browser(platform).send()["headers"]["Content-Security-Policy"])


def test_the_server_is_told_where_to_get_its_certificate_and_no_place_of_a_shared_one(platform, servers) -> None:
    (request,) = platform.tasks.running.values()
    assert request.environment[environment.CERTIFICATE] == URL
    assert not {environment.SSL_FULLCHAIN, environment.SSL_PRIVKEY} & set(request.environment)


def test_no_name_is_made_and_the_server_is_ready_when_its_certificate_is_issued(platform, servers) -> None:
    run(platform, servers)
    assert record(platform).state is ServerState.NAMING
    assert list(platform.dns.list()) == []
    assert platform.bus.delayed == []
    servers.dns_changed(DnsChanged("", [ServerAttempt(LABEL, 1)]))  # as certify_server sends it
    assert record(platform).state is ServerState.READY


def test_the_page_may_reach_this_one_server(platform, servers) -> None:
    run(platform, servers)
    assert "connect-src 'self';" in policy(platform)
    servers.dns_changed(DnsChanged("", [ServerAttempt(LABEL, 1)]))
    address = f"wss://{record(platform).host}:{record(platform).port}"
    assert f"connect-src 'self' {address};" in policy(platform)
    assert address in Browser(platform).get()


def test_a_server_that_ends_leaves_nothing(platform, servers) -> None:
    run(platform, servers)
    assert servers.stop([StopServer("maze", "alice", 1)]) == []
    assert (record(platform).state, record(platform).reason) == (ServerState.CLOSED, Reason.STOPPED)
    assert not platform.tasks.running


def test_no_server_starts_when_too_many_certificates_were_ordered(platform) -> None:
    placed = tuple(CountedOrder(platform.now(), f"s{n}-1") for n in range(MAX_ORDERS_AT_START))
    platform.documents.put(ADDRESS_ORDERS, to_json(AddressOrders(placed)))
    servers = Servers(platform)
    servers.start(StartServer("maze", "alice"))
    assert not platform.tasks.running
    assert record(platform).reason is Reason.FULL
    platform.wait(hours=3)
    servers.start(StartServer("maze", "alice"))
    assert platform.tasks.running


def test_a_server_without_a_certificate_is_lost_after_ten_minutes(platform, servers) -> None:
    run(platform, servers)
    found = record(platform)
    task = next(iter(platform.tasks.list()))
    assert remedy(found, task, platform.now() + timedelta(minutes=5)) is None
    assert remedy(found, task, platform.now() + LOST_AFTER + timedelta(seconds=1)) is Remedy.LOST
    named = msgspec.structs.replace(found, dns="s1.servers.example.org")
    assert remedy(named, task, platform.now() + timedelta(minutes=5)) is Remedy.DNS


def test_settings_without_a_domain_have_no_servers_domain() -> None:
    settings = Settings.from_env({"ROOT_DOMAIN": "", "SERVERS_HOST": "servers", "CERTIFICATE_URL": URL})
    assert (settings.servers_domain, settings.game_sources, settings.game_scheme) == ("", "", "wss")
    assert settings.certificate_url == URL
