"""`AwsPlatform`: what it loads, when, and what it says when something is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from hippodrome.control.aws import AwsPlatform
from hippodrome.control.ports import DnsRecord, Topic
from testing.moto_world import MotoWorld


def _loaded(code: str) -> set[str]:
    """Return the modules that are loaded after running `code` in a fresh Python."""
    script = f"import sys\n{code}\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    return set(done.stdout.split())


def test_importing_the_package_loads_no_large_module() -> None:
    loaded = _loaded("import hippodrome.control.aws; hippodrome.control.aws.AwsPlatform({}).settings")
    assert not {"boto3", "botocore", "urllib3", "asyncio", "logging"} & loaded


def test_boto3_is_never_loaded() -> None:
    loaded = _loaded(
        "from hippodrome.control.aws import AwsPlatform\n"
        "p = AwsPlatform({'AWS_REGION': 'us-east-1', 'BUCKET': 'b'})\n"
        "p.documents._client(); p.bus; p.dns.browser_host"
    )
    assert "botocore.client" in loaded
    assert not {"boto3", "s3transfer"} & loaded


@pytest.mark.parametrize(
    ("act", "variable", "port"),
    [
        (lambda p: p.documents, "BUCKET", "documents"),
        (lambda p: next(p.tasks.list()), "CLUSTER", "tasks"),
        (lambda p: p.dns.change(add=[DnsRecord("a.example.org", "203.0.113.1")]), "HOSTED_ZONE_ID", "dns"),
        (lambda p: p.timers.cancel("a"), "SCHEDULE_GROUP", "timers"),
        (lambda p: p.timers.set("a", p.now(), {}), "SCHEDULE_GROUP", "timers"),
        (lambda p: p.bus.publish(Topic.START, {}), "START_SERVER_TOPIC_ARN", "bus"),
        (lambda p: p.bus.publish(Topic.STOP, {}), "STOP_SERVER_TOPIC_ARN", "bus"),
        (lambda p: p.bus.send_delayed({}, 1), "TASK_QUEUE_URL", "bus"),
    ],
)
def test_a_missing_variable_is_named(act, variable: str, port: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(RuntimeError, match=rf"{variable} is missing; the port '{port}' needs it"):
        act(AwsPlatform({"AWS_REGION": "us-east-1", variable: " "}))


def test_a_missing_region_is_named() -> None:
    with pytest.raises(RuntimeError, match="AWS_REGION is missing"):
        AwsPlatform({"BUCKET": "b"}).documents.get("key")


def test_a_variable_that_no_call_needs_may_be_missing() -> None:
    platform = AwsPlatform({})
    assert platform.dns.browser_host(DnsRecord("a.example.org", "203.0.113.1")) == "a.example.org"
    assert platform.settings.max_runtime == 24 * 60


def test_only_the_value_allowed_lets_front_ends_in_without_tokens() -> None:
    for value, allowed in (("allowed", True), ("refused", False), ("", False), ("true", False)):
        assert AwsPlatform({"PLAIN_CLIENTS": value}).settings.plain_clients is allowed
    assert AwsPlatform({}).settings.plain_clients is False


def test_pages_may_connect_to_servers_on_their_two_ports_and_nowhere_else() -> None:
    platform = AwsPlatform({"ROOT_DOMAIN": "Example.org.", "SERVERS_HOST": "servers"})
    assert platform.settings.game_sources == "wss://*.servers.example.org:443 wss://*.servers.example.org:5000"
    assert AwsPlatform({}).settings.game_sources == ""


def test_every_client_has_timeouts(moto_world: MotoWorld) -> None:
    platform = moto_world.platform
    for service, seconds in (("s3", 5), ("ecs", 10), ("route53", 5)):
        config = platform._client(service).meta.config
        assert (config.connect_timeout, config.read_timeout) == (2, seconds)
        assert (config.retries["mode"], config.retries["total_max_attempts"]) == ("standard", 3)


def test_one_client_per_service(moto_world: MotoWorld) -> None:
    platform = moto_world.platform
    assert platform._client("s3") is platform._client("s3")
    assert platform.documents is platform.documents


def test_next_step_has_clients_of_s3_and_sns_only(moto_world: MotoWorld) -> None:
    platform = moto_world.platform
    platform.documents.get("project_master_list.json")
    platform.dns.browser_host(DnsRecord("a.example.org", "203.0.113.1"))
    platform.bus.publish(Topic.START, {"projectId": "study", "userId": "P1"})
    assert set(platform._clients) == {"s3", "sns"}
