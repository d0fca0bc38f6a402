"""What may stand in the way of a deletion for a while, by what CloudFormation says of it: one table with its sources.

CloudFormation deletes what it can and ends in DELETE_FAILED, with a sentence of the service for each resource that is
left. Deleting the stack again goes on from there. A sentence that is not in this table is nobody's to wait for: a
missing permission, say.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from enum import Enum
from typing import NamedTuple

from deploy.stack.stack import Failure


class Wait(Enum):
    """What helps before the deletion is tried again."""

    SERVERS = "servers are stopped"
    NETWORK = "the addresses of servers that have ended are given back"
    CERTIFICATE = "nothing uses the certificate any more"
    POLICY = "the policy is detached"
    ROLE = "foreign policies are taken from the role"
    PAUSE = "AWS is done with what it is at"
    GONE = "the records of the hosted zone, which is gone, are left out"


class Obstacle(NamedTuple):
    """Resource types ("" for all), what their service says (a pattern, in any case), and what helps."""

    types: str
    says: str
    wait: Wait
    source: str  # of the wording


TABLE: tuple[Obstacle, ...] = (
    Obstacle(
        r"AWS::ECS::Cluster",
        r"ClusterContains(Tasks|ContainerInstances|Services)|contains? tasks|"
        r"while (Tasks|Services|Container Instances) are (active|draining)",
        Wait.SERVERS,
        "gruntwork-io/cloud-nuke issue 368; aws-samples/aws-scalable-big-blue-button-example issue 79",
    ),
    Obstacle(
        r"AWS::ECS::Cluster",
        r"busy state|UpdateInProgress|ResourceInUse|is in use|was not ACTIVE|Capacity Providers are attached",
        Wait.PAUSE,
        "hashicorp/terraform-provider-aws issue 11285 and pull request 45794",
    ),
    Obstacle(
        r"AWS::EC2::(VPC|Subnet|SecurityGroup|InternetGateway|RouteTable|VPCEndpoint|VPCGatewayAttachment|Route|"
        r"SubnetRouteTableAssociation)",
        r"has dependencies|has a dependent object|dependent object|DependencyViolation|mapped public address|"
        r"is (currently )?in use|InvalidGroup\.InUse",
        Wait.NETWORK,
        "aws/aws-cdk issue 14456; gruntwork-io/cloud-nuke pull request 591; alchemy-run/alchemy pull request 1125: the "
        "interfaces of tasks that have ended may keep their addresses for 5 to 20 minutes",
    ),
    Obstacle(
        r"AWS::CertificateManager::Certificate",
        r"is in use|ResourceInUse",
        Wait.CERTIFICATE,
        "aws/aws-cdk issues 36265 and 16608",
    ),
    Obstacle(
        r"AWS::IAM::ManagedPolicy",
        r"attached to entities|more than one version|DeleteConflict",
        Wait.POLICY,
        "hashicorp/terraform-provider-aws issue 32906; redradrat/aws-iam-operator issue 13",
    ),
    Obstacle(
        r"AWS::IAM::Role",
        r"must detach all policies first|must delete policies first",
        Wait.ROLE,
        "aws/aws-parallelcluster issue 4031; convox/rack issue 2672",
    ),
    Obstacle(
        r"AWS::ECR::Repository",
        r"RepositoryNotEmpty|still contains images|not empty",
        Wait.PAUSE,
        "brentley/appmeshworkshop issue 31; here: an image that is pushed while CloudFormation empties the repository",
    ),
    Obstacle(
        r"AWS::(Scheduler::ScheduleGroup|Logs::LogGroup|Lambda::\w+|ApiGatewayV2::\w+|CodeBuild::Project|Events::Rule)",
        r"Conflict|in progress|being (deleted|updated|modified)|OperationAborted|is in use|ResourceInUse|"
        r"targets|Please try again",
        Wait.PAUSE,
        "API references of these services, errors of their deletions (read November 2026)",
    ),
    Obstacle(
        r"AWS::Route53::RecordSet",
        r"NoSuchHostedZone|No hosted zone found with ID",
        Wait.GONE,
        "byu-oit/handel pull request 486; Route 53 API Reference, NoSuchHostedZone",
    ),
    Obstacle(
        "",
        r"Rate exceeded|Throttl|TooManyRequests|Internal ?(Failure|Error|Server)|ServiceUnavailable|"
        r"NotStabilized|not stabili[sz]e|timed? ?out|PriorRequestNotComplete|OperationAborted",
        Wait.PAUSE,
        "CloudFormation's handler error codes (CloudFormation CLI guide, resource-type-test-contract-errors)",
    ),
)

_DENIED = re.compile(r"not authorized|Access ?Denied|explicit deny", re.IGNORECASE)


def wait_for(failure: Failure) -> Wait | None:
    """What helps against this failure; None if nothing that passes by itself, or that we can do."""
    if _DENIED.search(failure.reason):
        return None
    for obstacle in TABLE:
        if (not obstacle.types or re.fullmatch(obstacle.types, failure.type)) and re.search(
            obstacle.says, failure.reason, re.IGNORECASE
        ):
            return obstacle.wait
    return None


def waits(failures: Iterable[Failure]) -> list[Wait]:
    """What helps against all of these, each once; nothing if one of them is nothing that passes."""
    found = [wait_for(failure) for failure in failures]
    return [] if None in found else list(dict.fromkeys(wait for wait in found if wait))
