"""Every region that is listed as supported has what the template needs, and cfn-lint says the same of it everywhere."""

from __future__ import annotations

import re
from pathlib import Path

import boto3
import pytest

from hippodrome.console.problem import Problem
from hippodrome.deployment.aws import regions
from hippodrome.deployment.code.template import Template
from tests.infra import schemas

ROOT = Path(__file__).resolve().parents[2]
BUDGET = "AWS::Budgets::Budget"


def types(region: str) -> set[str]:
    return {resource["Type"] for resource in Template.read().for_region(region).body["Resources"].values()}


@pytest.mark.parametrize("region", regions.SUPPORTED)
def test_a_supported_region_has_every_type_with_the_schema_that_was_linted(region: str) -> None:
    """So what cfn-lint finds in one region it finds in all of them; linting takes half a minute."""
    here, linted = schemas.of_region(region), schemas.of_region(schemas.LINTED)
    assert {kind: here.get(kind) for kind in types(region)} == {kind: linted[kind] for kind in types(region)}


SERVICES = (  # whose endpoints the template's types and the commands need in the region itself
    *("acm", "apigatewayv2", "cloudformation", "cloudwatch", "ec2", "ecr", "ecs", "events", "lambda"),
    *("logs", "resourcegroupstaggingapi", "s3", "scheduler", "service-quotas", "sns", "sqs", "sts"),
)


@pytest.mark.parametrize("service", SERVICES)
def test_a_supported_region_has_every_service(service: str) -> None:
    assert set(regions.SUPPORTED) <= set(boto3.Session().get_available_regions(service))


def test_where_cloudformation_makes_no_budgets_the_template_has_none_and_all_else() -> None:
    lacking = {region for region in regions.SUPPORTED if BUDGET not in schemas.of_region(region)}
    assert lacking == regions.WITHOUT_BUDGETS
    here, there = (Template.read().for_region(region).body["Resources"] for region in ("us-east-1", "eu-north-1"))
    assert here.keys() - there.keys() == {"Budget"}
    assert {name: here[name] for name in there} == there


def test_zones_without_fargate_are_those_of_supported_regions() -> None:
    assert set(regions.FARGATE_ZONES) <= set(regions.SUPPORTED)
    assert all(len(zones) >= 2 for zones in regions.FARGATE_ZONES.values()), "two subnets, each in a zone of its own"
    assert regions.runs_fargate("us-west-1", "usw1-az3")
    assert not regions.runs_fargate("us-west-1", "usw1-az2")
    assert regions.runs_fargate("us-east-1", "use1-az3")


def test_another_region_is_refused_with_the_nearest_supported_ones() -> None:
    regions.check("eu-west-1")
    with pytest.raises(Problem, match="cannot be installed in us-gov-west-1") as refused:
        regions.check("us-gov-west-1")
    near = ["us-east-1", "us-east-2", "us-west-1", "us-west-2"]
    assert re.findall(r"[a-z]{2}-[a-z]+-\d", refused.value.advice) == near
    with pytest.raises(Problem) as refused:
        regions.check("moon-base-1")
    assert set(re.findall(r"[a-z]{2}-[a-z]+-\d", refused.value.advice)) == set(regions.SUPPORTED)


def test_the_administrators_page_lists_them() -> None:
    text = (ROOT / "docs/aws.md").read_text()
    (line,) = [line for line in text.splitlines() if line.strip().startswith("Regions: ")]
    assert re.findall(r"`([a-z0-9-]+)`", line) == list(regions.SUPPORTED)
