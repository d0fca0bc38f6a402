"""CloudFormation's messages for refused deletions, as people have reported them, and the remedy for each."""

from __future__ import annotations

import re

import pytest

from hippodrome.deployment.stack.deletion_failures import TABLE, Recovery, recoveries, recovery_from
from hippodrome.deployment.stack.stack import FailedResource
from testing.template import template

REPORTED = [  # the type, the message, the remedy; the source is beside each
    ("ECS::Cluster", "The Cluster cannot be deleted while Tasks are active.", Recovery.SERVERS),  # cloud-nuke 368
    ("ECS::Cluster", "The Cluster cannot be deleted while it contains Tasks.", Recovery.SERVERS),
    (
        "ECS::Cluster",  # aws-scalable-big-blue-button-example 79
        "Resource handler returned message: \"Error occurred during operation 'DeleteClusters SDK Error: The Cluster "
        "cannot be deleted while Container Instances are active or draining. (Service: AmazonECS; Error Code: "
        "ClusterContainsContainerInstancesException)'.\" (HandlerErrorCode: GeneralServiceException)",
        Recovery.SERVERS,
    ),
    ("ECS::Cluster", "ClientException: Cluster was not ACTIVE.", Recovery.PAUSE),  # terraform-provider-aws 11285
    (
        "EC2::Subnet",  # aws-cdk 14456
        "The subnet 'subnet-0d544dc539aeafb80' has dependencies and cannot be deleted. (Service: AmazonEC2; Status "
        "Code: 400; Error Code: DependencyViolation; Proxy: null)",
        Recovery.NETWORK,
    ),
    ("EC2::VPC", "The vpc 'vpc-0ae35fcfa21404341' has dependencies and cannot be deleted.", Recovery.NETWORK),
    ("EC2::SecurityGroup", "resource sg-04eb9b4569cb59608 has a dependent object", Recovery.NETWORK),  # aws-cdk 14456
    (
        "EC2::VPCGatewayAttachment",  # cloud-nuke 591, aws/eks-hybrid 703
        "Network vpc-00db40ad268a8758a has some mapped public address(es). Please unmap those public address(es) "
        "before detaching the gateway.",
        Recovery.NETWORK,
    ),
    ("EC2::InternetGateway", "The internetGateway 'igw-1' has dependencies and cannot be deleted.", Recovery.NETWORK),
    (
        "CertificateManager::Certificate",  # aws-cdk 36265
        "Certificate arn:aws:acm:ca-central-1:123456789012:certificate/1 in account 123456789012 is in use. "
        "(Service: Acm, Status Code: 400)",
        Recovery.CERTIFICATE,
    ),
    ("IAM::ManagedPolicy", "Cannot delete a policy attached to entities.", Recovery.POLICY),  # terraform-provider 32906
    ("IAM::ManagedPolicy", "This policy has more than one version.", Recovery.POLICY),  # aws-iam-operator 13
    ("IAM::Role", "Cannot delete entity, must detach all policies first.", Recovery.ROLE),  # aws-parallelcluster 4031
    ("IAM::Role", "Cannot delete entity, must delete policies first", Recovery.ROLE),  # convox/rack 2672
    (
        "ECR::Repository",  # brentley/appmeshworkshop 31
        "The repository with name 'x' in registry with id '1' cannot be deleted because it still contains images",
        Recovery.PAUSE,
    ),
    (
        "Route53::RecordSet",  # byu-oit/handel 486; the sentence is Route 53's own for NoSuchHostedZone
        "No hosted zone found with ID: Z0123456789ABCDEFGHIJ (Service: Route53, Status Code: 404, Request ID: 1)",
        Recovery.GONE,
    ),
    ("SQS::Queue", "Rate exceeded (Service: Sqs, Status Code: 400) (HandlerErrorCode: Throttling)", Recovery.PAUSE),
    ("Logs::LogGroup", "A conflicting operation is currently in progress. Please try again.", Recovery.PAUSE),
    ("IAM::Role", "Internal Failure", Recovery.PAUSE),
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


@pytest.mark.parametrize(("kind", "reason", "helps"), REPORTED)
def test_reported_failures_get_the_right_remedy(kind: str, reason: str, helps: Recovery) -> None:
    assert recovery_from(failure(kind, reason)) is helps


@pytest.mark.parametrize(("kind", "reason"), FOR_PEOPLE)
def test_failures_that_need_a_person_are_not_waited_for(kind: str, reason: str) -> None:
    assert recovery_from(failure(kind, reason)) is None


def test_each_wait_is_listed_once_and_none_if_a_failure_needs_a_person() -> None:
    passing = [failure(kind, reason) for kind, reason, _ in REPORTED]
    assert recoveries(passing) == list(dict.fromkeys(helps for *_, helps in REPORTED))
    assert recoveries([*passing, failure(*FOR_PEOPLE[0])]) == []
    assert recoveries([]) == []


def test_every_line_of_the_table_is_about_a_type_of_the_template_and_has_a_source() -> None:
    types = {one["Type"] for one in template()["Resources"].values()}
    for known in TABLE:
        assert not known.types or any(re.fullmatch(known.types, type_) for type_ in types), known
        assert known.source
