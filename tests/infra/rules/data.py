"""Rules for what keeps data: the bucket, the images, the cluster, logs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

from testing.template import listed
from tests.infra.rules.book import Rule, Template, each, first, one_of, put, setting, text
from tests.infra.situations import Installation, Resource

BUCKET, BUCKET_POLICY, REPOSITORY, CLUSTER = (
    "AWS::S3::Bucket",
    "AWS::S3::BucketPolicy",
    "AWS::ECR::Repository",
    "AWS::ECS::Cluster",
)
LOGS = "AWS::Logs::LogGroup"
RULES_PATH = "LifecycleConfiguration.Rules"
_ACTIONS = {  # of a lifecycle rule in CloudFormation
    *("AbortIncompleteMultipartUpload", "ExpirationDate", "ExpirationInDays", "NoncurrentVersionExpiration"),
    *("NoncurrentVersionExpirationInDays", "NoncurrentVersionTransition", "NoncurrentVersionTransitions"),
    *("Transition", "Transitions"),
}


def _lifecycle(one: Resource) -> list[dict[str, Any]]:
    return list(one.properties.get("LifecycleConfiguration", {}).get("Rules", []))


def _idle(one: Resource, there: Installation) -> Iterator[str]:
    for rule in _lifecycle(one):
        if not _ACTIONS & set(rule):
            yield f"{rule['Id']} does nothing that CloudFormation takes for an action"


def _contradictory(one: Resource, there: Installation) -> Iterator[str]:
    for rule in _lifecycle(one):
        if rule.get("ExpiredObjectDeleteMarker") and {"ExpirationInDays", "ExpirationDate", "TagFilters"} & set(rule):
            yield f"{rule['Id']} expires markers and objects"
        if "AbortIncompleteMultipartUpload" in rule and "TagFilters" in rule:
            yield f"{rule['Id']} ends uploads by their tags"


def _ids(one: Resource, there: Installation) -> Iterator[str]:
    ids = [rule.get("Id", "") for rule in _lifecycle(one)]
    if len(ids) > 1000 or len(ids) != len(set(ids)) or any(len(name) > 255 for name in ids):
        yield "its rules are not called apart"


def _lobby_kept(one: Resource, there: Installation) -> Iterator[str]:
    """Pages of the lobby write every two seconds, and what they wrote is deleted when they are matched."""
    if one.properties.get("VersioningConfiguration", {}).get("Status") != "Enabled":
        return
    for prefix in ("_lobby/", "_lobbies/", "_match/"):
        rules = [rule for rule in _lifecycle(one) if rule.get("Prefix") == prefix and rule["Status"] == "Enabled"]
        if not any(rule.get("NoncurrentVersionExpiration", {}).get("NoncurrentDays") == 1 for rule in rules):
            yield f"older versions of {prefix} are kept for more than a day"
    for prefix in ("_lobby/", "_match/"):
        if not any(rule.get("Prefix") == prefix and rule.get("ExpirationInDays") == 1 for rule in _lifecycle(one)):
            yield f"entries and delete markers of {prefix} are kept for more than a day"


def _without_lobby(template: Template) -> None:
    rules = first(template, BUCKET)["LifecycleConfiguration"]["Rules"]
    rules[:] = [rule for rule in rules if rule.get("Prefix") != "_lobby/"]


def _long_policy(one: Resource, there: Installation) -> Iterator[str]:
    if len(json.dumps(one.properties["PolicyDocument"], separators=(",", ":"))) > 20_480:
        yield "more than 20 KB"


def _public(one: Resource, there: Installation) -> Iterator[str]:
    for statement in one.properties["PolicyDocument"]["Statement"]:
        if statement["Effect"] == "Allow" and statement["Principal"] in ("*", {"AWS": "*"}):
            yield "it allows everybody, which BlockPublicPolicy refuses"


def _images(one: Resource) -> list[dict[str, Any]]:
    return list(json.loads(one.properties["LifecyclePolicy"]["LifecyclePolicyText"])["rules"])


def _no_policy(one: Resource, there: Installation) -> Iterator[str]:
    said = one.properties["LifecyclePolicy"]["LifecyclePolicyText"]
    if not 100 <= len(said) <= 30_720:
        yield f"{len(said)} characters"
    for rule in _images(one):
        chosen = rule["selection"]
        days = chosen["countType"] == "sinceImagePushed"
        if days != ("countUnit" in chosen) or chosen["countNumber"] < 1 or rule["action"] != {"type": "expire"}:
            yield f"rule {rule['rulePriority']} counts what it cannot"
        if (chosen["tagStatus"] == "tagged") != bool({"tagPrefixList", "tagPatternList"} & set(chosen)):
            yield f"rule {rule['rulePriority']} names tags, or none, where it should not"


def _order(one: Resource, there: Installation) -> Iterator[str]:
    ranks = [(rule["rulePriority"], rule["selection"]["tagStatus"]) for rule in _images(one)]
    if len({rank for rank, _ in ranks}) != len(ranks):
        yield "two rules of one priority"
    if any(status == "any" and rank != max(ranks)[0] for rank, status in ranks):
        yield "a rule for any image is not the last"


def _measured(one: Resource, there: Installation) -> Iterator[str]:
    settings = {setting["Name"]: setting["Value"] for setting in one.properties.get("ClusterSettings", [])}
    if settings.get("containerInsights") != "disabled":
        yield "the account's setting decides whether its tasks are measured"


def _images_by(change: Any) -> Any:
    def spoil(template: Template) -> None:
        policy = first(template, REPOSITORY)["LifecyclePolicy"]
        found = json.loads(policy["LifecyclePolicyText"])
        change(found["rules"])
        policy["LifecyclePolicyText"] = json.dumps(found)

    return spoil


def _unit(rules: list[dict[str, Any]]) -> None:
    rules[0]["selection"].pop("countUnit")


def _any_first(rules: list[dict[str, Any]]) -> None:
    rules[0]["rulePriority"], rules[1]["rulePriority"] = rules[1]["rulePriority"], rules[0]["rulePriority"]


def _only_markers(template: Template) -> None:
    for rule in first(template, BUCKET)["LifecycleConfiguration"]["Rules"]:
        rule.pop("NoncurrentVersionExpiration", None)


def _everybody(template: Template) -> None:
    first(template, BUCKET_POLICY)["PolicyDocument"]["Statement"][0]["Effect"] = "Allow"


def _revived(there: Installation) -> Iterator[str]:
    for role in there.of("AWS::IAM::Role"):
        for policy in role.properties.get("Policies", []):
            for statement in policy["PolicyDocument"]["Statement"]:
                if "logs:CreateLogGroup" in listed(statement["Action"]):
                    yield f"{role.name} may make log groups"


def _reviving(template: Template) -> None:
    statement = template["Resources"]["SweepRole"]["Properties"]["Policies"][0]["PolicyDocument"]["Statement"][0]
    statement["Action"] = [*listed(statement["Action"]), "logs:CreateLogGroup"]


RETENTION = (1, 3, 5, 7, 14, 30, 60, 90, 120, 150, 180, 365, 400, 545, 731, 1096, 1827, 2192, 2557, 2922, 3288, 3653)
"""Days that CloudWatch Logs keeps logs."""
LIFECYCLE = "S3 API Reference, PutBucketLifecycleConfiguration"
IMAGES = "ECR User Guide, Lifecycle policy properties"

RULES: tuple[Rule, ...] = (
    each(
        BUCKET,
        RULES_PATH,
        "an action in each rule; ExpiredObjectDeleteMarker alone is none",
        "cloudformation-coverage-roadmap 1124",
        _idle,
        _only_markers,
    ),
    each(
        BUCKET,
        RULES_PATH,
        "markers do not expire with objects, nor uploads by tags",
        LIFECYCLE,
        _contradictory,
        setting(BUCKET, f"{RULES_PATH}.*.ExpirationInDays", 30),
    ),
    each(
        BUCKET,
        RULES_PATH,
        "at most 1,000, each with an id of its own of 255 characters",
        LIFECYCLE,
        _ids,
        setting(BUCKET, f"{RULES_PATH}.*.Id", "x" * 256),
    ),
    each(
        BUCKET,
        RULES_PATH,
        "of what is written every few seconds, versions and delete markers go after a day: they slow down listings",
        "S3 User Guide, Troubleshooting (503s by versions and delete markers), Lifecycle conflicts (the shorter one counts)",
        _lobby_kept,
        _without_lobby,
    ),
    each(
        BUCKET_POLICY,
        "PolicyDocument",
        "at most 20 KB",
        "S3 User Guide, Bucket policies: 20 KB",
        _long_policy,
        lambda t: put(first(t, BUCKET_POLICY), "PolicyDocument.Id", "x" * 20_480),
    ),
    each(
        BUCKET_POLICY,
        "PolicyDocument",
        "nobody is allowed as everybody, where public policies are blocked",
        "S3 User Guide, Blocking public access",
        _public,
        _everybody,
    ),
    each(REPOSITORY, "LifecyclePolicy", "counts and tags that go together", IMAGES, _no_policy, _images_by(_unit)),
    each(
        REPOSITORY,
        "LifecyclePolicy",
        "priorities that are told apart; a rule for any image comes last",
        IMAGES,
        _order,
        _images_by(_any_first),
    ),
    *text(
        REPOSITORY,
        "RepositoryName",
        "ECR API Reference, CreateRepository: lower case",
        most=256,
        pattern=r"(?:[a-z0-9]+(?:[._-][a-z0-9]+)*/)*[a-z0-9]+(?:[._-][a-z0-9]+)*",
        spoiled={"Ref": "AWS::StackName"},
    ),
    *text(
        CLUSTER,
        "ClusterName",
        "ECS API Reference, CreateCluster: 255 letters, digits, underscores and hyphens",
        most=255,
        pattern=r"[a-zA-Z0-9_-]+",
        spoiled="a cluster",
    ),
    one_of(
        CLUSTER,
        "CapacityProviders.*",
        "ECS API Reference, CreateCluster: Fargate's own; others have to be made before",
        ("FARGATE", "FARGATE_SPOT"),
    ),
    each(
        CLUSTER,
        "ClusterSettings",
        "containerInsights, disabled: else a setting of the account may turn it on, which costs by the metric and makes a log "
        "group that no stack deletes",
        "ECS API Reference, ClusterSetting: overrides the value set with PutAccountSettingDefault",
        _measured,
        lambda t: first(t, CLUSTER).pop("ClusterSettings", None),
    ),
    *text(
        LOGS,
        "LogGroupName",
        "CloudWatch Logs API Reference, CreateLogGroup; names that begin with aws/ are kept for AWS",
        most=512,
        pattern=r"(?!aws/)[.\-_/#A-Za-z0-9]+",
        spoiled="aws/sweep",
    ),
    one_of(LOGS, "RetentionInDays", "CloudWatch Logs API Reference, PutRetentionPolicy", RETENTION),
    Rule(
        LOGS,
        "LogGroupName",
        "that of no group which a role may make again: lines that come late would bring it back, in the way of the next stack",
        'accelerated-intelligent-document-processing-on-aws 564: "already exists" after the stack was deleted',
        _revived,
        _reviving,
    ),
)
