"""The account: clients for many threads, and where region and credentials come from."""

from __future__ import annotations

import json
import os
import shlex
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import botocore.credentials
import botocore.session
import pytest
from moto import mock_aws

from hippodrome.console.problem import Problem
from hippodrome.deployment.aws.account import Installation, open_account

OUTPUTS = (
    "Bucket HostedZoneId RootDomain ServersHost MaxRuntime Cluster Subnets SecurityGroup StartServerTopic StopServerTopic "
    "ScheduleGroup ScheduleRole"
)
HANDED_ON = {
    "Version": 1,
    "AccessKeyId": "ASIAEXAMPLE",
    "SecretAccessKey": "secret",
    "SessionToken": "token",
    "Expiration": "2999-01-01T00:00:00Z",
}
SERVICES = ("s3", "ecs", "sqs", "sns", "logs", "lambda")


@pytest.fixture(autouse=True)
def credentials(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_PROFILE", "AWS_REGION", "AWS_DEFAULT_REGION"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_CONFIG_FILE", "/nonexistent")
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "testing")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "testing")


def test_missing_credentials_and_a_missing_region_are_reported_together(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nonexistent")
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    with pytest.raises(Problem) as caught:
        open_account()
    assert str(caught.value) == "No AWS region is set. There are no AWS credentials on this machine."
    assert "--region" in caught.value.advice
    assert "aws sso login" in caught.value.advice


@pytest.mark.parametrize(("chosen", "profile"), [(None, "default"), ("lab", "lab")])
def test_the_advice_on_credentials_of_aws_login_works(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, chosen: str | None, profile: str
) -> None:
    """The test follows the advice, with a command that prints credentials as AWS's command line does."""
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setattr(botocore.credentials, "EC", None)  # without the package awscrt
    config = tmp_path / "config"
    section = "default" if profile == "default" else f"profile {profile}"
    config.write_text(f"[{section}]\nregion = ca-central-1\nlogin_session = arn:aws:iam::123456789012:user/ada\n")
    monkeypatch.setenv("AWS_CONFIG_FILE", str(config))
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "none"))
    with pytest.raises(Problem, match=f"The profile {profile} is of `aws login`, whose") as caught:
        open_account(chosen)
    advised, export = map(shlex.split, caught.value.details)
    *begins, key, command, _, name = advised
    assert (begins, name, export) == (["aws", "configure", "set"], "hippodrome", ["export", "AWS_PROFILE=hippodrome"])
    assert command == f"aws configure export-credentials --profile {profile} --format process"
    config.write_text(f"{config.read_text()}[profile hippodrome]\nregion = ca-central-1\n{key} = {command}\n")
    aws = tmp_path / "aws"
    aws.write_text(f"#!/bin/sh\ntest \"$4\" = {profile} || exit 1\necho '{json.dumps(HANDED_ON)}'\n")
    aws.chmod(0o755)
    monkeypatch.setenv("PATH", str(tmp_path), prepend=os.pathsep)
    monkeypatch.setenv("AWS_PROFILE", "hippodrome")
    found = open_account()._core.get_credentials()
    assert found is not None
    assert found.get_frozen_credentials().access_key == HANDED_ON["AccessKeyId"]


def test_each_client_is_made_once_and_one_after_another(monkeypatch: pytest.MonkeyPatch) -> None:
    """botocore's sessions are not thread-safe, and the commands make requests in several threads."""
    under_way, most, made = 0, 0, []
    counting = threading.Lock()
    real = botocore.session.Session.create_client

    def slow(self: Any, service: str, *arguments: Any, **options: Any) -> Any:
        nonlocal under_way, most
        with counting:
            under_way += 1
            most = max(most, under_way)
            made.append(service)
        time.sleep(0.01)
        try:
            return real(self, service, *arguments, **options)
        finally:
            with counting:
                under_way -= 1

    monkeypatch.setattr(botocore.session.Session, "create_client", slow)
    account = open_account(region="ca-central-1")
    platform = account.platform(
        Installation("hippodrome", "ca-central-1", "CREATE_COMPLETE", dict.fromkeys(OUTPUTS.split(), "x"))
    )
    with mock_aws(), ThreadPoolExecutor(12) as pool:
        found = [pool.submit(account.client, service) for service in SERVICES * 2]
        pool.submit(platform.documents.get, "no-such-key")
        clients = [one.result() for one in found]
    assert most == 1
    assert clients[: len(SERVICES)] == clients[len(SERVICES) :]
    assert sorted(made) == sorted([*SERVICES, "s3"])  # the platform makes a client of its own, with shorter timeouts


def test_the_region_comes_from_the_option_or_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(Problem, match="No AWS region"):
        open_account()
    monkeypatch.setenv("AWS_DEFAULT_REGION", "eu-west-1")
    assert open_account().region == "eu-west-1"
    monkeypatch.setenv("AWS_REGION", "ca-central-1")
    assert open_account().region == "ca-central-1"
    assert open_account(region="us-east-1").client("s3").meta.region_name == "us-east-1"


def test_a_missing_profile_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    (tmp_path / "config").write_text("[profile lab]\nregion = eu-west-1\n[default]\n")
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "config"))
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nonexistent")
    with pytest.raises(Problem, match="no AWS profile named nobody") as said:
        open_account("nobody", "eu-west-1")
    assert "default, lab" in said.value.advice
    monkeypatch.setenv("AWS_PROFILE", "nobody")
    for region in (None, "eu-west-1"):
        with pytest.raises(Problem, match="no AWS profile named nobody"):
            open_account(None, region)
