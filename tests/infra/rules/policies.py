"""Rules for roles and policies."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from fnmatch import fnmatchcase
from typing import Any

from testing.template import listed
from tests.infra.rules.book import Rule, Template, each, first, put, text
from tests.infra.situations import Installation, Resource

ROLE, MANAGED, FUNCTION = "AWS::IAM::Role", "AWS::IAM::ManagedPolicy", "AWS::Lambda::Function"
QUOTAS = "IAM User Guide, IAM and AWS STS quotas: character limits, without white space"
_WITHOUT_NAMES = re.compile(r"[\t\n\r\u0020-\u00ff]*")


def _size(document: Any) -> int:
    return len(json.dumps(document, separators=(",", ":"), ensure_ascii=False))


def _documents(one: Resource) -> list[dict[str, Any]]:
    found = [one.properties[key] for key in ("PolicyDocument", "AssumeRolePolicyDocument") if key in one.properties]
    return [*found, *(policy["PolicyDocument"] for policy in one.properties.get("Policies", []))]


def _inline(one: Resource, there: Installation) -> Iterator[str]:
    size = sum(_size(policy["PolicyDocument"]) for policy in one.properties.get("Policies", []))
    if size > 10_240:
        yield f"its policies have {size} characters"


def _trust(one: Resource, there: Installation) -> Iterator[str]:
    if _size(one.properties["AssumeRolePolicyDocument"]) > 2048:
        yield "its trust policy is longer than 2,048 characters"


def _managed(one: Resource, there: Installation) -> Iterator[str]:
    if (size := _size(one.properties["PolicyDocument"])) > 6144:
        yield f"it has {size} characters"


def _strange(one: Resource, there: Installation) -> Iterator[str]:
    for document in _documents(one):
        if not _WITHOUT_NAMES.fullmatch(json.dumps(document, ensure_ascii=False)):
            yield "a policy has characters beyond Latin-1"


def _ill_formed(one: Resource, there: Installation) -> Iterator[str]:
    for document in _documents(one):
        if document.get("Version") != "2012-10-17":
            yield f"a policy of version {document.get('Version')}"
        sids = [statement["Sid"] for statement in document["Statement"] if "Sid" in statement]
        yield from (f"the Sid {sid}" for sid in sids if not re.fullmatch(r"[A-Za-z0-9]+", sid))
        if len(sids) != len(set(sids)):
            yield "two statements with one Sid"
        for statement in document["Statement"]:
            yield from (
                f"the action {action}"
                for action in listed(statement["Action"])
                if not re.fullmatch(r"[a-z0-9-]+:[A-Za-z0-9*?]+", action)
            )


def _names_of_policies(one: Resource, there: Installation) -> Iterator[str]:
    names = [policy["PolicyName"] for policy in one.properties.get("Policies", [])]
    if len(names) != len(set(names)):
        yield "two policies with one name"


def _comes(service: str, there: Installation) -> str:
    """Return the `aws:SourceArn` with which a service asks for a role; "" where it sends none."""
    place = f"{there.account.region}:{there.account.id}"
    (group,) = there.of("AWS::Scheduler::ScheduleGroup")
    (cluster,) = there.of("AWS::ECS::Cluster")
    return {
        "lambda.amazonaws.com": "",
        "scheduler.amazonaws.com": f"arn:aws:scheduler:{place}:schedule-group/{group.properties['Name']}",
        "ecs-tasks.amazonaws.com": f"arn:aws:ecs:{place}:task/{cluster.properties['ClusterName']}/0123456789abcdef",
    }[service]


def _untrusting(one: Resource, there: Installation) -> Iterator[str]:
    """A condition that the service does not meet: the role is made, and nobody can assume it."""
    for statement in one.properties["AssumeRolePolicyDocument"]["Statement"]:
        service = statement["Principal"]["Service"]
        arn = _comes(service, there)
        sent = {"aws:SourceArn": arn, "aws:SourceAccount": there.account.id if arn else ""}
        for operator, keys in statement.get("Condition", {}).items():
            for key, wanted in keys.items():
                like = operator in {"ArnLike", "ArnEquals", "StringLike"}
                met = fnmatchcase(sent.get(key, ""), wanted) if like else sent.get(key) == wanted
                if not met:
                    yield f"{service} comes with {key} {sent.get(key)!r}, and {wanted!r} is trusted"


def _blind(one: Resource, there: Installation) -> Iterator[str]:
    """Who may only compare and swap has to be allowed to read as well: S3 tells the writer whether the ETag is the same."""
    allowed = [
        statement
        for policy in one.properties.get("Policies", [])
        for statement in policy["PolicyDocument"]["Statement"]
        if statement["Effect"] == "Allow"
    ]
    read = [arn for found in allowed if "s3:GetObject" in listed(found["Action"]) for arn in listed(found["Resource"])]
    for statement in allowed:
        if statement.get("Condition", {}).get("Null", {}).get("s3:if-match") == "false":
            for arn in listed(statement["Resource"]):
                if not any(fnmatchcase(arn, pattern) for pattern in read):
                    yield f"it may compare and swap {arn}, and not read it"


def _edited(there: Installation) -> Iterator[str]:
    found = there.everything["ResearcherPolicy"].properties.get("Description")
    if found != DESCRIPTION:
        yield f"ResearcherPolicy's description was {DESCRIPTION!r}; a policy that is attached cannot be replaced"


DESCRIPTION = "What a researcher needs for the commands register, status, data, cost and logs"


def _statement(resource: str) -> Any:
    return {"Effect": "Allow", "Action": "s3:GetObject", "Resource": [resource * 40 for _ in range(40)]}


def _wide(template: Template) -> None:
    first(template, ROLE)["Policies"][0]["PolicyDocument"]["Statement"].append(_statement("arn:aws:s3:::x"))


def _trusting(template: Template) -> None:
    statement = first(template, ROLE)["AssumeRolePolicyDocument"]["Statement"][0]
    statement["Condition"] = {"StringEquals": {"aws:SourceAccount": [f"{number:012}" for number in range(150)]}}


def _wide_managed(template: Template) -> None:
    first(template, MANAGED)["PolicyDocument"]["Statement"].append(_statement("arn:aws:s3:::x"))


def _foreign(template: Template) -> None:
    first(template, ROLE)["Policies"][0]["PolicyDocument"]["Statement"][0]["Resource"] = "arn:aws:s3:::…"


def _sid(template: Template) -> None:
    first(template, ROLE)["Policies"][0]["PolicyDocument"]["Statement"][0]["Sid"] = "image-and-log"


def _blinded(template: Template) -> None:
    for statement in template["Resources"]["SweepRole"]["Properties"]["Policies"][0]["PolicyDocument"]["Statement"]:
        if statement.get("Action") == "s3:GetObject":
            statement["Resource"].remove({"Fn::Sub": "${Bucket.Arn}/_lobbies/*"})


RULES = (
    each(
        ROLE,
        "AssumeRolePolicyDocument",
        "conditions that hold for the service that assumes it",
        "EventBridge Scheduler User Guide, Confused deputy prevention: the schedule group, since September 2023; ECS Developer "
        "Guide, Task execution IAM role: arn:aws:ecs:region:account:*; Lambda sends no such key (prowler 2810)",
        _untrusting,
        lambda t: put(
            t["Resources"]["ScheduleRole"]["Properties"]["AssumeRolePolicyDocument"]["Statement"][0],
            "Condition.ArnEquals.aws:SourceArn",
            {"Fn::GetAtt": ["Cluster", "Arn"]},
        ),
    ),
    each(
        ROLE,
        "Policies",
        "who may write to S3 with If-Match alone may read the same objects",
        "S3 User Guide, How to prevent object overwrites with conditional writes: If-Match needs s3:PutObject and s3:GetObject",
        _blind,
        _blinded,
    ),
    each(ROLE, "Policies", "at most 10,240 characters in all", QUOTAS, _inline, _wide),
    each(ROLE, "AssumeRolePolicyDocument", "at most 2,048 characters", QUOTAS, _trust, _trusting),
    each(MANAGED, "PolicyDocument", "at most 6,144 characters", QUOTAS, _managed, _wide_managed),
    *(
        rule
        for kind, spoil in ((ROLE, _foreign), (MANAGED, lambda t: put(first(t, MANAGED), "PolicyDocument.Id", "…")))
        for rule in (
            each(
                kind,
                "PolicyDocument",
                "characters of Latin-1",
                "IAM API Reference, CreatePolicy and PutRolePolicy: pattern of PolicyDocument",
                _strange,
                spoil,
            ),
        )
    ),
    each(
        ROLE,
        "PolicyDocument",
        "version 2012-10-17, Sids of letters and digits, each once, actions of a service",
        "IAM User Guide, IAM JSON policy element reference",
        _ill_formed,
        _sid,
    ),
    each(
        MANAGED,
        "PolicyDocument",
        "version 2012-10-17, Sids of letters and digits, each once, actions of a service",
        "IAM User Guide, IAM JSON policy element reference",
        _ill_formed,
        lambda t: put(first(t, MANAGED), "PolicyDocument.Version", "2012-10-18"),
    ),
    *text(
        ROLE,
        "Policies.*.PolicyName",
        "IAM API Reference, PutRolePolicy",
        most=128,
        pattern=r"[\w+=,.@-]+",
        spoiled="image and log",
    ),
    each(
        ROLE,
        "Policies.*.PolicyName",
        "each once in a role",
        "IAM API Reference, PutRolePolicy: a policy of that name is replaced",
        _names_of_policies,
        lambda t: first(t, ROLE)["Policies"].append(first(t, ROLE)["Policies"][0]),
    ),
    *text(ROLE, "Description", "IAM API Reference, CreateRole", most=1000),
    *text(MANAGED, "Description", "IAM API Reference, CreatePolicy", most=1000),
    Rule(
        MANAGED,
        "Description",
        f"stays {DESCRIPTION!r}: it is create-only, and a policy that is attached cannot be deleted",
        "AWS::IAM::ManagedPolicy: createOnlyProperties; IAM API Reference, DeletePolicy: DeleteConflict",
        _edited,
        lambda t: put(first(t, MANAGED), "Description", "What researchers need"),
    ),
)
