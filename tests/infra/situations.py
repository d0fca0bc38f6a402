"""The template as it becomes in an account: with every condition on and off, and under the longest names that are allowed."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from hippodrome.deployment.aws import regions
from hippodrome.deployment.stack import settings
from testing import template as cfn

ACCOUNT = "123456789012"
STACK = "Hippodrome-of-thirty-letters-x"
"""As long as `hippodrome.deployment.aws.resource_names.STACK_NAME` allows, with all the characters that it allows."""
REGION = max(regions.SUPPORTED, key=len)
_HEX = "0123456789abcdef0"

_MADE = {  # what `Ref` of a resource is that gets no name from us
    "AWS::ApiGatewayV2::Api": "a1b2c3d4e5",
    "AWS::ApiGatewayV2::Integration": "a1b2c3d",
    "AWS::EC2::InternetGateway": f"igw-{_HEX}",
    "AWS::EC2::RouteTable": f"rtb-{_HEX}",
    "AWS::EC2::Subnet": f"subnet-{_HEX}",
    "AWS::EC2::VPC": f"vpc-{_HEX}",
}


def _domains() -> tuple[tuple[str, str], ...]:
    """Return the site's first part and the domain: one as long as it may be, then the other, then both short."""
    rest = settings.SITE_LENGTH - len(".")
    host = "h" * int(cfn.template()["Parameters"]["SiteHost"]["MaxLength"])
    return (
        ("s", f"{'d' * (rest - len('s') - len('.example'))}.example"),
        (host, f"{'d' * (rest - len(host) - len('.io'))}.io"),
        ("study", "example.org"),
    )


class Account(cfn.ReferenceValues):
    """An account in which numbers are numbers, and what CloudFormation names has names as long as they get."""

    def ref(self, name: str) -> Any:
        found = super().ref(name)
        return int(found) if self.of["Parameters"].get(name, {}).get("Type") == "Number" else found


def account(stack: str, parameters: Mapping[str, str], of: Mapping[str, Any]) -> Account:
    """Return an account with that installation, and what its references become there."""
    place = f"{REGION}:{ACCOUNT}"
    known: dict[str, str] = {}
    for name, one in of["Resources"].items():
        kind = one["Type"]
        called = f"{stack}-{name}-ABCDEFGHIJKL"
        if kind in _MADE:
            known[name] = _MADE[kind]
        elif kind == "AWS::EC2::SecurityGroup":
            known[f"{name}.GroupId"] = f"sg-{_HEX}"
        elif kind == "AWS::CertificateManager::Certificate":
            known[name] = f"arn:aws:acm:{place}:certificate/01234567-89ab-cdef-0123-456789abcdef"
        elif kind == "AWS::IAM::Role":
            known[f"{name}.Arn"] = f"arn:aws:iam::{ACCOUNT}:role/{called[:64]}"
        elif kind == "AWS::IAM::ManagedPolicy":
            known[name] = f"arn:aws:iam::{ACCOUNT}:policy/{called[:128]}"
        elif kind == "AWS::S3::Bucket":
            known[name] = called[:63].lower()
        elif kind == "AWS::ECR::Repository":
            known[name] = called.lower()
        elif kind == "AWS::ApiGatewayV2::DomainName":
            known[f"{name}.RegionalDomainName"] = f"d-a1b2c3d4e5.execute-api.{REGION}.amazonaws.com"
            known[f"{name}.RegionalHostedZoneId"] = "Z0123456789ABCDEFGHIJ"
    return Account(stack, ACCOUNT, REGION, parameters, known, of)


@dataclass(frozen=True)
class Resource:
    """One resource: its properties with all references resolved, and what the template says of it."""

    name: str
    kind: str
    properties: Mapping[str, Any]
    raw: Mapping[str, Any]

    @property
    def depends_on(self) -> set[str]:
        """The logical ids that it has to wait for: those it names, and those it refers to."""
        return set(cfn.listed(self.raw.get("DependsOn", []))) | set(references(self.raw.get("Properties", {})))


def references(value: Any) -> Iterator[str]:
    """The names that a value refers to by `Ref`, `Fn::GetAtt` and `Fn::Sub`."""
    if isinstance(value, list):
        for item in value:
            yield from references(item)
    elif isinstance(value, dict):
        for key, item in value.items():
            if key == "Ref":
                yield item
            elif key == "Fn::GetAtt":
                yield item[0]
            elif key == "Fn::Sub":
                yield from (name.partition(".")[0] for name in re.findall(r"\$\{([^}]+)\}", item))
            else:
                yield from references(item)


@dataclass(frozen=True)
class Installation:
    """A template in an account."""

    template: Mapping[str, Any]
    account: Account

    @cached_property
    def everything(self) -> dict[str, Resource]:
        """The resources that exist there, by logical id."""
        return {
            name: Resource(name, one["Type"], self.account.resolve(one.get("Properties", {})), one)
            for name, one in self.template["Resources"].items()
            if "Condition" not in one or self.account.holds(one["Condition"])
        }

    def of(self, kind: str) -> list[Resource]:
        """Return those of a type."""
        return [one for one in self.everything.values() if one.kind == kind]

    def waits_for(self, name: str) -> set[str]:
        """Return the logical ids that are made before a resource, directly or by way of others."""
        found: set[str] = set()
        ahead = [name]
        while ahead:
            for other in self.everything[ahead.pop()].depends_on & set(self.everything):
                if other not in found:
                    found.add(other)
                    ahead.append(other)
        return found


_CHOICES = (  # what turns each condition of the template on and off
    ({"VpcId": ""}, {"VpcId": f"vpc-{_HEX}", "SubnetIds": f"subnet-{_HEX},subnet-{_HEX[::-1]}"}),
    ({"AlarmEmail": ""}, {"AlarmEmail": "administrator.of.the.laboratory@psychology.example.org"}),
    ({"MonthlyBudget": "0"}, {"MonthlyBudget": "1000000"}),
    ({"ServerNames": "hash"}, {"ServerNames": "userId"}),
)


def _extremes(template: Mapping[str, Any], limit: str) -> dict[str, str]:
    """Return the least (`MinValue`) or the largest (`MaxValue`) number that each parameter takes."""
    return {name: str(one[limit]) for name, one in template["Parameters"].items() if limit in one}


def installations(of: Mapping[str, Any] | None = None) -> Iterator[Installation]:
    """Every choice of the conditions, with the longest names and the largest numbers; then other names, all small, and no domain."""
    template = of or cfn.template()
    plain = {
        "HostedZoneId": f"Z{'0' * 31}",
        "CodeBucket": f"{STACK.lower()}-code-{ACCOUNT}-{REGION}",
        "ServersHost": "v" * int(template["Parameters"]["ServersHost"]["MaxLength"]),
        "ZoneA": f"{REGION}a",
        "ZoneB": f"{REGION}b",
    }
    least, plain = plain | _extremes(template, "MinValue"), plain | _extremes(template, "MaxValue")
    first, *others = [{"SiteHost": site, "RootDomain": domain} for site, domain in _domains()]
    for choice in itertools.product(*_CHOICES):
        parameters: dict[str, str] = plain | first
        for one in choice:
            parameters |= one
        yield Installation(template, account(STACK, parameters, template))
    for names in others:
        yield Installation(template, account(STACK, plain | names, template))
    yield Installation(template, account("s", least | others[-1], template))
    yield Installation(template, account(STACK, plain | {"RootDomain": "", "HostedZoneId": ""}, template))
