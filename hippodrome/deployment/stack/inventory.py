"""Lists what AWS has of an installation: for its removal, and to prove afterwards that nothing is left."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.aws.dns import Route53Dns
from hippodrome.deployment.aws import resource_names
from hippodrome.deployment.aws.account import Account, is_no_stack, is_ours, parameters_of, servers_domain, site_host
from hippodrome.deployment.aws.resource_names import TAG
from hippodrome.deployment.aws.versions import VersionedBucket
from hippodrome.deployment.stack.listings import BY_KIND, KEY_TYPES, LISTINGS, Listing
from hippodrome.deployment.stack.stack import Stack


class ListedResource(NamedTuple):
    """A resource in the account: its kind, in words, and its name."""

    kind: str
    name: str


class Resource(NamedTuple):
    """A resource that a stack has or had."""

    type: str
    physical_id: str


MEASURED = 200_000  # the sizes of at most so many versions of a bucket are added up
REMEMBERED = 10  # the resources of so many stacks of one name are listed, also of deleted ones


def cost_of(kind: str) -> str:
    """Say in words what one unused resource of this kind costs a month."""
    return BY_KIND[kind].cost if kind in BY_KIND else "nothing"


def removal_of(thing: ListedResource, account: Account) -> str:
    """Return the AWS CLI command that removes a resource; "" if there is only the service's console."""
    listing = BY_KIND.get(thing.kind)
    if listing is None:
        return ""
    command = listing.removal(thing.name, account.region)
    return f"{command} --account-id {account.id}" if listing.service == "budgets" else command


def stacks(account: Account, stack: str) -> list[Mapping[str, Any]]:
    """Describe the installations of that name: the present one, then deleted ones, `REMEMBERED` at most.

    CloudFormation lists a deleted stack for 90 days.
    """
    client = account.client("cloudformation")
    pages = client.get_paginator("list_stacks").paginate()
    summaries = [summary for page in pages for summary in page["StackSummaries"] if summary["StackName"] == stack]
    summaries.sort(key=lambda summary: summary["StackStatus"] == "DELETE_COMPLETE")
    described = [_described(client, summary["StackId"]) for summary in summaries[:REMEMBERED]]
    return [
        stack_described for stack_described in described if stack_described and is_ours(stack_described)
    ]  # a stack of others may have had the name


def _described(client: Any, stack_id: str) -> Mapping[str, Any] | None:
    """Describe a stack, also a deleted one; None if CloudFormation does not know it any more."""
    try:
        stack: Mapping[str, Any] = client.describe_stacks(StackName=stack_id)["Stacks"][0]
    except ClientError as error:
        if is_no_stack(error):
            return None
        raise
    return stack


def resources(account: Account, described: Iterable[Mapping[str, Any]]) -> list[Resource]:
    """List the resources of these installations, which `stacks` has described, each once."""
    resources = [
        Resource(resource["ResourceType"], resource["PhysicalResourceId"])
        for stack in described
        for resource in Stack(account, stack["StackName"]).resources(stack["StackId"])
        if resource.get("PhysicalResourceId")
    ]
    return list(dict.fromkeys(resources))


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


def still_there(account: Account, resources: Iterable[Resource]) -> list[ListedResource]:
    """Find which resources of `wanted` exist, by one listing for each type.

    Skips types that are not in `LISTINGS`.
    """
    by_type: dict[str, set[str]] = {}
    for resource in resources:
        by_type.setdefault(resource.type, set()).add(resource.physical_id)
    remaining = []
    for type_, ids in sorted(by_type.items()):
        if type_ in LISTINGS:
            listing = LISTINGS[type_]
            listed = set(_list(account, listing))
            if type_ == "AWS::ECS::Cluster":  # AWS lists ARNs, and CloudFormation names
                listed = {arn.rpartition("/")[2] for arn in listed}
            remaining += [ListedResource(listing.kind, listed_id) for listed_id in sorted(ids & listed)]
    return remaining


def _list(account: Account, listing: Listing) -> Iterator[str]:
    client = account.client("s3" if listing.service == "s3api" else listing.service)
    arguments = _arguments(account, listing.operation)
    call: Callable[..., Any] = getattr(client, listing.operation)
    if client.can_paginate(listing.operation):
        pages: Iterable[Any] = client.get_paginator(listing.operation).paginate(**arguments)
    else:
        pages = _by_token(call, arguments)
    outer, _, inner = listing.path.partition(".")
    for page in pages:
        for item in page.get(outer) or ():
            if not (isinstance(item, dict) and str(item.get("State", "")).lower() == "deleted"):  # VPC endpoints
                yield str(item[inner] if inner else item)


def _arguments(account: Account, operation: str) -> dict[str, Any]:
    if operation == "describe_budgets":
        return {"AccountId": account.id}
    if operation == "list_certificates":
        return {"Includes": {"keyTypes": list(KEY_TYPES)}}
    return {"Scope": "Local"} if operation == "list_policies" else {}


def _by_token(call: Callable[..., Any], arguments: dict[str, Any]) -> Iterator[Any]:
    page = call(**arguments)
    yield page
    while page.get("NextToken"):
        page = call(**arguments, NextToken=page["NextToken"])
        yield page


# -- what the commands make outside of the stack ----------------------------------------------------------------------


def task_definitions(account: Account, stack: str) -> list[str]:
    """Return the revisions of this stack's task definitions, deregistered ones too.

    They are recognised by their tag, since `hippodrome-lab` is another installation than `hippodrome`.
    """
    ecs = account.client("ecs")
    found: list[str] = []
    for status in ("ACTIVE", "INACTIVE"):
        families = ecs.get_paginator("list_task_definition_families").paginate(
            familyPrefix=resource_names.prefix(stack), status=status
        )
        for family in [name for page in families for name in page["families"]]:
            pages = ecs.get_paginator("list_task_definitions").paginate(familyPrefix=family, status=status)
            arns = [arn for page in pages for arn in page["taskDefinitionArns"]]
            if arns and _is_ours(ecs, arns[-1], stack):
                found += arns
    return list(dict.fromkeys(found))


def _is_ours(ecs: Any, arn: str, stack: str) -> bool:
    tags = ecs.describe_task_definition(taskDefinition=arn, include=["TAGS"]).get("tags", [])
    return any(tag.get("key") == TAG and tag.get("value") == stack for tag in tags)


def log_groups(account: Account, stack: str) -> list[str]:
    """Return the log groups whose names contain the stack's name, made by the stack or by a service."""
    pages = account.client("logs").get_paginator("describe_log_groups")
    return [
        group["logGroupName"]
        for prefix in resource_names.log_prefixes(stack)
        for page in pages.paginate(logGroupNamePrefix=prefix)
        for group in page["logGroups"]
    ]


def data_buckets(account: Account, stack: str, resources: Iterable[Resource] = ()) -> list[str]:
    """Return the existing data buckets of the stack, and of earlier stacks of that name in this region.

    Such a bucket is among the `known` resources that CloudFormation lists, or has the stack's tag, which stays longer.
    """
    remembered = {resource.physical_id for resource in resources if resource.type == "AWS::S3::Bucket"}
    buckets = [str(bucket["Name"]) for bucket in account.client("s3").list_buckets()["Buckets"]]
    prefix = resource_names.bucket_prefix(stack)
    code_bucket = resource_names.code_bucket(stack, account.id, account.region)
    buckets = [name for name in buckets if name != code_bucket and (name in remembered or name.startswith(prefix))]
    # ListBuckets may name a bucket that was deleted a moment ago (S3 user guide, consistency of bucket configurations).
    return [
        name
        for name in buckets
        if (name in remembered and bucket_exists(account, name)) or _belongs(account, name, stack)
    ]


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


SERVICE_ROLES = ("AWSServiceRoleForECS", "AWSServiceRoleForAPIGateway")
"""The roles that AWS makes once in an account: `apply` asks for ECS's, and API Gateway makes its own with a domain
name."""


def service_roles(account: Account) -> list[str]:
    """Return the names of the roles that AWS makes for the whole account (`SERVICE_ROLES`), if they exist."""
    iam = account.client("iam")
    roles = []
    for name in SERVICE_ROLES:
        try:
            iam.get_role(RoleName=name)
        except ClientError as error:
            if errors.code(error) != "NoSuchEntity":
                raise
        else:
            roles.append(name)
    return roles


def stored(account: Account, bucket: str) -> int:
    """Return the bytes of all versions in a bucket; only of the first `MEASURED` versions if there are more."""
    versions = VersionedBucket(account, bucket).versions()
    return sum(version.size for version in itertools.islice(versions, MEASURED))


def _belongs(account: Account, bucket: str, stack: str) -> bool:
    """Whether the bucket has the stack's tag and is in this region. Another region may have a stack of this name."""
    tags = _tags(account, bucket)
    if tags.get(TAG) != stack:
        return False
    place = account.client("s3").get_bucket_location(Bucket=bucket, ExpectedBucketOwner=account.id)
    return (place.get("LocationConstraint") or "us-east-1") == account.region


def mark(account: Account, bucket: str, stack: str) -> None:
    """Give the bucket the stack's tag if it has none, so that it can be found when CloudFormation forgets the stack.

    CloudFormation puts the stack's tags on it; some emulators do not.
    """
    tags = _tags(account, bucket)
    if TAG not in tags and bucket_exists(account, bucket):
        tag_list = [{"Key": key, "Value": value} for key, value in (tags | {TAG: stack}).items()]
        s3 = account.client("s3")
        s3.put_bucket_tagging(Bucket=bucket, ExpectedBucketOwner=account.id, Tagging={"TagSet": tag_list})


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
    clusters_found = account.client("ecs").describe_clusters(clusters=[name])["clusters"]
    return any(cluster.get("status") != "INACTIVE" for cluster in clusters_found)


_TAGGED = {  # services, by their names in ARNs, whose resources only the tagging API lists here
    "elasticfilesystem",
    "secretsmanager",
    "ssm",
}


def tagged(account: Account, stack: str) -> list[ListedResource]:
    """Find resources with the stack's tag that no listing finds, by the tagging API, which learns of changes late."""
    client = account.client("resourcegroupstaggingapi")
    arns = []
    try:
        for page in client.get_paginator("get_resources").paginate(TagFilters=[{"Key": TAG, "Values": [stack]}]):
            for mapping in page["ResourceTagMappingList"]:
                arn = mapping["ResourceARN"]
                if arn.split(":")[2] in _TAGGED:
                    arns.append(ListedResource("tagged", arn))
    except ClientError:  # these credentials may not ask, or the region has no such API
        return []
    return arns
