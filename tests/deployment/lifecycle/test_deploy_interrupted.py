"""up: after Ctrl-C at any call of AWS, the same command completes the installation, and makes nothing twice."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from hippodrome import cli
from hippodrome.console.problem import Exit
from hippodrome.deployment.lifecycle import deploy
from testing.exploration import sample
from tests.deployment.fake_cloudformation import happy
from tests.deployment.registering import write_study
from tests.deployment.stack_world import DOMAIN, World


class InterruptedClient:
    """A client whose calls are counted with those of all other clients, and interrupted at one of them."""

    def __init__(self, client: Any, called: Callable[[str], Iterator[None]]) -> None:
        self._client, self._called = client, called

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._client, name)
        if not callable(found) or name.startswith("_") or name in {"get_paginator", "get_waiter"}:
            return found

        def call(*arguments: Any, **named: Any) -> Any:
            around = self._called(name)
            next(around)
            try:
                return found(*arguments, **named)
            finally:
                next(around, None)

        return call


class CtrlC:
    """Ctrl-C at the n-th call of AWS: before the call, or after AWS has executed it."""

    def __init__(self) -> None:
        self.at, self.afterwards = -1, False
        self.calls: list[str] = []

    def called(self, name: str) -> Iterator[None]:
        number = len(self.calls)
        self.calls.append(name)
        if number == self.at and not self.afterwards:
            raise KeyboardInterrupt
        yield
        if number == self.at:
            raise KeyboardInterrupt


@pytest.fixture
def ctrl_c(world: World, monkeypatch: pytest.MonkeyPatch) -> CtrlC:
    ctrl_c = CtrlC()
    plain = world.account.client
    monkeypatch.setattr(world.account, "client", lambda *where: InterruptedClient(plain(*where), ctrl_c.called))
    monkeypatch.setattr(deploy, "open_account", lambda profile, region: world.account)
    return ctrl_c


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_study(tmp_path / "study")


@pytest.fixture
def deploy_study(world: World, ctrl_c: CtrlC, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Runs `make deploy` of a study. One call each stands for certificate and registration, which have tests of their own."""

    def mark(what: str) -> Any:
        s3 = world.account.client("s3")
        return s3.put_object(Bucket=world.code_bucket, Key=what, Body=b"done")

    monkeypatch.setattr(deploy, "_certify", lambda *_: mark("certificate"))
    monkeypatch.setattr(deploy.register, "command", lambda *_, **__: Exit.DONE if mark("registered") else Exit.FAILED)
    return lambda: cli.main(["deploy", str(folder), "--domain", DOMAIN, "--email", "me@example.org"])


def assert_whole(world: World) -> None:
    plain = type(world.account).client
    s3, stack = plain(world.account, "s3"), world.cloud.stack
    assert stack is not None
    assert stack["StackStatus"] in {"CREATE_COMPLETE", "UPDATE_COMPLETE"}
    assert {one["ParameterKey"]: one["ParameterValue"] for one in stack["Parameters"]} == world.parameters(
        AlarmEmail="me@example.org"
    )
    assert world.cloud.change_sets == {}, "no change set is left"
    assert [one["Name"] for one in s3.list_buckets()["Buckets"]] == [world.code_bucket]
    assert s3.get_bucket_tagging(Bucket=world.code_bucket)["TagSet"]
    assert "TlsOnly" in json.dumps(s3.get_bucket_policy(Bucket=world.code_bucket))
    keys = [one["Key"] for one in s3.list_objects_v2(Bucket=world.code_bucket)["Contents"]]
    assert len(keys) == 5, "two functions, a template, the certificate, the registered study"
    assert {"certificate", "registered"} <= set(keys)
    assert len(plain(world.account, "iam").list_roles()["Roles"]) == 1


def check_every_interruption(
    world: World, ctrl_c: CtrlC, deploy_study: Callable[[], int], afterwards: bool, before: Callable[[], None]
) -> None:
    """Interrupt the command at its n-th call and run it again, for every n (in `make test` one of twelve)."""
    before()
    assert deploy_study() == Exit.DONE
    assert_whole(world)
    assert len(ctrl_c.calls) > 30
    for n in sample(range(len(ctrl_c.calls)), 12):
        empty_account(world)
        before()
        ctrl_c.at, ctrl_c.afterwards = n, afterwards
        ctrl_c.calls.clear()
        assert deploy_study() == Exit.INTERRUPTED, (n, ctrl_c.calls)
        ctrl_c.at = -1
        world.cloud.text = world.cloud.text or world.built.text
        assert deploy_study() == Exit.DONE, (n, ctrl_c.calls)
        assert_whole(world)


def empty_account(world: World) -> None:
    """Remove everything from the account."""
    plain = type(world.account).client
    s3, iam = plain(world.account, "s3"), plain(world.account, "iam")
    for bucket in s3.list_buckets()["Buckets"]:
        for one in s3.list_objects_v2(Bucket=bucket["Name"]).get("Contents", ()):
            s3.delete_object(Bucket=bucket["Name"], Key=one["Key"])
        s3.delete_bucket_tagging(Bucket=bucket["Name"])  # Gap: moto keeps the tags of a deleted bucket
        s3.delete_bucket(Bucket=bucket["Name"])
    for role in iam.list_roles()["Roles"]:
        iam.delete_role(RoleName=role["RoleName"])
    world.account.__dict__.pop("identity", None)
    cloud = world.cloud
    cloud.stack, cloud.text, cloud.script, cloud.operations = None, "", [], []
    cloud.events.clear()
    cloud.change_sets.clear()


@pytest.mark.explores
@pytest.mark.parametrize("afterwards", [False, True], ids=["before the call", "after it"])
def test_ctrl_c_at_any_call_and_the_same_command_again(
    world: World, ctrl_c: CtrlC, deploy_study: Callable[[], int], afterwards: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    check_every_interruption(world, ctrl_c, deploy_study, afterwards, lambda: None)
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.explores
def test_ctrl_c_while_a_failed_creation_is_removed_and_the_same_command_again(
    world: World, ctrl_c: CtrlC, deploy_study: Callable[[], int], capsys: pytest.CaptureFixture[str]
) -> None:
    def failed() -> None:
        world.stand("ROLLBACK_COMPLETE")
        world.cloud.operations = [happy("DELETE")]

    check_every_interruption(world, ctrl_c, deploy_study, False, failed)
    assert "Traceback" not in capsys.readouterr().err
