"""CloudFormation's messages for refused deletions, as people have reported them: after each, destroy finishes."""

from __future__ import annotations

import re

import pytest

from hippodrome.console.problem import Exit
from hippodrome.deployment.lifecycle.destroy import Removal
from hippodrome.deployment.stack.deletion import FAILURES, known_failure
from hippodrome.deployment.stack.stack import FailedResource
from testing.template import template
from tests.deployment.fake_cloudformation import Step
from tests.deployment.lifecycle.test_destroy import installed, run
from tests.deployment.stack_world import World

__all__ = ["installed"]
Capsys = pytest.CaptureFixture[str]

BUSY = "Rate exceeded (Service: Sqs, Status Code: 400) (HandlerErrorCode: Throttling)"
REPORTED = [  # the type, the message, and what is waited for; the source is beside each
    ("ECS::Cluster", "The Cluster cannot be deleted while Tasks are active.", "servers are stopped"),  # cloud-nuke 368
    ("ECS::Cluster", "The Cluster cannot be deleted while it contains Tasks.", "servers are stopped"),
    (
        "ECS::Cluster",  # aws-scalable-big-blue-button-example 79
        "Resource handler returned message: \"Error occurred during operation 'DeleteClusters SDK Error: The Cluster "
        "cannot be deleted while Container Instances are active or draining. (Service: AmazonECS; Error Code: "
        "ClusterContainsContainerInstancesException)'.\" (HandlerErrorCode: GeneralServiceException)",
        "servers are stopped",
    ),
    ("ECS::Cluster", "ClientException: Cluster was not ACTIVE.", "another operation"),  # terraform-provider-aws 11285
    (
        "EC2::Subnet",  # aws-cdk 14456
        "The subnet 'subnet-0d544dc539aeafb80' has dependencies and cannot be deleted. (Service: AmazonEC2; Status "
        "Code: 400; Error Code: DependencyViolation; Proxy: null)",
        "addresses of servers",
    ),
    ("EC2::VPC", "The vpc 'vpc-0ae35fcfa21404341' has dependencies and cannot be deleted.", "addresses of servers"),
    (
        "EC2::SecurityGroup",
        "resource sg-04eb9b4569cb59608 has a dependent object",
        "addresses of servers",
    ),  # aws-cdk 14456
    (
        "EC2::VPCGatewayAttachment",  # cloud-nuke 591, aws/eks-hybrid 703
        "Network vpc-00db40ad268a8758a has some mapped public address(es). Please unmap those public address(es) "
        "before detaching the gateway.",
        "addresses of servers",
    ),
    (
        "EC2::InternetGateway",
        "The internetGateway 'igw-1' has dependencies and cannot be deleted.",
        "addresses of servers",
    ),
    (
        "CertificateManager::Certificate",  # aws-cdk 36265
        "Certificate arn:aws:acm:ca-central-1:123456789012:certificate/1 in account 123456789012 is in use. "
        "(Service: Acm, Status Code: 400)",
        "dismantled the site's address",
    ),
    (
        "IAM::ManagedPolicy",
        "Cannot delete a policy attached to entities.",
        "policy is detached",
    ),  # terraform-provider 32906
    ("IAM::ManagedPolicy", "This policy has more than one version.", "policy is detached"),  # aws-iam-operator 13
    (
        "IAM::Role",
        "Cannot delete entity, must detach all policies first.",
        "foreign policies",
    ),  # aws-parallelcluster 4031
    ("IAM::Role", "Cannot delete entity, must delete policies first", "foreign policies"),  # convox/rack 2672
    (
        "ECR::Repository",  # brentley/appmeshworkshop 31
        "The repository with name 'x' in registry with id '1' cannot be deleted because it still contains images",
        "repository is empty",
    ),
    (
        "Route53::RecordSet",  # byu-oit/handel 486; the sentence is Route 53's own for NoSuchHostedZone
        "No hosted zone found with ID: Z0123456789ABCDEFGHIJ (Service: Route53, Status Code: 404, Request ID: 1)",
        "hosted zone, which is gone",
    ),
    ("SQS::Queue", BUSY, "less busy"),
    ("Logs::LogGroup", "A conflicting operation is currently in progress. Please try again.", "another operation"),
    ("IAM::Role", "Internal Failure", "less busy"),
]
FOR_PEOPLE = [
    ("SQS::Queue", "User: arn:aws:iam::1:user/a is not authorized to perform: sqs:DeleteQueue"),
    (
        "Logs::LogGroup",
        "User: arn:aws:iam::1:user/a is not authorized to perform: logs:DeleteLogGroup with an explicit deny",
    ),
    ("IAM::Role", "Cannot delete entity, must remove roles from instance profile first."),
    ("SNS::Topic", "The topic is in use"),
    ("Lambda::Function", "No hosted zone found with ID: Z0123456789ABCDEFGHIJ"),
]


def failure(kind: str, reason: str) -> FailedResource:
    return FailedResource("Thing", f"AWS::{kind}", "id", reason)


@pytest.mark.parametrize(("kind", "reason", "until"), REPORTED)
def test_after_each_reported_failure_destroy_finishes_and_leaves_nothing(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: Capsys, kind: str, reason: str, until: str
) -> None:
    refused: list[Step] = [
        ("DELETE_IN_PROGRESS", [("Thing", f"AWS::{kind}", "DELETE_FAILED", reason)]),
        ("DELETE_FAILED", []),
    ]
    installed.cloud.operations = [refused]
    assert run(installed, "--yes", "--data", monkeypatch=monkeypatch) == Exit.DONE
    assert until in capsys.readouterr().err
    assert installed.cloud.stack
    assert installed.cloud.stack["StackStatus"] == "DELETE_COMPLETE"
    assert not Removal(installed.account, "hippodrome").look().to_do(data=True)


def test_every_row_of_the_table_is_replayed() -> None:
    assert {known_failure(failure(kind, reason)) for kind, reason, _ in REPORTED} == set(FAILURES)


@pytest.mark.parametrize(("kind", "reason"), FOR_PEOPLE)
def test_failures_that_need_a_person_are_not_waited_for(
    installed: World, monkeypatch: pytest.MonkeyPatch, capsys: Capsys, kind: str, reason: str
) -> None:
    events = [("Thing", f"AWS::{kind}", "DELETE_FAILED", reason), ("Other", "AWS::SQS::Queue", "DELETE_FAILED", BUSY)]
    installed.cloud.operations = [[("DELETE_IN_PROGRESS", events), ("DELETE_FAILED", [])]]
    assert run(installed, "--yes", monkeypatch=monkeypatch) == Exit.FAILED
    assert reason in capsys.readouterr().err
    assert len(installed.cloud.called("delete_stack")) == 1


def test_every_line_of_the_table_is_about_a_type_of_the_template_and_has_a_source() -> None:
    types = {one["Type"] for one in template()["Resources"].values()}
    for known in FAILURES:
        assert not known.types or any(re.fullmatch(known.types, type_) for type_ in types), known
        assert known.source
