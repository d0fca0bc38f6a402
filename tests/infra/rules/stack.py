"""Rules for the template as a whole: its size, its names, what waits for what."""

from __future__ import annotations

import itertools
import json
from collections import Counter
from collections.abc import Iterator
from typing import Any

from hippodrome.deployment.aws.resource_names import STACK_NAME
from tests.infra import schemas
from tests.infra.rules.book import Rule, Template, each, first, put, values
from tests.infra.situations import Installation, Resource, references

QUOTAS = "CloudFormation User Guide, Understand CloudFormation quotas"
WHOLE = "Template"

NAMES = {  # where a resource has the name that we give it
    "AWS::ApiGatewayV2::DomainName": "DomainName",
    "AWS::Budgets::Budget": "Budget.BudgetName",
    "AWS::CloudWatch::Alarm": "AlarmName",
    "AWS::CloudWatch::Dashboard": "DashboardName",
    "AWS::ECR::Repository": "RepositoryName",
    "AWS::ECS::Cluster": "ClusterName",
    "AWS::Events::Rule": "Name",
    "AWS::IAM::ManagedPolicy": "ManagedPolicyName",
    "AWS::IAM::Role": "RoleName",
    "AWS::Lambda::Function": "FunctionName",
    "AWS::Logs::LogGroup": "LogGroupName",
    "AWS::S3::Bucket": "BucketName",
    "AWS::SNS::Topic": "TopicName",
    "AWS::SQS::Queue": "QueueName",
    "AWS::Scheduler::ScheduleGroup": "Name",
}
IN_ALL_REGIONS = ("AWS::Budgets::Budget", "AWS::CloudWatch::Dashboard", "AWS::IAM::ManagedPolicy", "AWS::IAM::Role")
"""Types of which an account has one of a name, whatever the region."""

REPLACED = {  # what a change of a parameter replaces: of the new one and the old one both are there for a while
    ("AWS::ApiGatewayV2::DomainName", "DomainName"): {"RootDomain", "SiteHost"},  # another address
    ("AWS::CertificateManager::Certificate", "DomainName"): {"RootDomain", "SiteHost"},
    ("AWS::CertificateManager::Certificate", "DomainValidationOptions"): {"RootDomain", "SiteHost", "HostedZoneId"},
    ("AWS::EC2::SecurityGroup", "VpcId"): {"VpcId"},  # in another network; the plan says so
    ("AWS::EC2::Subnet", "AvailabilityZone"): {"ZoneA", "ZoneB"},  # which deploy keeps
    ("AWS::Route53::RecordSet", "HostedZoneId"): {"HostedZoneId"},
    ("AWS::SNS::Subscription", "Endpoint"): {"AlarmEmail"},  # another mailbox
}


def name_of(one: Resource) -> str | None:
    """Return the name that the template gives a resource, if it gives it any."""
    return next((str(found) for _, found in values(one.properties, NAMES.get(one.kind, "-"))), None)


def _at_most(part: str, most: int, entry: dict[str, Any]) -> Rule:
    def faults(there: Installation) -> Iterator[str]:
        if len(there.template[part]) > most:
            yield f"{len(there.template[part])} {part}"

    def spoil(template: Template) -> None:
        template[part] |= {f"More{number}": entry for number in range(most + 1)}

    return Rule(WHOLE, part, f"at most {most}", QUOTAS, faults, spoil)


def _described(part: str, key: str, most: int, source: str) -> Rule:
    def faults(there: Installation) -> Iterator[str]:
        for name, one in there.template[part].items():
            if len(str(one.get(key, "")).encode()) > most:
                yield f"{name}.{key} has more than {most} bytes"

    def spoil(template: Template) -> None:
        next(iter(template[part].values()))[key] = "é" * (most // 2 + 1)

    return Rule(WHOLE, f"{part}.{key}", f"at most {most} bytes", source, faults, spoil)


def _size(there: Installation) -> Iterator[str]:
    size = len(json.dumps(there.template).encode())
    if size > 1_000_000:
        yield f"{size} bytes"


def _long_description(there: Installation) -> Iterator[str]:
    if len(there.template["Description"].encode()) > 1024:
        yield "the description has more than 1,024 bytes"


def _ids(there: Installation) -> Iterator[str]:
    for part in ("Resources", "Parameters", "Outputs", "Conditions"):
        yield from (f"{name} in {part}" for name in there.template[part] if not name.isalnum() or len(name) > 255)


def _values(there: Installation) -> Iterator[str]:
    for name, one in there.template["Outputs"].items():
        if "Condition" not in one and len(str(there.account.resolve(one["Value"])).encode()) > 1024:
            yield f"the output {name} is longer than 1,024 bytes"


def _twins(there: Installation) -> Iterator[str]:
    names = Counter((one.kind, name) for one in there.everything.values() if (name := name_of(one)) is not None)
    yield from (f"{count} of {kind} are called {name}" for (kind, name), count in names.items() if count > 1)


def _everywhere(there: Installation) -> Iterator[str]:
    for one in there.everything.values():
        name = name_of(one) if one.kind in IN_ALL_REGIONS else None
        if name is not None and there.account.region not in name:
            yield f"{one.name} is called {name} in every region"


def _not_the_stacks(there: Installation) -> Iterator[str]:
    for one in there.everything.values():
        name = name_of(one)
        if name is not None and there.account.stack not in name and one.kind != "AWS::ApiGatewayV2::DomainName":
            yield f"{one.name} is called {name} in every installation"


def _alike(there: Installation) -> Iterator[str]:
    """A stack called like this one and a part of a name, such as lab-start beside lab, has names of its own."""
    stack = there.account.stack
    endings: dict[str, set[str]] = {}
    for one in there.everything.values():
        name = name_of(one)
        if name is not None and name.startswith(stack):
            endings.setdefault(one.kind, set()).add(name.removeprefix(stack))
    for kind, found in endings.items():
        for long, short in itertools.permutations(sorted(found), 2):
            if short and long.endswith(short) and STACK_NAME.fullmatch(f"x{long.removesuffix(short)}"):
                yield f"{kind}: {stack}{long} may be that of the stack {stack}{long.removesuffix(short)}, too"


def _beyond_ascii(there: Installation) -> Iterator[str]:
    for one in there.everything.values():
        if not json.dumps(one.properties, ensure_ascii=False).isascii():
            yield f"{one.name} is not plain ASCII"
    for name, output in there.template["Outputs"].items():
        if not json.dumps(output, ensure_ascii=False).isascii():
            yield f"the output {name} is not plain ASCII"


def _stuck(there: Installation) -> Iterator[str]:
    """With a fixed name nothing else may be create-only: the replacement would have the name of what it replaces."""
    for one in there.everything.values():
        if name_of(one) is None or one.kind == "AWS::ApiGatewayV2::DomainName":
            continue
        fixed = {
            place.removeprefix("/properties/").replace("/", ".")
            for place in schemas.schema(one.kind)["createOnlyProperties"]
        }
        for place in fixed - {NAMES[one.kind]}:
            if any(True for _ in values(one.properties, place)):
                yield f"{one.name} has a fixed name, and {place} cannot be changed"


def _unstable(there: Installation) -> Iterator[str]:
    for one in there.everything.values():
        for place in schemas.schema(one.kind).get("createOnlyProperties", ()):
            path = place.removeprefix("/properties/").replace("/", ".")
            for _, value in values(one.raw.get("Properties", {}), path):
                given = set(references(value)) & set(there.template["Parameters"])
                for parameter in sorted(given - REPLACED.get((one.kind, path), set())):
                    yield f"{one.name} is replaced when {parameter} changes ({path})"


def _circles(there: Installation) -> Iterator[str]:
    yield from (f"{name} waits for itself" for name in there.everything if name in there.waits_for(name))


def _wrong_tags(one: Resource, there: Installation) -> Iterator[str]:
    tags = one.properties.get("Tags", [])
    if len(tags) > 50:
        yield f"{len(tags)} tags"
    for tag in tags:
        if tag["Key"].lower().startswith("aws:") or not 1 <= len(tag["Key"]) <= 128 or len(str(tag["Value"])) > 256:
            yield f"the tag {tag['Key']}"


def _same_queue(template: Template) -> None:
    queues = [one for one in template["Resources"].values() if one["Type"] == "AWS::SQS::Queue"]
    queues[1]["Properties"]["QueueName"] = queues[0]["Properties"]["QueueName"]


def _circle(template: Template) -> None:
    template["Resources"]["StartQueuePolicy"]["DependsOn"] = "StartSubscription"


def _name(kind: str, path: str, new: Any) -> Any:
    return lambda template: put(first(template, kind), path, new)


RULES = (
    _at_most("Resources", 500, {"Type": "AWS::SNS::Topic"}),
    _at_most("Parameters", 200, {"Type": "String", "Default": ""}),
    _at_most("Outputs", 200, {"Value": "x"}),
    _described("Parameters", "Description", 4000, "CloudFormation User Guide, Parameters"),
    _described("Outputs", "Description", 1024, "CloudFormation User Guide, Outputs"),
    Rule(WHOLE, "", "at most 1 MB, from S3", QUOTAS, _size, lambda t: t.update(Metadata={"x": "x" * 1_000_000})),
    Rule(
        WHOLE,
        "Description",
        "at most 1,024 bytes",
        QUOTAS,
        _long_description,
        lambda t: t.update(Description="x" * 1025),
    ),
    Rule(
        WHOLE,
        "logical ids",
        "letters and digits, at most 255",
        "CloudFormation User Guide, Resources: logical ID",
        _ids,
        lambda t: t["Resources"].update({"Start-Queue": t["Resources"]["StartQueue"]}),
    ),
    Rule(
        WHOLE,
        "Outputs.Value",
        "at most 1,024 bytes",
        "CloudFormation User Guide, Outputs",
        _values,
        lambda t: t["Outputs"]["Site"].update(Value="x" * 1025),
    ),
    Rule(
        WHOLE,
        "names",
        "no two of a type and name in an account and region",
        "CloudFormation User Guide, Name type",
        _twins,
        _same_queue,
    ),
    Rule(
        WHOLE,
        "names",
        "the region in names that an account has once",
        "CloudWatch API Reference, PutDashboard; AWS Budgets API Reference, Budget: unique within an account; IAM User "
        "Guide, IAM and AWS STS quotas: names are unique within an account",
        _everywhere,
        _name("AWS::CloudWatch::Dashboard", "DashboardName", {"Ref": "AWS::StackName"}),
    ),
    Rule(
        WHOLE,
        "names",
        "the stack's name in every name, so that an account takes two installations",
        "CloudFormation User Guide, Name type",
        _not_the_stacks,
        _name("AWS::SNS::Topic", "TopicName", "start-server"),
    ),
    Rule(
        WHOLE,
        "names",
        "no name that is also that of a stack called like this one and a part of the name",
        "CloudFormation User Guide, Name type",
        _alike,
        _name("AWS::SQS::Queue", "QueueName", {"Fn::Sub": "${AWS::StackName}-tasks-stop"}),
    ),
    Rule(
        WHOLE,
        "Properties",
        "ASCII: CloudFormation shows question marks for anything else, and services such as EC2 refuse it",
        'cloudformation-coverage-roadmap 814 and 1220; "Character sets beyond ASCII are not supported" (hezo-ai/hezo 731)',
        _beyond_ascii,
        _name("AWS::CloudWatch::Alarm", "AlarmDescription", "Ein Server fällt aus"),
    ),
    Rule(
        WHOLE,
        "names",
        "no fixed name where something else is create-only",
        "CloudFormation User Guide, Name type: a resource with a custom name cannot be replaced; createOnlyProperties of "
        'the registry\'s schemas; "the budget already exists" (cloudformation-coverage-roadmap 365)',
        _stuck,
        _name("AWS::Budgets::Budget", "Budget.BudgetName", {"Fn::Sub": "${AWS::StackName}-${AWS::Region}-monthly"}),
    ),
    Rule(
        WHOLE,
        "Properties",
        "only what is known to stand a replacement has create-only properties that parameters decide",
        "createOnlyProperties of the registry's schemas; CloudFormation User Guide, Update behaviors of stack resources",
        _unstable,
        _name("AWS::SQS::Queue", "QueueName", {"Fn::Sub": "${AWS::StackName}-${SiteHost}-start"}),
    ),
    Rule(
        WHOLE,
        "DependsOn",
        "no circles",
        "CloudFormation User Guide, DependsOn attribute: circular dependencies",
        _circles,
        _circle,
    ),
    *(
        each(
            kind,
            "Tags",
            "at most 50; keys of 128 characters that do not begin with aws:, values of 256",
            "Tagging AWS Resources, Tag naming limits and requirements",
            _wrong_tags,
            _name(kind, "Tags", [{"Key": "aws:name", "Value": "x"}]),
        )
        for kind in ("AWS::EC2::VPC", "AWS::EC2::Subnet", "AWS::EC2::RouteTable", "AWS::EC2::InternetGateway")
    ),
)
