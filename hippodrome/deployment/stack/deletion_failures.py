"""A table of failures of a stack's deletion that pass or can be mended, found by their text, each with its source.

CloudFormation deletes what it can and ends in DELETE_FAILED, with a service's message for each resource that is left.
Deleting the stack again goes on from there. If a message is not in this table, such as that of a missing permission,
waiting does not help.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import Enum
from typing import NamedTuple

from hippodrome.deployment.stack.stack import FailedResource


class Recovery(Enum):
    """An event that must come before the deletion is tried again. Its value follows "This has to wait until"."""

    SERVERS = "servers are stopped"
    NETWORK = "the addresses of servers that have ended are given back"
    CERTIFICATE = "nothing uses the certificate any more"
    POLICY = "the policy is detached"
    ROLE = "foreign policies are taken from the role"
    PAUSE = "AWS has ended another operation"
    GONE = "the records of the hosted zone, which is gone, are left out"


class KnownFailure(NamedTuple):
    """A failure: its resource types ("" for all), its message (a pattern, ignoring case), and what helps."""

    types: str
    says: str
    recovery: Recovery
    source: str  # where the message was seen


TABLE: tuple[KnownFailure, ...] = (
    KnownFailure(
        r"AWS::ECS::Cluster",
        r"ClusterContains(Tasks|ContainerInstances|Services)|contains? tasks|"
        r"while (Tasks|Services|Container Instances) are (active|draining)",
        Recovery.SERVERS,
        "gruntwork-io/cloud-nuke issue 368; aws-samples/aws-scalable-big-blue-button-example issue 79",
    ),
    KnownFailure(
        r"AWS::ECS::Cluster",
        r"busy state|UpdateInProgress|ResourceInUse|is in use|was not ACTIVE|Capacity Providers are attached",
        Recovery.PAUSE,
        "hashicorp/terraform-provider-aws issue 11285 and pull request 45794",
    ),
    KnownFailure(
        r"AWS::EC2::(VPC|Subnet|SecurityGroup|InternetGateway|RouteTable|VPCEndpoint|VPCGatewayAttachment|Route|"
        r"SubnetRouteTableAssociation)",
        r"has dependencies|has a dependent object|dependent object|DependencyViolation|mapped public address|"
        r"is (currently )?in use|InvalidGroup\.InUse",
        Recovery.NETWORK,
        "aws/aws-cdk issue 14456; gruntwork-io/cloud-nuke pull request 591; alchemy-run/alchemy pull request 1125: the "
        "interfaces of tasks that have ended may keep their addresses for 5 to 20 minutes",
    ),
    KnownFailure(
        r"AWS::CertificateManager::Certificate",
        r"is in use|ResourceInUse",
        Recovery.CERTIFICATE,
        "aws/aws-cdk issues 36265 and 16608",
    ),
    KnownFailure(
        r"AWS::IAM::ManagedPolicy",
        r"attached to entities|more than one version|DeleteConflict",
        Recovery.POLICY,
        "hashicorp/terraform-provider-aws issue 32906; redradrat/aws-iam-operator issue 13",
    ),
    KnownFailure(
        r"AWS::IAM::Role",
        r"must detach all policies first|must delete policies first",
        Recovery.ROLE,
        "aws/aws-parallelcluster issue 4031; convox/rack issue 2672",
    ),
    KnownFailure(
        r"AWS::ECR::Repository",
        r"RepositoryNotEmpty|still contains images|not empty",
        Recovery.PAUSE,
        "brentley/appmeshworkshop issue 31; here: an image that is pushed while CloudFormation empties the repository",
    ),
    KnownFailure(
        r"AWS::(Scheduler::ScheduleGroup|Logs::LogGroup|Lambda::\w+|ApiGatewayV2::\w+|Events::Rule)",
        r"Conflict|in progress|being (deleted|updated|modified)|OperationAborted|is in use|ResourceInUse|"
        r"targets|Please try again",
        Recovery.PAUSE,
        "API references of these services, errors of their deletions (read November 2026)",
    ),
    KnownFailure(
        r"AWS::Route53::RecordSet",
        r"NoSuchHostedZone|No hosted zone found with ID",
        Recovery.GONE,
        "byu-oit/handel pull request 486; Route 53 API Reference, NoSuchHostedZone",
    ),
    KnownFailure(
        "",
        r"Rate exceeded|Throttl|TooManyRequests|Internal ?(Failure|Error|Server)|ServiceUnavailable|"
        r"NotStabilized|not stabili[sz]e|timed? ?out|PriorRequestNotComplete|OperationAborted",
        Recovery.PAUSE,
        "CloudFormation's handler error codes (CloudFormation CLI guide, resource-type-test-contract-errors)",
    ),
)

_DENIED = re.compile(r"not authorized|Access ?Denied|explicit deny", re.IGNORECASE)


def recovery_from(failure: FailedResource) -> Recovery | None:
    """Find what helps against this failure; None if it does not pass and no command can mend it."""
    if _DENIED.search(failure.reason):
        return None
    for row in TABLE:
        if (not row.types or re.fullmatch(row.types, failure.type)) and re.search(
            row.says, failure.reason, re.IGNORECASE
        ):
            return row.recovery
    return None


def recoveries(failures: Iterable[FailedResource]) -> list[Recovery]:
    """Find what helps against these failures, each once; empty if nothing helps against one of them."""
    all_recoveries = [recovery_from(failure) for failure in failures]
    return [] if None in all_recoveries else list(dict.fromkeys(recovery for recovery in all_recoveries if recovery))
