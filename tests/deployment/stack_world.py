"""An account in moto whose CloudFormation is the fake, a small template, and two small functions."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import pytest
from botocore.awsrequest import AWSResponse
from moto import mock_aws
from moto.iam.access_control import PermissionResult
from moto.s3.models import FakeBucket

from hippodrome.deployment.aws import caa, quotas
from hippodrome.deployment.aws.account import Account
from hippodrome.deployment.aws.hosted_zone import Delegation
from hippodrome.deployment.code import build
from hippodrome.deployment.code.packages import ZipMember
from hippodrome.deployment.code.template import Template
from hippodrome.deployment.stack import changes, domain, stack
from testing.botocore_sessions import botocore_session
from tests.deployment.fake_cloudformation import FakeCloudFormation, refusal

REGION = "ca-central-1"
ACCOUNT = "123456789012"
DOMAIN = "example.org"

TEMPLATE = """
AWSTemplateFormatVersion: 2010-09-09
Parameters:
  RootDomain: {Type: String}
  HostedZoneId: {Type: String}
  SiteHost: {Type: String, Default: study}
  AlarmEmail: {Type: String, Default: ""}
  MaxRuntime: {Type: Number, Default: 120}
  ServersHost: {Type: String, Default: servers}
  VpcId: {Type: String, Default: ""}
  SubnetIds: {Type: String, Default: ""}
  CodeBucket: {Type: String}
Conditions:
  OwnVpc: !Equals [!Ref VpcId, ""]
  HasEmail: !Not [!Equals [!Ref AlarmEmail, ""]]
  Both: !And [!Condition OwnVpc, Condition: HasEmail]
  Either: !Or [!Condition OwnVpc, Condition: HasEmail]
Resources:
  Bucket:
    Type: AWS::S3::Bucket
    DeletionPolicy: Retain
  Vpc: {Type: AWS::EC2::VPC, Condition: OwnVpc}
  Mail: {Type: AWS::SNS::Subscription, Condition: HasEmail}
  BothThings: {Type: AWS::SNS::Topic, Condition: Both}
  EitherThing: {Type: AWS::SNS::Topic, Condition: Either}
  Sweep:
    Type: AWS::Lambda::Function
    Properties:
      Handler: lambdas.sweep.handler
      Role: !GetAtt SweepRole.Arn
      Code: {S3Bucket: !Ref CodeBucket, S3Key: sweep.zip}
  NextStep:
    Type: AWS::Lambda::Function
    Properties:
      Handler: lambdas.next_step.handler
      Code:
        S3Bucket: !Ref CodeBucket
        S3Key: next_step.zip
"""


def function(name: str, body: bytes = b"pass\n") -> build.Function:
    member = ZipMember(f"lambdas/{name}.py", hashlib.sha256(body).hexdigest(), lambda: body)
    return build.Function(name, (member,), ())


_clients: dict[tuple[str, str], Any] = {}  # made once: it takes longer than most tests


class Limits:
    """The account's quotas and settings. Gap: moto has neither."""

    def __init__(self) -> None:
        self.executions = 1000
        self.quotas = {quotas.SPOT: 100.0, quotas.ON_DEMAND: 100.0, quotas.VPCS: 5.0}
        self.public_access: dict[str, Any] = {"InternetGatewayBlockMode": "off"}  # VPC Block Public Access
        self.exclusions: list[dict[str, str]] = []
        self.denied: set[str] = set()  # operations that these credentials may not call

    def get_account_settings(self) -> Any:
        self._ask("GetAccountSettings")
        limit = {"ConcurrentExecutions": self.executions, "UnreservedConcurrentExecutions": self.executions}
        return {"AccountLimit": limit}

    def get_service_quota(self, ServiceCode: str, QuotaCode: str) -> Any:
        self._ask("GetServiceQuota")
        if (known := quotas.Quota(ServiceCode, QuotaCode)) not in self.quotas:
            raise refusal("GetServiceQuota", "NoSuchResourceException", "no such quota")
        return {"Quota": {"Value": self.quotas[known]}}

    get_aws_default_service_quota = get_service_quota

    def block_public_access(self, model: Any, params: Any, **_: Any) -> tuple[AWSResponse, dict[str, Any]]:
        """Answer EC2's calls DescribeVpcBlockPublicAccess…; moto has neither."""
        denied, status = model.name in self.denied, 403 if model.name in self.denied else 200
        answer: dict[str, Any] = (
            {"Error": {"Code": "UnauthorizedOperation", "Message": "not authorized"}}
            if denied
            else {"VpcBlockPublicAccessOptions": self.public_access, "VpcBlockPublicAccessExclusions": self.exclusions}
        )
        return AWSResponse(params["url"], status, {}, None), {**answer, "ResponseMetadata": {"HTTPStatusCode": status}}

    def _ask(self, operation: str) -> None:
        if operation in self.denied:
            raise refusal(operation, "AccessDeniedException", "not authorized")


class WorldAccount(Account):
    def __init__(self, fake: FakeCloudFormation, limits: Limits) -> None:
        super().__init__(botocore_session(), REGION)
        self.fake, self.limits = fake, limits

    def client(self, service: str, region: str | None = None) -> Any:
        if service == "cloudformation":
            return self.fake
        if service in {"lambda", "service-quotas"}:
            return self.limits
        key = (service, region or self.region)
        if key not in _clients:
            _clients[key] = super().client(service, region)
        return _clients[key]


class World:
    """An account: `account` is for the commands, `cloud` is the fake CloudFormation."""

    def __init__(self) -> None:
        self.cloud = FakeCloudFormation(REGION, ACCOUNT)
        self.limits = Limits()
        self.account = WorldAccount(self.cloud, self.limits)
        self.delegated = Delegation(())  # the delegation of the zone in public DNS
        self.caa: dict[str, caa.Caa] = {}  # the CAA records that count for a name
        self.functions = [function("next_step"), function("sweep"), function("unused")]
        self.text = TEMPLATE
        self.zone = self.make_zone(DOMAIN)

    def make_zone(self, domain: str, private: bool = False) -> str:
        made = self.account.client("route53").create_hosted_zone(
            Name=f"{domain}.",
            CallerReference=f"{domain}{private}{len(self.account.client('route53').list_hosted_zones()['HostedZones'])}",
            HostedZoneConfig={"PrivateZone": private},
            **({"VPC": {"VPCRegion": REGION, "VPCId": "vpc-1"}} if private else {}),
        )
        return str(made["HostedZone"]["Id"]).rsplit("/", 1)[-1]

    @property
    def code_bucket(self) -> str:
        return f"hippodrome-code-{ACCOUNT}-{REGION}"

    @property
    def built(self) -> Template:
        return Template(self.text).with_code(self.functions)

    def parameters(self, **changed: str) -> dict[str, str]:
        return {
            "RootDomain": DOMAIN,
            "HostedZoneId": self.zone,
            "SiteHost": "study",
            "ServersHost": "servers",
            "AlarmEmail": "",
            "MaxRuntime": "120",
            "VpcId": "",
            "SubnetIds": "",
            "CodeBucket": self.code_bucket,
        } | changed

    def stand(self, status: str = "CREATE_COMPLETE", **changed: str) -> None:
        """Let the stack exist, as an earlier apply of this template made it."""
        self.cloud.stand(status, self.parameters(**changed), self.built.text)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    for name in ("AWS_ENDPOINT_URL", "AWS_PROFILE", "HIPPODROME_TARGET", "HIPPODROME_STACK"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "testing")
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "testing")
    with mock_aws():
        world = World()
        monkeypatch.setattr(changes.Template, "read", lambda: Template(world.text))
        monkeypatch.setattr(build, "functions", lambda target: world.functions)
        monkeypatch.setattr(domain, "delegation", lambda zone: world.delegated)
        monkeypatch.setattr(caa, "find", lambda name, *_: world.caa.get(name, caa.Caa()))
        monkeypatch.setattr(stack.time, "sleep", lambda seconds: None)
        monkeypatch.setattr(stack, "FIRST_PAUSE", 0.0)
        # Gap: moto ignores the conditions of bucket policies, so the one against plain HTTP would refuse every request.
        monkeypatch.setattr(FakeBucket, "get_permission", lambda *_: PermissionResult.NEUTRAL)
        ec2 = world.account.client("ec2").meta.events
        for name in ("Options", "Exclusions"):
            ec2.register(f"before-call.ec2.DescribeVpcBlockPublicAccess{name}", world.limits.block_public_access, name)
        yield world
        for name in ("Options", "Exclusions"):
            ec2.unregister(f"before-call.ec2.DescribeVpcBlockPublicAccess{name}", unique_id=name)
