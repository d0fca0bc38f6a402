"""Deletes a stack. What AWS refuses for a while is tried again, by the table `FAILURES`.

CloudFormation deletes what it can and ends in DELETE_FAILED, with a service's message for each resource that is left;
deleting the stack again goes on from there. A message that is not in the table, such as that of a missing permission,
ends the command.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from enum import Enum
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from hippodrome.console import screen
from hippodrome.console.formatting import duration
from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.core.stages import Executor
from hippodrome.deployment.stack.stack import FailedResource, NotDeleted, Stack

PAUSE = 30  # seconds between two tries


class Remedy(Enum):
    """What is done before the next try. Each try also stops servers, and detaches the stack's managed policies."""

    WAIT = "wait"
    FREE_NETWORK = "remove what GuardDuty has put into the network"
    FREE_ROLE = "take foreign policies from the role"
    LEAVE_OUT = "leave the resource out, which is gone"


class KnownFailure(NamedTuple):
    """A failure that passes: its resource types ("" for all), its message (a pattern, ignoring case), its remedy."""

    types: str
    says: str
    minutes: int  # for which it may last
    until: str  # follows "This has to wait until"
    source: str  # where the message, and how long it lasts, was seen
    remedy: Remedy = Remedy.WAIT


FAILURES: tuple[KnownFailure, ...] = (
    KnownFailure(
        r"AWS::ECS::Cluster",
        r"ClusterContains(Tasks|ContainerInstances|Services)|contains? tasks|"
        r"while (Tasks|Services|Container Instances) are (active|draining)",
        10,
        "servers are stopped",
        "gruntwork-io/cloud-nuke issue 368; aws-samples/aws-scalable-big-blue-button-example issue 79",
    ),
    KnownFailure(
        r"AWS::ECS::Cluster",
        r"busy state|UpdateInProgress|ResourceInUse|is in use|was not ACTIVE|Capacity Providers are attached",
        10,
        "ECS has ended another operation",
        "hashicorp/terraform-provider-aws issue 11285 and pull request 45794",
    ),
    KnownFailure(
        r"AWS::EC2::(VPC|Subnet|SecurityGroup|InternetGateway|RouteTable|VPCEndpoint|VPCGatewayAttachment|Route|"
        r"SubnetRouteTableAssociation)",
        r"has dependencies|has a dependent object|dependent object|DependencyViolation|mapped public address|"
        r"is (currently )?in use|InvalidGroup\.InUse",
        25,
        "the addresses of servers that have ended are given back, which takes up to 20 minutes",
        "aws/aws-cdk issue 14456; gruntwork-io/cloud-nuke pull request 591; alchemy-run/alchemy pull request 1125. "
        "GuardDuty's Runtime Monitoring leaves an endpoint and a security group in every VPC with tasks: GuardDuty "
        'User Guide, "Clean up Runtime Monitoring resources"; hashicorp/terraform-provider-aws issue 46747',
        Remedy.FREE_NETWORK,
    ),
    KnownFailure(
        r"AWS::CertificateManager::Certificate",
        r"is in use|ResourceInUse",
        75,
        "AWS has dismantled the site's address, which takes 10 to 60 minutes, and the certificate is in use no more",
        "aws/aws-cdk issues 36265 and 16608; amplify-education/serverless-domain-manager issue 32",
    ),
    KnownFailure(
        r"AWS::IAM::ManagedPolicy",
        r"attached to entities|more than one version|DeleteConflict",
        2,
        "the policy is detached",
        "hashicorp/terraform-provider-aws issue 32906; redradrat/aws-iam-operator issue 13; IAM's DeletePolicy",
    ),
    KnownFailure(
        r"AWS::IAM::Role",
        r"must detach all policies first|must delete policies first",
        2,
        "foreign policies are taken from the role",
        "aws/aws-parallelcluster issue 4031; convox/rack issue 2672; IAM's DeleteRole",
        Remedy.FREE_ROLE,
    ),
    KnownFailure(
        r"AWS::ECR::Repository",
        r"RepositoryNotEmpty|still contains images|not empty",
        10,
        "the image repository is empty",
        "brentley/appmeshworkshop issue 31; here: an image that is pushed while CloudFormation empties the repository",
    ),
    KnownFailure(
        r"AWS::(Scheduler::ScheduleGroup|Logs::LogGroup|Lambda::\w+|ApiGatewayV2::\w+|Events::Rule)",
        r"Conflict|in progress|being (deleted|updated|modified)|OperationAborted|is in use|ResourceInUse|"
        r"targets|Please try again",
        10,
        "AWS has ended another operation",
        "API references of these services, errors of their deletions (read November 2026)",
    ),
    KnownFailure(
        r"AWS::Route53::RecordSet",
        r"NoSuchHostedZone|No hosted zone found with ID",
        2,
        "the records of the hosted zone, which is gone, are left out",
        "byu-oit/handel pull request 486; Route 53 API Reference, NoSuchHostedZone",
        Remedy.LEAVE_OUT,
    ),
    KnownFailure(
        "",
        r"Rate exceeded|Throttl|TooManyRequests|Internal ?(Failure|Error|Server)|ServiceUnavailable|"
        r"NotStabilized|not stabili[sz]e|timed? ?out|PriorRequestNotComplete|OperationAborted",
        10,
        "AWS is less busy",
        "CloudFormation's handler error codes (CloudFormation CLI guide, resource-type-test-contract-errors)",
    ),
)

_DENIED = re.compile(r"not authorized|Access ?Denied|explicit deny", re.IGNORECASE)


def known_failure(failure: FailedResource) -> KnownFailure | None:
    """Find the failure in the table; None if it does not pass by itself."""
    if _DENIED.search(failure.reason):
        return None
    for row in FAILURES:
        if re.fullmatch(row.types or ".*", failure.type) and re.search(row.says, failure.reason, re.IGNORECASE):
            return row
    return None


class StackDeletion:
    """Deletes a stack. `stop_servers` is called before each try."""

    def __init__(
        self, account: Account, stack: Stack, executor: Executor, stop_servers: Callable[[], None] = lambda: None
    ) -> None:
        self._account = account
        self._stack = stack
        self._executor = executor
        self._stop_servers = stop_servers

    def run(self, title: str = "Deleting the stack") -> None:
        """Delete the stack, in as many tries as it takes.

        Raises `Problem` for a failure that is not in the table, or that lasts longer than it says.
        """
        timer, without = self._executor.timer(), list[str]()
        since: dict[KnownFailure, float] = {}  # the timer's seconds at which a failure was first seen
        while True:
            self._stop_servers()
            self._detach_policies()
            try:
                self._stack.delete(title, without)
                return
            except NotDeleted as error:
                known = [(failure, row) for failure in error.failures if (row := known_failure(failure))]
                if not known or len(known) < len(error.failures):
                    raise
                for row in dict.fromkeys(row for _, row in known):
                    if row not in since:
                        screen.info(f"This has to wait until {row.until}; then the rest is deleted.")
                        since[row] = timer.elapsed
                    if timer.elapsed - since[row] >= row.minutes * 60:
                        raise _lasting(row, error) from None
            without = [failure.logical_id for failure, row in known if row.remedy is Remedy.LEAVE_OUT]
            if any(row.remedy is Remedy.FREE_NETWORK for _, row in known):
                self._remove_guardduty()
            for failure, row in known:
                if row.remedy is Remedy.FREE_ROLE:
                    self._free_role(failure.physical_id)
            timer.sleep(PAUSE)

    def _detach_policies(self) -> None:
        """Detach the stack's managed policies, delete their older versions, and print who had them.

        IAM deletes no policy that is attached or has other versions than its default.
        """
        iam = self._account.client("iam")
        for arn in self._stack.ids_of("AWS::IAM::ManagedPolicy"):
            holders = []
            for page in _pages(iam, "list_entities_for_policy", PolicyArn=arn, PolicyUsageFilter="PermissionsPolicy"):
                for kind in ("User", "Group", "Role"):
                    for holder in page.get(f"Policy{kind}s", ()):
                        name = {f"{kind}Name": holder[f"{kind}Name"]}
                        _ignoring_absence(getattr(iam, f"detach_{kind.lower()}_policy"), PolicyArn=arn, **name)
                        holders.append(f"the {kind.lower()} {holder[f'{kind}Name']}")
            if holders:
                screen.success(f"The policy {arn.rpartition('/')[2]} is detached from {', '.join(holders)}.")
            for page in _pages(iam, "list_policy_versions", PolicyArn=arn):
                for version in page["Versions"]:
                    if not version["IsDefaultVersion"]:
                        _ignoring_absence(iam.delete_policy_version, PolicyArn=arn, VersionId=version["VersionId"])

    def _free_role(self, name: str) -> None:
        """Take all policies from a role, also those that people or an organization's rules have added."""
        iam = self._account.client("iam")
        for page in _pages(iam, "list_attached_role_policies", RoleName=name):
            for policy in page["AttachedPolicies"]:
                _ignoring_absence(iam.detach_role_policy, RoleName=name, PolicyArn=policy["PolicyArn"])
        for page in _pages(iam, "list_role_policies", RoleName=name):
            for policy in page["PolicyNames"]:
                _ignoring_absence(iam.delete_role_policy, RoleName=name, PolicyName=policy)

    def _remove_guardduty(self) -> None:
        """Delete GuardDuty's endpoints and security groups in the stack's own VPC, never in the administrator's."""
        ec2 = self._account.client("ec2")
        for vpc in self._stack.ids_of("AWS::EC2::VPC"):
            in_vpc = {"Name": "vpc-id", "Values": [vpc]}
            endpoints = [
                endpoint["VpcEndpointId"]
                for page in ec2.get_paginator("describe_vpc_endpoints").paginate(Filters=[in_vpc])
                for endpoint in page["VpcEndpoints"]
                if endpoint["ServiceName"].endswith(".guardduty-data")
                and endpoint["State"].lower() not in ("deleting", "deleted")
            ]
            if endpoints:
                ec2.delete_vpc_endpoints(VpcEndpointIds=endpoints)
                screen.info(f"GuardDuty's endpoint in the installation's network is deleted: {', '.join(endpoints)}.")
            of_guardduty = {"Name": "group-name", "Values": ["GuardDutyManagedSecurityGroup-*"]}
            for group in ec2.describe_security_groups(Filters=[in_vpc, of_guardduty])["SecurityGroups"]:
                try:
                    ec2.delete_security_group(GroupId=group["GroupId"])
                except ClientError as error:
                    if errors.code(error) != "DependencyViolation":  # the endpoint's interfaces go some minutes later
                        raise


def _lasting(row: KnownFailure, error: NotDeleted) -> Problem:
    return Problem(
        f"After {duration(row.minutes * 60)} AWS still refuses to delete "
        f"{', '.join(failure.logical_id for failure in error.failures)}.",
        "Run the same command later; it goes on from here. The console shows what still uses them: remove that. Only "
        "AWS's support can release a certificate that stays in use for a day; it costs nothing.",
        error.details,
    )


def _pages(iam: Any, operation: str, **arguments: str) -> list[Any]:
    """Return the pages of a listing; none if its subject does not exist any more."""
    try:
        return list(iam.get_paginator(operation).paginate(**arguments))
    except ClientError as error:
        if errors.code(error) != "NoSuchEntity":
            raise
        return []


def _ignoring_absence(call: Callable[..., object], **arguments: str) -> None:
    try:
        call(**arguments)
    except ClientError as error:
        if errors.code(error) != "NoSuchEntity":
            raise
