"""A stack whose resources are real things in moto, and whose deletion is refused where AWS refuses it.

Facts, each with its source where the code has it (`hippodrome/deployment/stack/deletion.py`, `acm_records.py` and `hippodrome/deployment/lifecycle/apply.py`):
a certificate stays in use after API Gateway's domain; its validation record is nobody's; an attached policy is not
deleted; interfaces of tasks outlive them; a queue is listed for a minute after it was deleted, and its name is kept.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from typing import Any

from moto.acm.models import acm_backends

from tests.deployment.stack_world import ACCOUNT, DOMAIN, REGION, World

SITE = f"study.{DOMAIN}"
BALANCER = "arn:aws:elasticloadbalancing:ca-central-1:987654321098:loadbalancer/app/prod-yul-1/0123456789abcdef"


class Clock:
    """A clock whose time passes only in `sleep`."""

    def __init__(self) -> None:
        self.time = datetime.now(UTC)
        self.slept = 0.0
        self.aws = False
        self._due: list[tuple[datetime, Callable[[], object]]] = []

    def sleep(self, seconds: float) -> None:
        self.slept += seconds
        self.time += timedelta(seconds=seconds)
        for at, act in [*self._due]:
            if at <= self.time:
                self._due.remove((at, act))
                with self.aside():
                    act()

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Mark that AWS itself acts, which Ctrl-C does not interrupt."""
        before, self.aws = self.aws, True
        try:
            yield
        finally:
            self.aws = before

    def after(self, seconds: float, act: Callable[[], object]) -> None:
        self._due.append((self.time + timedelta(seconds=seconds), act))


class RealStack:
    """Makes the stack's resources in moto, and decides which of their creations and deletions AWS refuses."""

    # Seconds that the certificate stays in use after the domain is gone; on AWS ten times that, or more.
    in_use = 4 * 60

    def __init__(self, world: World, clock: Clock) -> None:
        self.world, self.clock = world, clock
        self.deleted: dict[str, datetime] = {}  # queues
        # Until then the certificate's deletion is refused, whatever ACM lists as its users.
        self.refused_until = clock.time
        self.client = world.account.client
        self.cloud = world.cloud
        self.cloud.clock = lambda: clock.time
        self.cloud.making, self.cloud.deleting = self.make, self.delete
        self.make_all()

    def make_all(self) -> None:
        """Make the resources of an installation whose deletion AWS may refuse."""
        ec2 = self.client("ec2")
        self.vpc = ec2.create_vpc(CidrBlock="10.86.0.0/16")["Vpc"]["VpcId"]
        self.subnet = ec2.create_subnet(VpcId=self.vpc, CidrBlock="10.86.64.0/18")["Subnet"]["SubnetId"]
        self.certificate = request_certificate(self.world, SITE)
        self.policy = self.client("iam").create_policy(PolicyName="hippodrome-researcher", PolicyDocument=POLICY)[
            "Policy"
        ]["Arn"]
        self.role = "hippodrome-sweep"
        self.client("iam").create_role(RoleName=self.role, AssumeRolePolicyDocument="{}")
        self.queue = self.client("sqs").create_queue(QueueName="hippodrome-start")["QueueUrl"]
        self.record = validation_record(self.world, self.certificate)
        self.cloud.resources += [
            resource("Vpc", "AWS::EC2::VPC", self.vpc),
            resource("SubnetA", "AWS::EC2::Subnet", self.subnet),
            resource("StartQueue", "AWS::SQS::Queue", self.queue),
            resource("SweepRole", "AWS::IAM::Role", self.role),
            resource("SiteCertificate", "AWS::CertificateManager::Certificate", self.certificate),
            resource("SiteDomain", "AWS::ApiGatewayV2::DomainName", SITE),
            resource("SiteRecord", "AWS::Route53::RecordSet", SITE),
            resource("ResearcherPolicy", "AWS::IAM::ManagedPolicy", self.policy),
        ]

    # -- what the services say

    def delete(self, one: dict[str, Any]) -> str:
        handler = getattr(self, f"_delete_{one['LogicalResourceId']}", None)
        with self.clock.aside():
            return handler() if handler else ""

    def make(self, one: dict[str, Any]) -> str:
        if one["ResourceType"] == "AWS::SQS::Queue":
            at = self.deleted.get(one["PhysicalResourceId"])
            if at and (self.clock.time - at).total_seconds() < 60:
                return (
                    "You must wait 60 seconds after deleting a queue before you can create another with the same name."
                    " (Service: Sqs, Status Code: 400, Request ID: 1) (RequestToken: 2, HandlerErrorCode: "
                    "GeneralServiceException)"
                )
        return ""

    def certificate_users(self) -> list[str]:
        """Return the users of the certificate that ACM lists: moto's own list."""
        return acm_backends[ACCOUNT][REGION]._certificates[self.certificate].in_use_by

    def _delete_SiteDomain(self) -> str:
        if not self.in_use:
            return ""
        self.certificate_users().append(BALANCER)
        self.clock.after(self.in_use, lambda: self.certificate_users().remove(BALANCER))
        return ""

    def _delete_SiteCertificate(self) -> str:
        if self.certificate_users() or self.clock.time < self.refused_until:
            return passed_on(f"Certificate {self.certificate} in account {ACCOUNT} is in use.", "Acm")
        self.client("acm").delete_certificate(CertificateArn=self.certificate)
        return ""

    def _delete_ResearcherPolicy(self) -> str:
        iam = self.client("iam")
        entities = iam.list_entities_for_policy(PolicyArn=self.policy)
        if any(entities[f"Policy{kind}"] for kind in ("Users", "Groups", "Roles")):
            return passed_on("Cannot delete a policy attached to entities.", "Iam")
        if len(iam.list_policy_versions(PolicyArn=self.policy)["Versions"]) > 1:
            return passed_on("This policy has more than one version.", "Iam")
        iam.delete_policy(PolicyArn=self.policy)
        return ""

    def _delete_SweepRole(self) -> str:
        iam = self.client("iam")
        if iam.list_attached_role_policies(RoleName=self.role)["AttachedPolicies"]:
            return passed_on("Cannot delete entity, must detach all policies first.", "Iam")
        if iam.list_role_policies(RoleName=self.role)["PolicyNames"]:
            return passed_on("Cannot delete entity, must delete policies first.", "Iam")
        iam.delete_role(RoleName=self.role)
        return ""

    def _delete_SiteRecord(self) -> str:
        zones = self.client("route53").list_hosted_zones()["HostedZones"]
        if not any(one["Id"].endswith(self.world.zone.rpartition("/")[2]) for one in zones):
            return passed_on(f"No hosted zone found with ID: {self.world.zone}", "Route53")
        return ""

    def _delete_StartQueue(self) -> str:
        self.deleted[self.queue] = self.clock.time
        self.clock.after(60, lambda: self.client("sqs").delete_queue(QueueUrl=self.queue))
        return ""

    def _delete_SubnetA(self) -> str:
        if interfaces(self.world):
            return passed_on(f"The subnet '{self.subnet}' has dependencies and cannot be deleted.", "Ec2")
        self.client("ec2").delete_subnet(SubnetId=self.subnet)
        return ""

    def _delete_Vpc(self) -> str:
        if interfaces(self.world):
            return passed_on(f"The vpc '{self.vpc}' has dependencies and cannot be deleted.", "Ec2")
        self.client("ec2").delete_vpc(VpcId=self.vpc)
        return ""

    # -- what people and AWS do

    def attach(self, user: str = "", group: str = "", role: str = "") -> None:
        """Attach the researchers' policy to a user, a group or a role."""
        iam = self.client("iam")
        if user:
            iam.create_user(UserName=user)
            iam.attach_user_policy(UserName=user, PolicyArn=self.policy)
        if group:
            iam.create_group(GroupName=group)
            iam.attach_group_policy(GroupName=group, PolicyArn=self.policy)
        if role:
            iam.create_role(RoleName=role, AssumeRolePolicyDocument="{}")
            iam.attach_role_policy(RoleName=role, PolicyArn=self.policy)

    def delete_zone(self) -> None:
        """Delete the hosted zone and its records, as a person would (Route 53 deletes only an empty zone)."""
        client = self.client("route53")
        for one in client.list_resource_record_sets(HostedZoneId=self.world.zone)["ResourceRecordSets"]:
            if one["Type"] not in {"NS", "SOA"}:
                batch = {"Changes": [{"Action": "DELETE", "ResourceRecordSet": one}]}
                client.change_resource_record_sets(HostedZoneId=self.world.zone, ChangeBatch=batch)
        client.delete_hosted_zone(Id=self.world.zone)

    def add_interface(self, seconds: float) -> None:
        """Add the network interface of a task that has ended, which AWS removes after so many seconds."""
        ec2 = self.client("ec2")
        made = ec2.create_network_interface(SubnetId=self.subnet)["NetworkInterface"]["NetworkInterfaceId"]
        self.clock.after(seconds, lambda: ec2.delete_network_interface(NetworkInterfaceId=made))


POLICY = '{"Version":"2012-10-17","Statement":[{"Effect":"Allow","Action":"s3:ListBucket","Resource":"*"}]}'


def passed_on(sentence: str, service: str) -> str:
    """Return the message of a service in the form in which CloudFormation passes it on."""
    return (
        f'Resource handler returned message: "{sentence} (Service: {service}, Status Code: 400, Request ID: 0a1b)" '
        "(RequestToken: 9fd5, HandlerErrorCode: GeneralServiceException)"
    )


def resource(logical: str, kind: str, physical: str) -> dict[str, Any]:
    return {"LogicalResourceId": logical, "ResourceType": kind, "PhysicalResourceId": physical}


def request_certificate(world: World, domain: str, region: str = REGION) -> str:
    """Request a certificate that is validated by DNS. Returns its ARN."""
    acm = world.account.client("acm", region)
    return str(acm.request_certificate(DomainName=domain, ValidationMethod="DNS")["CertificateArn"])


def validation_record(world: World, arn: str) -> str:
    """Put the certificate's validation record into the zone, as CloudFormation does. Returns its name."""
    described = world.account.client("acm").describe_certificate(CertificateArn=arn)["Certificate"]
    record = described["DomainValidationOptions"][0]["ResourceRecord"]
    put_cname(world, record["Name"], record["Value"])
    return str(record["Name"])


def put_cname(world: World, name: str, value: str) -> None:
    """Put a CNAME into the zone."""
    change = {
        "Action": "UPSERT",
        "ResourceRecordSet": {"Name": name, "Type": "CNAME", "TTL": 300, "ResourceRecords": [{"Value": value}]},
    }
    world.account.client("route53").change_resource_record_sets(
        HostedZoneId=world.zone, ChangeBatch={"Changes": [change]}
    )


def same_record(world: World, arn: str, like: str, region: str) -> None:
    """Give a certificate the validation record of another: within an account, ACM's is the same for the same name."""
    told = acm_backends[ACCOUNT][REGION]._certificates[like]
    other = acm_backends[ACCOUNT][region]._certificates[arn]
    record = told.describe()["Certificate"]["DomainValidationOptions"][0]["ResourceRecord"]
    describe = other.describe

    def described() -> dict[str, Any]:
        found = describe()
        for option in found["Certificate"]["DomainValidationOptions"]:
            option["ResourceRecord"] = record
        return found

    other.describe = described  # type: ignore[method-assign]


def zone_records(world: World) -> set[tuple[str, str]]:
    """Return the zone's records without NS and SOA: names and types."""
    found = world.account.client("route53").list_resource_record_sets(HostedZoneId=world.zone)["ResourceRecordSets"]
    return {(one["Name"], one["Type"]) for one in found if one["Type"] not in {"NS", "SOA"}}


def interfaces(world: World) -> list[str]:
    found = world.account.client("ec2").describe_network_interfaces()["NetworkInterfaces"]
    return [one["NetworkInterfaceId"] for one in found]
