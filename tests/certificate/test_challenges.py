"""The challenge's TXT record in Route 53 (moto, with `MotoWorld`'s strictness about what a DELETE must say)."""

import boto3
import pytest
from botocore.exceptions import ClientError
from botocore.stub import Stubber

from hippodrome.control.aws.challenges import Route53Challenges
from hippodrome.control.certificates.rules import FailureReason, OrderFailed

NAME = "_acme-challenge.example.org"
VALUE = "19MF_VkGpxclfMNKZvHf2MT88F4ajEaYxJiNGapvGpI"


def txt(world):
    records = world.client("route53").list_resource_record_sets(HostedZoneId=world.ids["zone"])["ResourceRecordSets"]
    return {r["Name"]: [v["Value"] for v in r["ResourceRecords"]] for r in records if r["Type"] == "TXT"}


def test_a_record_is_put_and_removed(moto_world):
    challenges = moto_world.platform.challenges
    challenges.put(NAME, [VALUE], 60)
    assert txt(moto_world) == {f"{NAME}.": [f'"{VALUE}"']}
    challenges.remove(NAME, [VALUE])
    assert txt(moto_world) == {}
    challenges.remove(NAME, [VALUE])
    assert set(moto_world.actions) == {"route53:ChangeResourceRecordSets", "route53:GetChange"}


def test_the_functions_changes_are_those_that_its_role_allows(moto_world):
    """The role in infra/template.yml allows UPSERT and DELETE of TXT records at one name."""
    moto_world.platform.challenges.put(NAME, [VALUE, "second", VALUE], 60)
    moto_world.platform.challenges.remove(NAME, [VALUE, "second"])
    changes = [
        change
        for call in moto_world.calls
        if call.operation == "ChangeResourceRecordSets"
        for change in call.params["ChangeBatch"]["Changes"]
    ]
    assert [change["Action"] for change in changes] == ["UPSERT", "DELETE"]
    assert {(c["ResourceRecordSet"]["Name"], c["ResourceRecordSet"]["Type"]) for c in changes} == {(NAME, "TXT")}
    assert txt(moto_world) == {}


def test_a_record_with_values_of_others_is_not_removed(moto_world):
    moto_world.platform.challenges.put(NAME, ["theirs"], 60)
    moto_world.platform.challenges.remove(NAME, [VALUE])
    assert txt(moto_world) == {f"{NAME}.": ['"theirs"']}


def test_put_waits_until_the_name_servers_have_the_record(moto_world):
    slept = []

    def sleep(seconds):
        slept.append(seconds)
        moto_world.in_sync = len(slept) == 3

    moto_world.in_sync = False
    client = moto_world.platform._client
    Route53Challenges(lambda: client("route53"), moto_world.env.__getitem__, sleep).put(NAME, [VALUE], 60)
    assert len(slept) == 3


def test_put_waits_for_the_name_servers_for_a_limited_time(moto_world):
    moto_world.in_sync = False
    client = moto_world.platform._client
    challenges = Route53Challenges(
        lambda: client("route53"), moto_world.env.__getitem__, lambda _: pytest.fail("slept")
    )
    with pytest.raises(OrderFailed) as failed:
        challenges.put(NAME, [VALUE], 1)
    assert failed.value.reason is FailureReason.TIMEOUT


@pytest.mark.parametrize("code", ["InvalidChangeBatch", "NoSuchHostedZone"])
def test_a_refused_record_is_a_failure_of_dns(moto_world, code):
    moto_world.fail("route53:ChangeResourceRecordSets", code)
    with pytest.raises(OrderFailed) as failed:
        moto_world.platform.challenges.put(NAME, [VALUE], 60)
    assert failed.value.reason is FailureReason.DNS


def test_the_reason_why_route_53_refuses_a_record_is_told():
    client, sentence = boto3.client("route53", region_name="eu-central-1"), "a conflicting RRSet of type CNAME exists"
    with Stubber(client) as stub:
        stub.add_client_error("change_resource_record_sets", "InvalidChangeBatch", f"[{sentence}]")
        with pytest.raises(OrderFailed, match=rf"refuses the TXT record {NAME}: .*{sentence}"):
            Route53Challenges(lambda: client, lambda _: "Z1").put(NAME, [VALUE], 60)


def test_a_missing_right_is_raised_unchanged(moto_world):
    moto_world.fail("route53:ChangeResourceRecordSets", "AccessDenied", times=2)
    for act in (lambda c: c.put(NAME, [VALUE], 60), lambda c: c.remove(NAME, [VALUE])):
        with pytest.raises(ClientError, match="AccessDenied"):
            act(moto_world.platform.challenges)
