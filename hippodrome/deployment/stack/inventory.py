"""Lists what AWS has of an installation beside its stack: what the commands made, and what a deleted stack leaves."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.aws.dns import Route53Dns
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.account import Account, is_no_stack, is_ours, parameters_of, servers_domain, site_host
from hippodrome.deployment.aws.resource_names import TAG
from hippodrome.deployment.stack.stack import Stack

REMEMBERED = 10  # of the stacks of one name, also deleted ones, so many are looked at


def summaries(account: Account, stack: str) -> list[Mapping[str, Any]]:
    """List the stacks of that name in ListStacks' form: the present one first. A deleted one is listed for 90 days."""
    pages = account.client("cloudformation").get_paginator("list_stacks").paginate()
    named = [summary for page in pages for summary in page["StackSummaries"] if summary["StackName"] == stack]
    return sorted(named, key=lambda summary: summary["StackStatus"] == "DELETE_COMPLETE")[:REMEMBERED]


def stacks(account: Account, stack: str) -> Iterator[Mapping[str, Any]]:
    """Describe the installations of that name, the present one first, then deleted ones."""
    for summary in summaries(account, stack):
        try:
            described = account.client("cloudformation").describe_stacks(StackName=summary["StackId"])["Stacks"][0]
        except ClientError as error:
            if not is_no_stack(error):
                raise
        else:
            if is_ours(described):  # a stack of others may have had the name
                yield described


def buckets_of(account: Account, described: Iterable[Mapping[str, Any]]) -> set[str]:
    """Return the names of the buckets that these installations have or had."""
    return {
        str(resource["PhysicalResourceId"])
        for stack in described
        for resource in Stack(account, stack["StackName"]).resources(stack["StackId"])
        if resource["ResourceType"] == "AWS::S3::Bucket" and resource.get("PhysicalResourceId")
    }


class Addresses(NamedTuple):
    """The domains of an installation: its hosted zone, root domain, site, and the servers' domain."""

    zone: str
    root: str
    site: str
    servers: str


def addresses(described: Iterable[Mapping[str, Any]]) -> list[Addresses]:
    """Return the domains of these installations, each once."""
    all_addresses = []
    for parameters in map(parameters_of, described):
        zone, root, host = (parameters.get(name, "") for name in ("HostedZoneId", "RootDomain", "SiteHost"))
        if zone and root:
            site = site_host(parameters) if host else ""
            all_addresses.append(Addresses(zone, root, site, servers_domain(parameters)))
    return list(dict.fromkeys(all_addresses))


def task_definitions(account: Account, stack: str) -> list[str]:
    """Return the revisions of this stack's task definitions, deregistered ones too.

    They are recognised by their tag, since `hippodrome-lab` is another installation than `hippodrome`.
    """
    ecs = account.client("ecs")
    revisions: list[str] = []
    for status in ("ACTIVE", "INACTIVE"):
        families = ecs.get_paginator("list_task_definition_families").paginate(
            familyPrefix=resource_names.prefix(stack), status=status
        )
        for family in [name for page in families for name in page["families"]]:
            pages = ecs.get_paginator("list_task_definitions").paginate(familyPrefix=family, status=status)
            arns = [arn for page in pages for arn in page["taskDefinitionArns"]]
            tags = ecs.describe_task_definition(taskDefinition=arns[-1], include=["TAGS"])["tags"] if arns else []
            if any(tag.get("key") == TAG and tag.get("value") == stack for tag in tags):
                revisions += arns
    return list(dict.fromkeys(revisions))


def log_groups(account: Account, stack: str) -> list[str]:
    """Return the log groups whose names contain the stack's name, made by the stack or by a service."""
    pages = account.client("logs").get_paginator("describe_log_groups")
    return [
        group["logGroupName"]
        for prefix in resource_names.log_prefixes(stack)
        for page in pages.paginate(logGroupNamePrefix=prefix)
        for group in page["logGroups"]
    ]


def data_buckets(account: Account, stack: str, remembered: Iterable[str] = ()) -> list[str]:
    """Return the existing data buckets of the stack, and of earlier stacks of that name in this region.

    Such a bucket is one of those `remembered` by CloudFormation, or has the stack's tag, which stays longer.
    """
    prefix = resource_names.bucket_prefix(stack)
    code_bucket = resource_names.code_bucket(stack, account.id, account.region)
    buckets = [str(bucket["Name"]) for bucket in account.client("s3").list_buckets()["Buckets"]]
    # ListBuckets may name a bucket that was deleted a moment ago (S3 user guide, consistency of bucket configurations).
    return [
        name
        for name in buckets
        if name != code_bucket
        and (
            bucket_exists(account, name)
            if name in remembered
            else name.startswith(prefix) and _belongs(account, name, stack)
        )
    ]


def _belongs(account: Account, bucket: str, stack: str) -> bool:
    """Whether the bucket has the stack's tag and is in this region. Another region may have a stack of this name."""
    if _tags(account, bucket).get(TAG) != stack:
        return False
    place = account.client("s3").get_bucket_location(Bucket=bucket, ExpectedBucketOwner=account.id)
    return (place.get("LocationConstraint") or "us-east-1") == account.region


def mark(account: Account, bucket: str, stack: str) -> None:
    """Give the bucket the stack's tag if it has none, so that it can be found when CloudFormation forgets the stack.

    CloudFormation puts the stack's tags on it; some emulators do not.
    """
    tags = _tags(account, bucket)
    if TAG not in tags and bucket_exists(account, bucket):
        tag_set = [{"Key": key, "Value": value} for key, value in (tags | {TAG: stack}).items()]
        s3 = account.client("s3")
        s3.put_bucket_tagging(Bucket=bucket, ExpectedBucketOwner=account.id, Tagging={"TagSet": tag_set})


def _tags(account: Account, bucket: str) -> dict[str, str]:
    try:
        answer = account.client("s3").get_bucket_tagging(Bucket=bucket, ExpectedBucketOwner=account.id)
    except ClientError:  # it has no tags, or belongs to others
        return {}
    return {tag["Key"]: tag["Value"] for tag in answer["TagSet"]}


def bucket_exists(account: Account, name: str) -> bool:
    """Whether the account has a bucket of this name. Raises ClientError with status 403 if it is another account's."""
    try:
        account.client("s3").head_bucket(Bucket=name, ExpectedBucketOwner=account.id)
    except ClientError as error:
        if errors.status(error) == 404:
            return False
        raise
    return True


def cluster_exists(account: Account, name: str) -> bool:
    """Whether the ECS cluster exists. A deleted one stays visible for a while, as INACTIVE."""
    clusters = account.client("ecs").describe_clusters(clusters=[name])["clusters"]
    return any(cluster.get("status") != "INACTIVE" for cluster in clusters)


def server_names(account: Account, where: Addresses) -> list[str]:
    """List the DNS names of servers in the zone, also those of another installation with the same domains."""
    settings = {"ROOT_DOMAIN": where.root, "HOSTED_ZONE_ID": where.zone}
    host = where.servers.removesuffix(where.root).rstrip(".")
    try:
        return [
            record.name for record in Route53Dns(lambda: account.client("route53"), settings.__getitem__, host).list()
        ]
    except ClientError as error:
        if errors.code(error) == "NoSuchHostedZone":
            return []
        raise
