"""The template's properties held against the models of the calls that CloudFormation makes for them, as botocore has them.

Lengths, ranges, patterns and enumerations of every member that a property becomes. What the models do not know (queues'
and topics' attributes, EC2's texts, API Gateway's) has its rules in `tests/infra/rules/`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import Any

import botocore.session
from botocore.model import ListShape, MapShape, Shape, StructureShape

from tests.infra.rules.book import values
from tests.infra.situations import Installation, Resource

# Type → the calls that take its properties, each with the members that are not called like their property.
CALLS: Mapping[str, tuple[tuple[str, str, Mapping[str, str]], ...]] = {
    "AWS::ApiGatewayV2::Api": (("apigatewayv2", "CreateApi", {}),),
    "AWS::ApiGatewayV2::ApiMapping": (("apigatewayv2", "CreateApiMapping", {}),),
    "AWS::ApiGatewayV2::DomainName": (("apigatewayv2", "CreateDomainName", {}),),
    "AWS::ApiGatewayV2::Integration": (("apigatewayv2", "CreateIntegration", {}),),
    "AWS::ApiGatewayV2::Route": (("apigatewayv2", "CreateRoute", {}),),
    "AWS::ApiGatewayV2::Stage": (("apigatewayv2", "CreateStage", {}),),
    "AWS::Budgets::Budget": (("budgets", "CreateBudget", {}),),
    "AWS::CertificateManager::Certificate": (("acm", "RequestCertificate", {}),),
    "AWS::CloudWatch::Alarm": (("cloudwatch", "PutMetricAlarm", {}),),
    "AWS::CloudWatch::Dashboard": (("cloudwatch", "PutDashboard", {}),),
    "AWS::EC2::Route": (("ec2", "CreateRoute", {}),),
    "AWS::EC2::RouteTable": (("ec2", "CreateRouteTable", {}),),
    "AWS::EC2::SecurityGroup": (
        ("ec2", "CreateSecurityGroup", {"GroupDescription": "Description"}),
        ("ec2", "AuthorizeSecurityGroupIngress", {"SecurityGroupIngress": "IpPermissions"}),
        ("ec2", "AuthorizeSecurityGroupEgress", {"SecurityGroupEgress": "IpPermissions"}),
    ),
    "AWS::EC2::Subnet": (("ec2", "CreateSubnet", {}),),
    "AWS::EC2::SubnetRouteTableAssociation": (("ec2", "AssociateRouteTable", {}),),
    "AWS::EC2::VPC": (("ec2", "CreateVpc", {}),),
    "AWS::EC2::VPCEndpoint": (("ec2", "CreateVpcEndpoint", {}),),
    "AWS::EC2::VPCGatewayAttachment": (("ec2", "AttachInternetGateway", {}),),
    "AWS::ECR::Repository": (
        ("ecr", "CreateRepository", {}),
        ("ecr", "PutLifecyclePolicy", {"LifecyclePolicy.LifecyclePolicyText": "lifecyclePolicyText"}),
        ("ecr", "DeleteRepository", {"EmptyOnDelete": "force"}),
    ),
    "AWS::ECS::Cluster": (("ecs", "CreateCluster", {}),),
    "AWS::Events::Rule": (("events", "PutRule", {}), ("events", "PutTargets", {})),
    "AWS::IAM::ManagedPolicy": (("iam", "CreatePolicy", {}),),
    "AWS::IAM::Role": (
        ("iam", "CreateRole", {}),
        (
            "iam",
            "PutRolePolicy",
            {"Policies.*.PolicyName": "PolicyName", "Policies.*.PolicyDocument": "PolicyDocument"},
        ),
    ),
    "AWS::Lambda::EventInvokeConfig": (("lambda", "PutFunctionEventInvokeConfig", {}),),
    "AWS::Lambda::EventSourceMapping": (("lambda", "CreateEventSourceMapping", {}),),
    "AWS::Lambda::Function": (("lambda", "CreateFunction", {}), ("lambda", "PutFunctionRecursionConfig", {})),
    "AWS::Lambda::Permission": (("lambda", "AddPermission", {}),),
    "AWS::Logs::LogGroup": (("logs", "CreateLogGroup", {}), ("logs", "PutRetentionPolicy", {})),
    "AWS::Route53::RecordSet": (("route53", "ChangeResourceRecordSets", {}),),
    "AWS::S3::Bucket": (
        ("s3", "PutBucketVersioning", {}),
        ("s3", "PutPublicAccessBlock", {}),
        ("s3", "PutBucketOwnershipControls", {}),
    ),
    "AWS::SNS::Subscription": (("sns", "Subscribe", {}),),
    "AWS::SNS::Topic": (("sns", "CreateTopic", {"TopicName": "Name"}),),
    "AWS::SQS::Queue": (("sqs", "CreateQueue", {}),),
    "AWS::Scheduler::ScheduleGroup": (("scheduler", "CreateScheduleGroup", {}),),
}
NO_CALL = {
    "AWS::EC2::InternetGateway": "only tags",
    "AWS::S3::BucketPolicy": "a policy, which the model takes as any text",
    "AWS::SNS::TopicPolicy": "a policy, which is an attribute without a model",
    "AWS::SQS::QueuePolicy": "a policy, which is an attribute without a model",
}


@cache
def _input(service: str, operation: str) -> StructureShape:
    shape = botocore.session.get_session().get_service_model(service).operation_model(operation).input_shape
    assert isinstance(shape, StructureShape)
    return shape


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "")


def checks(one: Resource) -> Iterator[tuple[str, Shape, Any]]:
    """Every value of a resource that a model knows: where it is, its shape, and the value."""
    for service, operation, called in CALLS.get(one.kind, ()):
        shape = _input(service, operation)
        members = {_plain(name): member for name, member in shape.members.items()}
        for name, value in one.properties.items():
            if (member := members.get(_plain(called.get(name, name)))) is not None:
                yield from _inner(f"{one.name}.{name}", member, value)
        for path, name in called.items():
            if "." in path:
                for where, value in values(one.properties, path):
                    yield from _inner(f"{one.name}.{where}", shape.members[name], value)


def _inner(where: str, shape: Shape, value: Any) -> Iterator[tuple[str, Shape, Any]]:
    yield where, shape, value
    if isinstance(shape, StructureShape) and isinstance(value, dict):
        members = {_plain(name): member for name, member in shape.members.items()}
        for name, item in value.items():
            if (member := members.get(_plain(name))) is not None:
                yield from _inner(f"{where}.{name}", member, item)
    elif isinstance(shape, MapShape) and isinstance(value, dict):
        for name, item in value.items():
            yield from _inner(f"{where}.{name} (its name)", shape.key, name)
            yield from _inner(f"{where}.{name}", shape.value, item)
    elif isinstance(shape, ListShape) and isinstance(value, list):
        for number, item in enumerate(value):
            yield from _inner(f"{where}.{number}", shape.member, item)


def wrong(shape: Shape, value: Any) -> str:
    """Return what the model has against a value; "" for nothing."""
    limits = shape.metadata
    if isinstance(shape, (ListShape, MapShape)):
        return _outside(limits, len(value)) if isinstance(value, (list, dict)) else ""
    if shape.type_name == "string":
        document = isinstance(value, (dict, list))
        said = json.dumps(value, separators=(",", ":"), ensure_ascii=False) if document else str(value)
        if limits.get("enum") and said not in limits["enum"]:
            return f"none of {limits['enum'][:5]} …"
        if limits.get("pattern") and not re.fullmatch(limits["pattern"], said, re.DOTALL):
            return f"not {limits['pattern']}"
        return _outside(limits, len(said))
    if shape.type_name in ("integer", "long", "double", "float"):
        return _outside(limits, float(value))
    return ""


def _outside(limits: Mapping[str, Any], size: float) -> str:
    if size < limits.get("min", size) or size > limits.get("max", size):
        return f"{size:g} is not between {limits.get('min', '')} and {limits.get('max', '')}"
    return ""


def faults(there: Installation) -> Iterator[str]:
    """What the models have against an installation."""
    for one in there.everything.values():
        for where, shape, value in checks(one):
            if found := wrong(shape, value):
                yield f"{where} = {value!r}: {found}"
