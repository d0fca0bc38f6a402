"""An installation takes over the servers' certificate of a removed one, so five in succession order only once."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import pytest
from botocore.exceptions import ClientError
from cryptography.hazmat.primitives import serialization
from cryptography.hazmat.primitives.asymmetric import ec

from hippodrome import cli
from hippodrome.console.problem import Exit
from hippodrome.control.certificates import order
from hippodrome.control.certificates.order import Issued, read_chain
from hippodrome.control.certificates.rules import ACCOUNT, PRODUCTION, STAGING, RenewalRequest, location
from hippodrome.deployment.aws.account import Installation
from hippodrome.deployment.lifecycle import deploy
from hippodrome.deployment.stack import certificate, certificate_transfer
from tests.deployment.certificates import chain
from tests.deployment.lifecycle.test_destroy import TAG, buckets, make_bucket
from tests.deployment.stack_world import DOMAIN, REGION, World

FULLCHAIN, PRIVKEY, STATE = location(f"servers.{DOMAIN}")


class Authority:
    """A fake Let's Encrypt that records orders and their accounts."""

    def __init__(self) -> None:
        self.orders: list[str] = []
        self.accounts: list[str] = []
        self.days = 80.0

    def order(self, request: RenewalRequest, account: Mapping[str, Any], publish: Any, tell: Any) -> Issued:
        self.orders.append(request.directory)
        self.accounts.append(account["x"])
        key = ec.generate_private_key(ec.SECP256R1()).private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        pem = chain(f"*.{request.domain}", days=self.days)
        return Issued(key.decode(), pem.decode(), read_chain(pem, request.directory))

    @property
    def real(self) -> int:
        return self.orders.count(PRODUCTION)


@pytest.fixture
def authority(monkeypatch: pytest.MonkeyPatch) -> Authority:
    made = Authority()
    monkeypatch.setattr(order, "order", made.order)
    monkeypatch.setattr(certificate, "check", lambda *_, **__: None)
    return made


def installation(world: World, number: int, monkeypatch: pytest.MonkeyPatch, root: str = DOMAIN) -> Installation:
    """Return the number-th installation of the same name, with a bucket of its own."""
    bucket = f"hippodrome-bucket-{number}"
    if bucket not in buckets(world):
        make_bucket(world, bucket, TAG)
    outputs = dict.fromkeys(
        ("MaxRuntime", "Cluster", "Subnets", "SecurityGroup", "StartServerTopic", "StopServerTopic", "ScheduleGroup"),
        "1",
    )
    outputs |= {
        "ScheduleRole": "1",
        "Bucket": bucket,
        "RootDomain": root,
        "ServersHost": "servers",
        "HostedZoneId": world.zone,
    }
    found = Installation("hippodrome", REGION, "CREATE_COMPLETE", outputs)
    monkeypatch.setattr(deploy, "find_installation", lambda account, stack: found)
    monkeypatch.setattr(certificate, "find_installation", lambda account, stack: found)
    return found


def document(world: World, number: int, key: str) -> bytes:
    got = world.account.client("s3").get_object(Bucket=f"hippodrome-bucket-{number}", Key=key)
    return bytes(got["Body"].read())


def stored_serial(world: World, number: int) -> str:
    """Return the serial number of the stored certificate."""
    stored = order.read_stored(document(world, number, PRIVKEY))
    assert stored
    return stored.serial


def test_five_installations_in_succession_order_one_certificate(
    world: World, authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    for number in range(5):
        installation(world, number, monkeypatch)
        report = deploy.certify(world.account, "hippodrome")
        assert report.directory == PRODUCTION
        assert document(world, number, PRIVKEY) == document(world, 0, PRIVKEY)
        assert document(world, number, FULLCHAIN) == document(world, 0, FULLCHAIN)
        assert b"PRIVATE KEY" not in document(world, number, FULLCHAIN)
    assert authority.orders == [STAGING, PRODUCTION]


def test_the_installation_that_took_it_over_renews_it_with_the_same_account(
    world: World, authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    installation(world, 0, monkeypatch)
    deploy.certify(world.account, "hippodrome")
    second = installation(world, 1, monkeypatch)
    deploy.certify(world.account, "hippodrome")
    certificate.obtain(world.account, second, certificate.Choice(PRODUCTION, force=True))
    assert authority.real == 2
    assert len(set(authority.accounts[-2:])) == 1
    assert document(world, 1, ACCOUNT) == document(world, 0, ACCOUNT)
    assert document(world, 1, PRIVKEY) != document(world, 0, PRIVKEY)
    assert stored_serial(world, 1) in document(world, 1, STATE).decode()


@pytest.mark.parametrize("why", ["due", "another domain", "another installation", "untagged", "by hand"])
def test_certificates_that_are_not_fresh_or_not_ours_are_not_taken_over(
    world: World, authority: Authority, monkeypatch: pytest.MonkeyPatch, why: str
) -> None:
    authority.days = 20 if why == "due" else 80
    installation(world, 0, monkeypatch, "example.net" if why == "another domain" else DOMAIN)
    deploy.certify(world.account, "hippodrome")
    s3 = world.account.client("s3")
    if why == "another installation":
        other = [{"Key": "hippodrome:stack", "Value": "hippodrome-lab"}]
        s3.put_bucket_tagging(Bucket="hippodrome-bucket-0", Tagging={"TagSet": other})
    if why == "untagged":
        s3.delete_bucket_tagging(Bucket="hippodrome-bucket-0")
    if why == "by hand":
        body = document(world, 0, PRIVKEY).partition(b"\n")[2]
        s3.put_object(Bucket="hippodrome-bucket-0", Key=PRIVKEY, Body=body)
    second = installation(world, 1, monkeypatch)
    assert certificate_transfer.take_over(world.account, second) is None
    with pytest.raises(ClientError):
        document(world, 1, PRIVKEY)


def test_a_real_certificate_is_preferred_to_a_test_certificate(
    world: World, authority: Authority, monkeypatch: pytest.MonkeyPatch
) -> None:
    first = installation(world, 0, monkeypatch)
    certificate.obtain(world.account, first, certificate.Choice(PRODUCTION))
    authority.days = 85
    certificate.obtain(world.account, installation(world, 1, monkeypatch), certificate.Choice(STAGING))
    taken = certificate_transfer.take_over(world.account, installation(world, 2, monkeypatch))
    assert taken
    assert taken.directory == PRODUCTION


def test_an_existing_certificate_stays(world: World, authority: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
    first = installation(world, 0, monkeypatch)
    certificate.obtain(world.account, first, certificate.Choice(PRODUCTION))
    second = installation(world, 1, monkeypatch)
    certificate.obtain(world.account, second, certificate.Choice(STAGING))
    before = document(world, 1, PRIVKEY)
    assert certificate_transfer.take_over(world.account, second) is None
    assert document(world, 1, PRIVKEY) == before


def test_the_command_certificate_takes_it_over_and_a_dry_run_does_not(
    world: World, authority: Authority, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    certificate.obtain(world.account, installation(world, 0, monkeypatch), certificate.Choice(PRODUCTION))
    installation(world, 1, monkeypatch)
    monkeypatch.setattr(certificate, "open_account", lambda profile, region: world.account)
    assert cli.main(["certificate", "--production", "--dry-run"]) == Exit.CHANGES
    with pytest.raises(ClientError):
        document(world, 1, PRIVKEY)
    assert cli.main(["certificate", "--production"]) == Exit.DONE
    assert authority.real == 1
    assert "is taken over from the bucket hippodrome-bucket-0" in capsys.readouterr().err
