"""Every property is what the models of AWS's calls and CloudFormation's schemas take, with all names as long as they get."""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator
from typing import Any

import jsonschema
import pytest

from testing import template as cfn
from tests.infra import schemas, shapes
from tests.infra.rules.book import setting
from tests.infra.situations import Installation, installations

LIMITS = {"min", "max", "pattern", "enum"}


def against_schemas(there: Installation) -> Iterator[str]:
    """What CloudFormation's schemas have against the properties as they become (cfn-lint reads them as they stand)."""
    for one in there.everything.values():
        validator = jsonschema.Draft7Validator(schemas.schema(one.kind))
        for error in validator.iter_errors(json.loads(json.dumps(one.properties))):
            yield f"{one.name}.{'.'.join(map(str, error.path))}: {error.message[:200]}"


def test_the_models_of_the_calls_accept_every_value() -> None:
    assert sorted({fault for there in installations() for fault in shapes.faults(there)}) == []


def test_the_schemas_accept_every_value() -> None:
    assert sorted({fault for there in installations() for fault in against_schemas(there)}) == []


def test_every_type_has_its_calls() -> None:
    used = {one["Type"] for one in cfn.template()["Resources"].values()}
    assert set(shapes.CALLS) | set(shapes.NO_CALL) == used
    assert not set(shapes.CALLS) & set(shapes.NO_CALL)


def test_limits_of_the_calls_are_checked() -> None:
    found = [check for one in next(installations()).everything.values() for check in shapes.checks(one)]
    kinds = {kind for _, shape, _ in found for kind in LIMITS & set(shape.metadata)}
    assert kinds == LIMITS
    assert sum(1 for _, shape, _ in found if LIMITS & set(shape.metadata)) > 500


@pytest.mark.parametrize(
    ("kind", "path", "value"),
    [
        ("AWS::ApiGatewayV2::Api", "ProtocolType", "HTTP2"),
        ("AWS::CertificateManager::Certificate", "DomainName", "-x.example.org"),
        ("AWS::CloudWatch::Alarm", "Statistic", "Mean"),
        ("AWS::ECR::Repository", "LifecyclePolicy.LifecyclePolicyText", "{}"),
        ("AWS::Events::Rule", "Targets.*.Id", "x" * 65),
        ("AWS::IAM::ManagedPolicy", "PolicyDocument.Id", "…"),
        ("AWS::IAM::Role", "Policies.*.PolicyName", "a b"),
        ("AWS::Lambda::EventSourceMapping", "ScalingConfig.MaximumConcurrency", 1),
        ("AWS::Lambda::Function", "FunctionName", "x y"),
        ("AWS::Lambda::Function", "Environment.Variables", {"a-b": "1"}),
        ("AWS::Lambda::Permission", "Action", "InvokeFunction"),
        ("AWS::Logs::LogGroup", "LogGroupName", "a b"),
        (
            "AWS::Scheduler::ScheduleGroup",
            "Name",
            {"Fn::Sub": "${AWS::StackName}-of-the-timers-that-stop-every-server-x"},
        ),
    ],
)
def test_a_value_that_a_call_refuses_is_noticed(kind: str, path: str, value: Any) -> None:
    spoiled: dict[str, Any] = copy.deepcopy(cfn.template())
    setting(kind, path, value)(spoiled)
    assert any(True for there in installations(spoiled) for _ in shapes.faults(there))


@pytest.mark.parametrize(
    ("kind", "path", "value"),
    [
        ("AWS::Lambda::Function", "MemorySize", "much"),
        ("AWS::SQS::Queue", "VisibilityTimeOut", 90),
        ("AWS::Logs::LogGroup", "LogGroupName", {"Fn::Sub": "/hippodrome/${AWS::StackName}/a b"}),
    ],
)
def test_a_value_that_a_schema_refuses_is_noticed(kind: str, path: str, value: Any) -> None:
    spoiled: dict[str, Any] = copy.deepcopy(cfn.template())
    setting(kind, path, value)(spoiled)
    assert any(True for there in installations(spoiled) for _ in against_schemas(there))
