"""Reads `infra/template.yml` as data, and resolves its references for an account."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml

NO_VALUE = object()
"""What `AWS::NoValue` is resolved to: the entry is left out."""
DOMAIN = {"RootDomain": "the-RootDomain", "HostedZoneId": "the-HostedZoneId"}
PATH = Path(__file__).resolve().parents[1] / "infra" / "template.yml"


_Safe: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # as in hippodrome/deployment/code/template.py


class _Loader(_Safe):  # type: ignore[misc]
    """YAML with CloudFormation's short forms: `!Ref x` is `{"Ref": "x"}`, `!Sub x` is `{"Fn::Sub": "x"}`."""


def _short_form(loader: Any, tag: str, node: yaml.Node) -> dict[str, Any]:
    if isinstance(node, yaml.ScalarNode):
        value: Any = loader.construct_scalar(node)
    elif isinstance(node, yaml.SequenceNode):
        value = loader.construct_sequence(node, deep=True)
    else:
        assert isinstance(node, yaml.MappingNode)
        value = loader.construct_mapping(node, deep=True)
    if tag == "GetAtt" and isinstance(value, str):
        value = value.split(".", 1)
    return {tag if tag in ("Ref", "Condition") else f"Fn::{tag}": value}


_Loader.add_multi_constructor("!", _short_form)


@cache
def template() -> dict[str, Any]:
    """Return the template. All callers share the result, so copy it before you change it."""
    found: dict[str, Any] = yaml.load(PATH.read_text(encoding="utf-8"), _Loader)
    return found


def resources(kind: str, of: Mapping[str, Any] | None = None) -> dict[str, dict[str, Any]]:
    """Return, by logical id, the properties of the resources of a type, such as `AWS::Lambda::Function`.

    `of`, here and in the other functions: another template than `infra/template.yml`.
    """
    found = (of or template())["Resources"]
    return {name: one.get("Properties", {}) for name, one in found.items() if one["Type"] == kind}


def functions(of: Mapping[str, Any] | None = None) -> dict[str, str]:
    """Return, by the name of each function's file in `lambdas/`, the function's logical id."""
    return {p["Handler"].split(".")[1]: name for name, p in resources("AWS::Lambda::Function", of).items()}


@dataclass
class ReferenceValues:
    """The values of the template's references in one account (`id` is the account's).

    Without `parameters` it has a domain. `known` has the values of resources that exist already, by `Ref` ("Bucket") or attribute ("Bucket.Arn").
    """

    stack: str = "hippodrome"
    id: str = "123456789012"
    region: str = "us-east-1"
    parameters: Mapping[str, str] = field(default_factory=lambda: DOMAIN)
    known: Mapping[str, str] = field(default_factory=dict)
    of: Mapping[str, Any] = field(default_factory=template)

    def resolve(self, value: Any) -> Any:
        """Return the value with its intrinsic functions evaluated.

        Raises KeyError for a reference to nothing, and for an intrinsic function that is not implemented here.
        """
        if isinstance(value, list):
            return [resolved for item in value if (resolved := self.resolve(item)) is not NO_VALUE]
        if not isinstance(value, dict):
            return value
        if len(value) == 1:
            (name, argument), *_ = value.items()
            if name == "Ref":
                return self.ref(argument)
            if name == "Fn::GetAtt":
                return self.attribute(*argument)
            if name == "Fn::Sub":
                return re.sub(r"\$\{([^}]+)\}", lambda m: str(self._named(m[1])), argument)
            if name == "Fn::If":
                return self.resolve(argument[1 if self.holds(argument[0]) else 2])
            if name == "Fn::Select":
                return self.resolve(argument[1])[int(argument[0])]
            if name == "Fn::GetAZs":
                return [f"{self.region}{letter}" for letter in "abc"]
            if name.startswith("Fn::"):
                raise KeyError(name)
        return {key: resolved for key, item in value.items() if (resolved := self.resolve(item)) is not NO_VALUE}

    def holds(self, condition: str | dict[str, Any]) -> bool:
        """Return whether a condition is true: its name, or an expression of Fn::Equals and Fn::Not."""
        expression = self.of["Conditions"][condition] if isinstance(condition, str) else condition
        ((name, argument),) = expression.items()
        if name == "Fn::Not":
            return not self.holds(argument[0])
        left, right = map(self.resolve, argument)
        return str(left) == str(right)

    def ref(self, name: str) -> Any:
        """Return the value of `Ref`; for a parameter without value and default `the-{name}`."""
        if name in self.known:
            return self.known[name]
        if name.startswith("AWS::"):
            return self._pseudo(name)
        if name in self.of["Parameters"]:
            given = self.parameters.get(name, self.of["Parameters"][name].get("Default"))
            return f"the-{name}" if given is None else str(given)
        one = self.of["Resources"][name]
        if one["Type"] in ("AWS::SNS::Topic", "AWS::IAM::ManagedPolicy", "AWS::CertificateManager::Certificate"):
            return self.attribute(name, "Arn")
        return self._name(name)

    def attribute(self, name: str, attribute: str) -> str:
        """Return the value of `Fn::GetAtt`."""
        if f"{name}.{attribute}" in self.known:
            return self.known[f"{name}.{attribute}"]
        kind = self.of["Resources"][name]["Type"]
        if attribute != "Arn" or kind not in _ARNS:
            return f"{self._name(name)}-{attribute}"
        place = f"{self.region}:{self.id}"
        return _ARNS[kind].format(place=place, id=self.id, name=self.known.get(name) or self._name(name))

    def _named(self, text: str) -> Any:
        name, _, attribute = text.partition(".")
        return self.attribute(name, attribute) if attribute else self.ref(name)

    def _name(self, name: str) -> str:
        """Return the resource's name in the template, or else one like CloudFormation makes."""
        properties = self.of["Resources"][name].get("Properties", {})
        for key in ("FunctionName", "QueueName", "TopicName", "LogGroupName", "ClusterName", "DashboardName", "Name"):
            if key in properties and self.of["Resources"][name]["Type"] in _NAMED:
                return str(self.resolve(properties[key]))
        return f"{self.stack}-{name}"

    def _pseudo(self, name: str) -> Any:
        return {
            "AWS::AccountId": self.id,
            "AWS::NoValue": NO_VALUE,
            "AWS::Partition": "aws",
            "AWS::Region": self.region,
            "AWS::StackId": f"arn:aws:cloudformation:{self.region}:{self.id}:stack/{self.stack}/1",
            "AWS::StackName": self.stack,
            "AWS::URLSuffix": "amazonaws.com",
        }[name]


_ARNS = {
    "AWS::CloudWatch::Alarm": "arn:aws:cloudwatch:{place}:alarm:{name}",
    "AWS::ECR::Repository": "arn:aws:ecr:{place}:repository/{name}",
    "AWS::ECS::Cluster": "arn:aws:ecs:{place}:cluster/{name}",
    "AWS::Events::Rule": "arn:aws:events:{place}:rule/{name}",
    "AWS::IAM::ManagedPolicy": "arn:aws:iam::{id}:policy/{name}",
    "AWS::IAM::Role": "arn:aws:iam::{id}:role/{name}",
    "AWS::Lambda::Function": "arn:aws:lambda:{place}:function:{name}",
    "AWS::Logs::LogGroup": "arn:aws:logs:{place}:log-group:{name}:*",
    "AWS::S3::Bucket": "arn:aws:s3:::{name}",
    "AWS::SNS::Topic": "arn:aws:sns:{place}:{name}",
    "AWS::SQS::Queue": "arn:aws:sqs:{place}:{name}",
    "AWS::Scheduler::ScheduleGroup": "arn:aws:scheduler:{place}:schedule-group/{name}",
}
_NAMED = {*_ARNS, "AWS::CloudWatch::Dashboard"} - {"AWS::IAM::Role", "AWS::IAM::ManagedPolicy"}


def statements(of: Mapping[str, Any] | None = None) -> Iterator[tuple[str, dict[str, Any]]]:
    """Yield every statement of every policy, unresolved, with the logical id of its resource."""
    for name, one in (of or template())["Resources"].items():
        for document in _documents(one.get("Properties", {})):
            for statement in document["Statement"]:
                yield name, statement["Fn::If"][1] if "Fn::If" in statement else statement


def role_documents(role: str, of: Mapping[str, Any] | None = None) -> list[dict[str, Any]]:
    """Return the documents of a role's inline policies, unresolved. Raises AssertionError if it has managed ones."""
    properties = (of or template())["Resources"][role]["Properties"]
    assert not properties.get("ManagedPolicyArns"), f"{role} has managed policies, which the tests do not read"
    return [policy["PolicyDocument"] for policy in properties.get("Policies", [])]


def _documents(value: Any) -> Iterator[dict[str, Any]]:
    if isinstance(value, list):
        for item in value:
            yield from _documents(item)
    elif isinstance(value, dict):
        if "Statement" in value:
            yield value
        else:
            for item in value.values():
                yield from _documents(item)


def listed(value: Any) -> list[Any]:
    """Return an element of a policy as a list."""
    return value if isinstance(value, list) else [value]
