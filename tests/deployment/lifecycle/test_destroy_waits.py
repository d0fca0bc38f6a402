"""destroy when AWS refuses for a while: what it waits for, what it removes first, and that it finishes."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import pytest
from botocore.client import BaseClient

from hippodrome.console.problem import Exit, Problem
from hippodrome.control.model import ids
from hippodrome.deployment.lifecycle.apply import apply
from hippodrome.deployment.lifecycle.destroy import Removal
from hippodrome.deployment.stack import inventory
from hippodrome.deployment.stack.code_bucket import CodeBucket
from hippodrome.deployment.stack.settings import StackSettings
from testing.exploration import sample
from tests.deployment.fake_cloudformation import FakeCloudFormation, invalid, refusal
from tests.deployment.lifecycle.test_destroy import DATA, buckets, families, installed, run
from tests.deployment.real_stack import (
    POLICY,
    SITE,
    Clock,
    RealStack,
    put_cname,
    request_certificate,
    same_record,
    zone_records,
)
from tests.deployment.stack_world import ACCOUNT, DOMAIN, REGION, World

__all__ = ["installed"]


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch, world: World) -> Clock:
    made = Clock()
    monkeypatch.setattr(time, "sleep", made.sleep)
    return made


@pytest.fixture
def stack(installed: World, clock: Clock) -> RealStack:
    return RealStack(installed, clock)


def test_destroy_waits_for_everything_that_aws_refuses_for_a_while(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stack.in_use = 40 * 60
    stack.attach("ada", "lab", "guest")
    stack.add_interface(600)
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert stack.cloud.stack
    assert stack.cloud.stack["StackStatus"] == "DELETE_COMPLETE"
    assert zone_records(stack.world) == set()
    said = capsys.readouterr().err
    assert "This has to wait until" in said
    assert "10 to 60 minutes" in said
    assert "is detached from the user ada, the group lab, the role guest" in said
    assert "Nothing else is left" in said
    assert 40 * 60 <= stack.clock.slept < 60 * 60


# -- the certificate


def test_a_certificate_that_stays_in_use_is_reported_and_another_run_finishes(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stack.in_use = 100 * 60
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.FAILED
    said = capsys.readouterr().err
    assert "After 75 min AWS still refuses to delete SiteCertificate" in said
    assert "Run the same command later" in said
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert zone_records(stack.world) == set()


def test_a_certificate_that_is_refused_although_nothing_uses_it_is_tried_again(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    stack.in_use = 0
    stack.refused_until = stack.clock.time + timedelta(minutes=20)
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert 20 * 60 <= stack.clock.slept < 25 * 60


@pytest.mark.parametrize(
    ("domain", "region"), [(SITE, "us-east-1"), (f"*.{SITE}", REGION)], ids=["another region", "a wildcard"]
)
def test_a_validation_record_that_another_certificate_needs_stays_and_is_reported(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], domain: str, region: str
) -> None:
    other = request_certificate(stack.world, domain, region)
    same_record(stack.world, other, stack.certificate, region)
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert zone_records(stack.world) == {(stack.record, "CNAME")}
    said = capsys.readouterr()
    assert f"it renews {other}" in said.err.replace(" as well", "")
    assert "aws route53 change-resource-record-sets" in said.err
    assert "Nothing else is left" in said.err


def test_a_certificate_for_another_name_does_not_keep_our_record(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    request_certificate(stack.world, f"other.{DOMAIN}", "us-east-1")
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert zone_records(stack.world) == set()


def test_the_record_stays_if_a_region_refuses_to_list_certificates(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    acm = stack.world.account.client("acm", "eu-west-3")

    def denied(_: str) -> Any:
        raise refusal("ListCertificates", "AccessDeniedException", "with an explicit deny in a service control policy")

    monkeypatch.setattr(acm, "get_paginator", denied)
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert zone_records(stack.world) == {(stack.record, "CNAME")}
    assert "whatever is in eu-west-3" in capsys.readouterr().err


def test_a_validation_record_with_another_value_is_left_alone(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    put_cname(stack.world, stack.record, "somewhere.example.net.")
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert zone_records(stack.world) == {(stack.record, "CNAME")}


def test_the_record_of_a_stack_that_was_deleted_by_hand_is_reported(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stack.client("acm").delete_certificate(CertificateArn=stack.certificate)
    stack.world.cloud.stack |= {"StackStatus": "DELETE_COMPLETE"}  # type: ignore[operator]
    stack.cloud.resources = [stack.cloud.resources[0]]
    assert run(stack.world, "--yes", "--json", monkeypatch=monkeypatch) == Exit.DONE
    said = json.loads(capsys.readouterr().out)
    assert [one["name"] for one in said["records"]] == [stack.record.rstrip(".")]
    assert "may prove the name for another AWS account" in said["records"][0]["why"]


# -- the policy


def test_a_deleted_hosted_zone_does_not_stop_destroy(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """CloudFormation cannot delete the site's records, which are gone with the zone; destroy deletes the rest without them."""
    stack.delete_zone()
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert stack.cloud.stack
    assert stack.cloud.stack["StackStatus"] == "DELETE_COMPLETE"
    assert [one["RetainResources"] for one in stack.cloud.called("delete_stack") if "RetainResources" in one] == [
        ["SiteRecord"]
    ]
    assert "the hosted zone, which is gone" in capsys.readouterr().err


def test_an_edited_policy_and_a_role_with_more_policies_do_not_stop_destroy(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch
) -> None:
    iam = stack.client("iam")
    iam.create_policy_version(PolicyArn=stack.policy, PolicyDocument=POLICY, SetAsDefault=True)
    foreign = iam.create_policy(PolicyName="audit", PolicyDocument=POLICY)["Policy"]["Arn"]
    iam.attach_role_policy(RoleName=stack.role, PolicyArn=foreign)
    iam.put_role_policy(RoleName=stack.role, PolicyName="more", PolicyDocument=POLICY)
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert iam.get_policy(PolicyArn=foreign)["Policy"]["Arn"] == foreign


# -- the network


def test_network_interfaces_that_stay_are_named(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stack.add_interface(10**9)
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.FAILED
    assert "After 25 min AWS still refuses to delete SubnetA" in capsys.readouterr().err


def test_what_guardduty_has_put_into_the_network_is_removed(stack: RealStack, monkeypatch: pytest.MonkeyPatch) -> None:
    ec2 = stack.client("ec2")
    vpc = ec2.describe_subnets(SubnetIds=[stack.subnet])["Subnets"][0]["VpcId"]
    service = f"com.amazonaws.{REGION}.guardduty-data"
    ec2.create_vpc_endpoint(VpcId=vpc, ServiceName=service, VpcEndpointType="Interface", SubnetIds=[stack.subnet])
    name = f"GuardDutyManagedSecurityGroup-{vpc}"
    ec2.create_security_group(GroupName=name, Description="Associated with GuardDuty's endpoint", VpcId=vpc)
    stack.add_interface(60)
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    (endpoint,) = [one for one in ec2.describe_vpc_endpoints()["VpcEndpoints"] if one["ServiceName"] == service]
    assert endpoint["State"] == "deleted"
    assert [one for one in ec2.describe_security_groups()["SecurityGroups"] if one["GroupName"] == name] == []


# -- creating it again


def test_apply_waits_until_the_names_of_deleted_queues_are_free(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    stack.in_use = 0
    removal = Removal(stack.world.account, "hippodrome")
    removal.run(removal.look(), data=False)
    gone = stack.clock.time

    def taken() -> list[dict[str, str]]:
        kept = (stack.clock.time - gone).total_seconds() < 60
        return [invalid("StartQueue", "hippodrome-start already exists")] if kept else []

    stack.cloud.validation = taken  # CloudFormation validates when it makes the change set
    outcome = apply(stack.world.account, "hippodrome", StackSettings(domain=DOMAIN))
    assert outcome.changed
    assert 60 <= (stack.clock.time - gone).total_seconds() <= 80
    assert "AWS keeps the names of deleted queues" in capsys.readouterr().err


def test_timers_that_are_still_being_deleted_are_waited_for(
    world: World, clock: Clock, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def get(Name: str) -> dict[str, str]:
        return {"Name": Name, "State": "DELETING" if clock.slept < 30 else "ACTIVE"}

    taken = invalid("ScheduleGroup", "hippodrome already exists")
    world.cloud.validation = lambda: [taken] if clock.slept < 30 else []
    monkeypatch.setattr(world.account.client("scheduler"), "get_schedule_group", get, raising=False)
    assert apply(world.account, "hippodrome", StackSettings(domain=DOMAIN)).changed
    assert clock.slept == 30
    assert "still deleting the timers" in capsys.readouterr().err


def test_queues_that_were_deleted_over_a_minute_ago_are_not_waited_for(
    stack: RealStack, capsys: pytest.CaptureFixture[str]
) -> None:
    stack.in_use = 0
    removal = Removal(stack.world.account, "hippodrome")
    removal.run(removal.look(), data=False)
    assert stack.cloud.stack
    stack.cloud.stack["DeletionTime"] -= timedelta(seconds=stack.clock.slept + 70)
    stack.clock.sleep(70)
    assert apply(stack.world.account, "hippodrome", StackSettings(domain=DOMAIN)).changed
    assert "AWS keeps the names" not in capsys.readouterr().err


def test_a_code_bucket_that_s3_is_still_deleting_is_waited_for(
    world: World, clock: Clock, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bucket = CodeBucket(world.account, "hippodrome")
    s3 = world.account.client("s3")
    create = s3.create_bucket

    def refusing(**arguments: Any) -> Any:
        if clock.slept < 90:
            raise refusal("CreateBucket", "OperationAborted", "A conflicting conditional operation is currently in pr")
        return create(**arguments)

    monkeypatch.setattr(s3, "create_bucket", refusing, raising=False)
    assert bucket.make()
    assert clock.slept == 90
    assert "S3 is still deleting the bucket" in capsys.readouterr().err
    assert buckets(world) == {bucket.name}


SETTINGS = (
    "put_public_access_block",
    "put_bucket_encryption",
    "put_bucket_policy",
    "put_bucket_lifecycle_configuration",
    "put_bucket_tagging",
)


@pytest.mark.parametrize("setting", SETTINGS)
def test_apply_waits_until_s3_takes_settings_of_a_new_code_bucket(
    world: World, clock: Clock, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], setting: str
) -> None:
    bucket = CodeBucket(world.account, "hippodrome")
    s3 = world.account.client("s3")
    settle = getattr(s3, setting)

    def refusing(**arguments: Any) -> Any:
        if clock.slept < 60:
            raise refusal(setting, "OperationAborted", "A conflicting conditional operation is currently in progress")
        return settle(**arguments)

    monkeypatch.setattr(s3, setting, refusing, raising=False)
    assert bucket.make()
    assert clock.slept == 60
    assert "S3 is still at work on the new bucket" in capsys.readouterr().err
    assert not bucket.make()  # all settings are set


def test_a_code_bucket_that_s3_never_finishes_is_reported(
    world: World, clock: Clock, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refusing(**_: Any) -> Any:
        raise refusal("PutBucketPolicy", "OperationAborted", "A conflicting conditional operation is in progress")

    monkeypatch.setattr(world.account.client("s3"), "put_bucket_policy", refusing, raising=False)
    with pytest.raises(Problem, match="still at work"):
        CodeBucket(world.account, "hippodrome").make()


def test_apply_waits_for_the_remains_of_a_failed_creation(stack: RealStack, capsys: pytest.CaptureFixture[str]) -> None:
    assert stack.cloud.stack
    stack.in_use = 40 * 60
    stack.cloud.stack["StackStatus"] = "ROLLBACK_FAILED"
    for group in inventory.log_groups(stack.world.account, "hippodrome"):
        stack.client("logs").delete_log_group(logGroupName=group)
    outcome = apply(stack.world.account, "hippodrome", StackSettings(domain=DOMAIN))
    assert outcome.changed
    assert stack.clock.slept >= 40 * 60
    assert "10 to 60 minutes" in capsys.readouterr().err


def test_dns_names_of_servers_without_a_record_are_reported(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name = f"{ids.server_name(ids.server_label('study', 'u1'), 1)}.servers.{DOMAIN}"
    record = {"Name": name, "Type": "A", "TTL": 60, "ResourceRecords": [{"Value": "192.0.2.1"}]}
    change = {"Changes": [{"Action": "UPSERT", "ResourceRecordSet": record}]}
    stack.client("route53").change_resource_record_sets(HostedZoneId=stack.world.zone, ChangeBatch=change)
    assert run(stack.world, "--yes", "--json", monkeypatch=monkeypatch) == Exit.DONE
    said = capsys.readouterr()
    assert json.loads(said.out)["serverNames"] == [name]
    assert "another installation's with the same domain, or left over" in said.err


# -- states, and what is not waited for


def test_a_protected_stack_is_left_alone(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    assert stack.cloud.stack
    stack.cloud.stack["EnableTerminationProtection"] = True
    stack.attach(user="ada")
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.FAILED
    assert "--no-enable-termination-protection --stack-name hippodrome" in capsys.readouterr().err
    assert not stack.cloud.called("delete_stack")
    assert stack.client("iam").list_attached_user_policies(UserName="ada")["AttachedPolicies"]


STANDS = (
    "CREATE_FAILED",
    "ROLLBACK_COMPLETE",
    "ROLLBACK_FAILED",
    "UPDATE_COMPLETE",
    "UPDATE_FAILED",
    "UPDATE_ROLLBACK_COMPLETE",
    "UPDATE_ROLLBACK_FAILED",
    "IMPORT_ROLLBACK_COMPLETE",
    "DELETE_FAILED",
    "CREATE_IN_PROGRESS",
)


@pytest.mark.explores
@pytest.mark.parametrize("status", sample(STANDS, 3))
def test_a_stack_in_any_state_is_deleted(stack: RealStack, monkeypatch: pytest.MonkeyPatch, status: str) -> None:
    assert stack.cloud.stack
    stack.in_use = 0
    stack.cloud.stack["StackStatus"] = status
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert stack.cloud.stack["StackStatus"] == "DELETE_COMPLETE"
    assert zone_records(stack.world) == set()


GOES_ON = (
    ("UPDATE_IN_PROGRESS", "UPDATE_COMPLETE"),
    ("UPDATE_COMPLETE_CLEANUP_IN_PROGRESS", "UPDATE_COMPLETE"),
    ("ROLLBACK_IN_PROGRESS", "ROLLBACK_COMPLETE"),
    ("UPDATE_ROLLBACK_IN_PROGRESS", "UPDATE_ROLLBACK_FAILED"),
    ("DELETE_IN_PROGRESS", "DELETE_FAILED"),
)


@pytest.mark.explores
@pytest.mark.parametrize(("status", "then"), sample(GOES_ON, 3))
def test_destroy_first_waits_for_an_operation_in_progress(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], status: str, then: str
) -> None:
    assert stack.cloud.stack
    stack.in_use = 0
    stack.cloud.stack["StackStatus"] = status
    stack.cloud.script = [*[(status, [])] * 6, (then, [])]
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert stack.cloud.stack["StackStatus"] == "DELETE_COMPLETE"
    assert "waiting for that first" in capsys.readouterr().err


def test_destroy_waits_for_an_update_that_begins_meanwhile(stack: RealStack, monkeypatch: pytest.MonkeyPatch) -> None:
    delete = stack.cloud.delete_stack

    def late(**arguments: Any) -> Any:
        if len(stack.cloud.called("delete_stack")) == 0 and stack.cloud.stack:
            stack.cloud.stack["StackStatus"] = "UPDATE_IN_PROGRESS"
            stack.cloud.script = [("UPDATE_IN_PROGRESS", [])] * 3 + [("UPDATE_COMPLETE", [])]
        return delete(**arguments)

    stack.in_use = 0
    monkeypatch.setattr(stack.cloud, "delete_stack", late)
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE


def test_destroy_names_another_region_with_an_installation(
    world: World, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    name = f"hippodrome-code-{ACCOUNT}-eu-west-1"
    s3 = world.account.client("s3", "eu-west-1")
    s3.create_bucket(Bucket=name, CreateBucketConfiguration={"LocationConstraint": "eu-west-1"})
    assert run(world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    said = capsys.readouterr()
    assert f"There is nothing of hippodrome in {REGION}." in said.out
    assert "Something of that name is in another region: say AWS_REGION=eu-west-1." in said.err
    assert buckets(world) == {name}


# -- interrupted


class CtrlC:
    """Ctrl-C at the n-th call of AWS, before the call or after it."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, cloud: FakeCloudFormation, clock: Clock) -> None:
        self.clock, self.thread = clock, threading.current_thread()
        self.at, self.before, self.calls = 10**9, True, 0
        call = BaseClient._make_api_call

        def make(client: Any, operation: str, arguments: Any) -> Any:
            return self.count(lambda: call(client, operation, arguments))

        monkeypatch.setattr(BaseClient, "_make_api_call", make)
        for name in ("describe_stacks", "describe_stack_events", "list_stack_resources", "list_stacks", "delete_stack"):
            real = getattr(cloud, name)
            monkeypatch.setattr(cloud, name, lambda real=real, **a: self.count(lambda: real(**a)))

    def count(self, act: Callable[[], Any]) -> Any:
        if self.clock.aws or threading.current_thread() is not self.thread:  # Ctrl-C interrupts only the main thread
            return act()
        self.calls += 1
        now = self.calls == self.at
        if now and self.before:
            raise KeyboardInterrupt
        try:
            return act()
        finally:
            if now:  # whether the answer is a result or an error
                raise KeyboardInterrupt


@pytest.mark.explores
@pytest.mark.parametrize("before", [True, False], ids=["before", "after"])
@pytest.mark.parametrize("at", sample(range(1, 181, 4), 40))
def test_interrupted_at_any_call_the_next_run_ends_clean(
    stack: RealStack, monkeypatch: pytest.MonkeyPatch, at: int, before: bool
) -> None:
    stack.attach("ada", "lab")
    stack.add_interface(60)
    stack.client("s3").put_object(Bucket=DATA, Key="SSL/fullchain.pem", Body=b"x")
    ctrl = CtrlC(monkeypatch, stack.cloud, stack.clock)
    ctrl.at, ctrl.before = at, before
    first = run(stack.world, "--yes", monkeypatch=monkeypatch)
    assert first == (Exit.INTERRUPTED if ctrl.calls >= at else Exit.DONE)
    ctrl.at = 10**9
    assert run(stack.world, "--yes", monkeypatch=monkeypatch) == Exit.DONE
    assert stack.cloud.stack
    assert stack.cloud.stack["StackStatus"] == "DELETE_COMPLETE"
    assert zone_records(stack.world) == set()
    assert buckets(stack.world) == {DATA}
    assert families(stack.world) == {"hippodrome-lab-study", "hippodrome-untagged"}
