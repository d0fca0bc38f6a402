"""Least privilege in the template: a wildcard stands only where AWS has no narrower word."""

from __future__ import annotations

import copy
import json
import re
from typing import Any

import pytest

from testing import template as cfn

# Actions that know no resources, or only one that nobody can name beforehand; see the reasons beside them in the template.
ON_EVERYTHING = {
    "ce:GetCostAndUsage": "knows no resources",
    "cloudwatch:GetMetricData": "knows no resources",
    "ec2:DescribeNetworkInterfaces": "knows no resources",
    "ecr:GetAuthorizationToken": "knows no resources",
    "ecs:DescribeTaskDefinition": "knows no resources",
    "ecs:ListClusters": "knows no resources",
    "ecs:ListTasks": "the tasks of a cluster are no resource; the condition names the cluster",
    "scheduler:ListSchedules": "knows no resources",
    "ssm:DescribeParameters": "knows no resources",
}
WITH_CONDITION = {
    "ecs:ListTasks": "ecs:cluster",
    "ecs:DescribeTasks": "ecs:cluster",
    "ecs:RunTask": "ecs:cluster",
    "ecs:StopTask": "ecs:cluster",
    "iam:PassRole": "iam:PassedToService",
    "route53:ChangeResourceRecordSets": "route53:ChangeResourceRecordSetsNormalizedRecordNames",
}
"""Actions that are never allowed without this condition key."""

# A "*" within a resource: a part of the name that only a run gives.
PARTIAL = re.compile(
    r"""the-bucket/( \*/(steps|users|slots|handovers|sessions|lobby)/.* | \*/\*\.html
        | (_servers|_slots|_warm|_lobby|_lobbies|_cells|SSL)/\* | _match/\*/waiting\.json )
      | arn:aws:ecs:[^*]*:task-definition/hippodrome(:|-)\*
      | arn:aws:ecs:[^*]*:(cluster|task)/s\?{20}-\*(/\*)?
      | arn:aws:ecs:[^*]*:task/hippodrome/\*
      | arn:aws:logs:[^*]*:log-group:/hippodrome/hippodrome/[a-z_]+:\*
      | arn:aws:logs:[^*]*:log-group:/hippodrome/hippodrome/\*
      | arn:aws:cloudformation:[^*]*:stack/hippodrome/\*
      | arn:aws:cloudwatch:[^*]*:alarm:\*
      | arn:aws:route53:::change/\*
      | arn:aws:scheduler:[^*]*:schedule/hippodrome/\*""",
    re.VERBOSE,
)


def allowances(of: dict[str, Any] | None = None) -> list[tuple[str, dict[str, Any]]]:
    account = cfn.ReferenceValues(known={"Bucket.Arn": "the-bucket"}, of=of or cfn.template())
    found = [(name, account.resolve(statement)) for name, statement in cfn.statements(of)]
    return [(name, statement) for name, statement in found if statement["Effect"] == "Allow"]


def faults(of: dict[str, Any] | None = None) -> list[str]:
    """Everything in the policies that is wider than it need be, in sentences."""
    found = []
    for name, statement in allowances(of):
        actions = cfn.listed(statement["Action"])
        if {"NotAction", "NotResource", "NotPrincipal"} & set(statement):
            found.append(f"{name}: allows all but something")
        if statement.get("Principal") in ("*", {"AWS": "*"}):
            found.append(f"{name}: allows everybody")
        found += [f"{name}: {action} is a wildcard" for action in actions if "*" in action or "?" in action]
        for resource in cfn.listed(statement.get("Resource", [])):
            if resource == "*":
                found += [f"{name}: {action} on everything" for action in actions if action not in ON_EVERYTHING]
            elif "*" in resource and not PARTIAL.fullmatch(resource):
                found.append(f"{name}: {resource} is too wide")
        keys = {key for test in statement.get("Condition", {}).values() for key in test}
        for action in set(actions) & set(WITH_CONDITION):
            if WITH_CONDITION[action] not in keys:
                found.append(f"{name}: {action} without {WITH_CONDITION[action]}")
    return found


def test_no_policy_is_wider_than_necessary() -> None:
    assert faults() == []


def test_every_exception_is_used() -> None:
    everything = {
        action
        for _, statement in allowances()
        for action in cfn.listed(statement["Action"])
        if "*" in cfn.listed(statement.get("Resource", []))
    }
    assert everything == set(ON_EVERYTHING)


def test_every_wildcard_has_its_reason_beside_it() -> None:
    lines = cfn.PATH.read_text().splitlines()
    stars = [line for line in lines if re.search(r"""Resource: \[?["']\*["']""", line)]
    assert len(stars) >= len(ON_EVERYTHING)
    for line in [*stars, *[line for line in lines if "change/*" in line]]:
        assert re.search(r"  # \w+ \w+", line), line


def test_statements_for_all_principals_only_deny() -> None:
    everybody = [s for _, s in cfn.statements() if s.get("Principal") in ("*", {"AWS": "*"})]
    assert [s["Effect"] for s in everybody] == ["Deny"]


def test_services_may_act_for_this_account_only() -> None:
    """A service's right to use our topics and queues, or to assume a role, is bound to our own resources."""
    for name, statement in cfn.statements():
        principal = statement.get("Principal", {})
        services = cfn.listed(principal.get("Service", [])) if isinstance(principal, dict) else []
        if services and services != ["lambda.amazonaws.com"]:  # Lambda passes no key when it assumes a function's role
            keys = {key for test in statement["Condition"].values() for key in test}
            assert keys & {"aws:SourceArn", "aws:SourceAccount"}, name


Breaker = Any


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        (lambda s: s.update(Action="s3:*"), "s3:* is a wildcard"),
        (lambda s: s.update(Action="s3:Get*"), "s3:Get* is a wildcard"),
        (lambda s: s.update(Resource="*"), "on everything"),
        (lambda s: s.update(Resource={"Fn::Sub": "${Bucket.Arn}/*"}), "too wide"),
        (lambda s: s.update(Action="iam:PassRole"), "without iam:PassedToService"),
        (lambda s: s.update(NotResource=s.pop("Resource")), "all but something"),
    ],
)
def test_a_wider_policy_is_noticed(change: Breaker, fault: str) -> None:
    wider = copy.deepcopy(cfn.template())
    document = wider["Resources"]["NextStepRole"]["Properties"]["Policies"][0]["PolicyDocument"]
    statement = next(s for s in document["Statement"] if s["Action"] == "s3:PutObject")
    change(statement)
    assert any(fault in found for found in faults(wider)), json.dumps(faults(wider))
