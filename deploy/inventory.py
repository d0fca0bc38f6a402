"""What AWS has of an installation, found by listing: to take it away, and to prove that it is gone."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any, NamedTuple

from botocore.exceptions import ClientError

from deploy.account import TAG, Account, is_no_stack, is_ours
from deploy.log_groups import prefixes
from deploy.stack import Stack
from hippodrome.aws import errors


class Thing(NamedTuple):
    """Something in the account: its kind, as people say, and its name."""

    kind: str
    name: str


class Resource(NamedTuple):
    """A resource that a stack has or had."""

    type: str
    physical_id: str


class Listing(NamedTuple):
    """How all things of a kind are listed: the operation, where the answer has them, and what of each is its id."""

    kind: str
    service: str
    operation: str
    path: str


_TABLE: tuple[tuple[str, str, str, str, str], ...] = (
    ("AWS::ApiGatewayV2::Api", "HTTP API", "apigatewayv2", "get_apis", "Items.ApiId"),
    ("AWS::ApiGatewayV2::DomainName", "API address", "apigatewayv2", "get_domain_names", "Items.DomainName"),
    (
        "AWS::CertificateManager::Certificate",
        "certificate",
        "acm",
        "list_certificates",
        "CertificateSummaryList.CertificateArn",
    ),
    ("AWS::CloudWatch::Alarm", "alarm", "cloudwatch", "describe_alarms", "MetricAlarms.AlarmName"),
    ("AWS::CloudWatch::Dashboard", "dashboard", "cloudwatch", "list_dashboards", "DashboardEntries.DashboardName"),
    ("AWS::CodeBuild::Project", "image builder", "codebuild", "list_projects", "projects"),
    (
        "AWS::EC2::InternetGateway",
        "internet gateway",
        "ec2",
        "describe_internet_gateways",
        "InternetGateways.InternetGatewayId",
    ),
    ("AWS::EC2::RouteTable", "route table", "ec2", "describe_route_tables", "RouteTables.RouteTableId"),
    ("AWS::EC2::SecurityGroup", "security group", "ec2", "describe_security_groups", "SecurityGroups.GroupId"),
    ("AWS::EC2::Subnet", "subnet", "ec2", "describe_subnets", "Subnets.SubnetId"),
    ("AWS::EC2::VPC", "VPC", "ec2", "describe_vpcs", "Vpcs.VpcId"),
    ("AWS::EC2::VPCEndpoint", "VPC endpoint", "ec2", "describe_vpc_endpoints", "VpcEndpoints.VpcEndpointId"),
    ("AWS::ECR::Repository", "image repository", "ecr", "describe_repositories", "repositories.repositoryName"),
    ("AWS::ECS::Cluster", "ECS cluster", "ecs", "list_clusters", "clusterArns"),
    ("AWS::Events::Rule", "event rule", "events", "list_rules", "Rules.Name"),
    ("AWS::IAM::ManagedPolicy", "IAM policy", "iam", "list_policies", "Policies.Arn"),
    ("AWS::IAM::Role", "IAM role", "iam", "list_roles", "Roles.RoleName"),
    (
        "AWS::Lambda::EventSourceMapping",
        "event source mapping",
        "lambda",
        "list_event_source_mappings",
        "EventSourceMappings.UUID",
    ),
    ("AWS::Lambda::Function", "function", "lambda", "list_functions", "Functions.FunctionName"),
    ("AWS::Logs::LogGroup", "log group", "logs", "describe_log_groups", "logGroups.logGroupName"),
    ("AWS::S3::Bucket", "S3 bucket", "s3", "list_buckets", "Buckets.Name"),
    ("AWS::SNS::Topic", "topic", "sns", "list_topics", "Topics.TopicArn"),
    ("AWS::SQS::Queue", "queue", "sqs", "list_queues", "QueueUrls"),
    ("AWS::Scheduler::ScheduleGroup", "schedule group", "scheduler", "list_schedule_groups", "ScheduleGroups.Name"),
)
_LISTINGS = {type_: Listing(*rest) for type_, *rest in _TABLE}
_ARGUMENTS = {"list_policies": {"Scope": "Local"}}
REMEMBERED = 10  # deleted stacks of one name that are looked into
KINDS = {type_: listing.kind for type_, listing in _LISTINGS.items()}


def resources(account: Account, stack: str) -> list[Resource]:
    """What the stack of that name has, or had before it was deleted (CloudFormation remembers for 90 days)."""
    found = [
        Resource(one["ResourceType"], one["PhysicalResourceId"])
        for stack_id in _stack_ids(account.client("cloudformation"), stack)
        for one in Stack(account, stack).resources(stack_id)
        if one.get("PhysicalResourceId")
    ]
    return list(dict.fromkeys(found))


def _stack_ids(client: Any, stack: str) -> list[str]:
    """Installations of that name: the one that is there, and those that were deleted last."""
    pages = client.get_paginator("list_stacks").paginate()
    found = [one for page in pages for one in page["StackSummaries"] if one["StackName"] == stack]
    found.sort(key=lambda one: one["StackStatus"] == "DELETE_COMPLETE")
    return [one["StackId"] for one in found[:REMEMBERED] if _was_ours(client, one["StackId"])]


def _was_ours(client: Any, stack_id: str) -> bool:
    """Whether that stack, which may be deleted, was an installation: what others left under the name is theirs."""
    try:
        return is_ours(client.describe_stacks(StackName=stack_id)["Stacks"][0])
    except ClientError as error:
        if is_no_stack(error):
            return False
        raise


def still_there(account: Account, wanted: Iterable[Resource]) -> list[Thing]:
    """Which of these exist, by listing each kind once. Kinds that only exist as part of others are not looked for."""
    by_type: dict[str, set[str]] = {}
    for resource in wanted:
        by_type.setdefault(resource.type, set()).add(resource.physical_id)
    found = []
    for type_, ids in sorted(by_type.items()):
        if type_ in _LISTINGS:
            listing = _LISTINGS[type_]
            there = {_last(one) for one in _list(account, listing)} if type_ == "AWS::ECS::Cluster" else None
            present = there if there is not None else set(_list(account, listing))
            found += [Thing(listing.kind, one) for one in sorted(ids) if one in present]
    return found


def _list(account: Account, listing: Listing) -> Iterator[str]:
    client = account.client(listing.service)
    arguments = _ARGUMENTS.get(listing.operation, {})
    call: Callable[..., Any] = getattr(client, listing.operation)
    if client.can_paginate(listing.operation):
        pages: Iterable[Any] = client.get_paginator(listing.operation).paginate(**arguments)
    else:
        pages = _by_token(call, arguments)
    outer, _, inner = listing.path.partition(".")
    for page in pages:
        for item in page.get(outer) or ():
            yield str(item[inner] if inner else item)


def _by_token(call: Callable[..., Any], arguments: dict[str, Any]) -> Iterator[Any]:
    page = call(**arguments)
    yield page
    while page.get("NextToken"):
        page = call(**arguments, NextToken=page["NextToken"])
        yield page


def _last(arn: str) -> str:
    return arn.rsplit("/", 1)[-1]


# -- what the commands make beside the stack --------------------------------------------------------------------------


def task_definitions(account: Account, stack: str) -> list[str]:
    """The revisions of this stack's task definitions, deregistered ones too. By their tag: names of stacks may begin
    alike, and `hippodrome-lab` is none of `hippodrome`'s business."""
    ecs = account.client("ecs")
    found: list[str] = []
    for status in ("ACTIVE", "INACTIVE"):
        families = ecs.get_paginator("list_task_definition_families").paginate(familyPrefix=f"{stack}-", status=status)
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
    """The log groups that are called by the stack's name, whoever made them."""
    pages = account.client("logs").get_paginator("describe_log_groups")
    return [
        group["logGroupName"]
        for prefix in prefixes(stack)
        for page in pages.paginate(logGroupNamePrefix=prefix)
        for group in page["logGroups"]
    ]


def data_buckets(account: Account, stack: str, code_bucket: str, known: Iterable[Resource] = ()) -> list[str]:
    """The data buckets that exist: the stack's, and what earlier stacks of that name left in this region.

    By what CloudFormation remembers (`known`), and by the tag, which lasts longer.
    """
    prefix = f"{stack.lower()}-"
    remembered = {one.physical_id for one in known if one.type == "AWS::S3::Bucket"}
    names = [str(bucket["Name"]) for bucket in account.client("s3").list_buckets()["Buckets"]]
    names = [name for name in names if name != code_bucket and (name in remembered or name.startswith(prefix))]
    return [name for name in names if name in remembered or _belongs(account, name, stack)]


def _belongs(account: Account, bucket: str, stack: str) -> bool:
    """Whether the bucket has the stack's tag, and lies in this region: another region may have a stack so called."""
    tags = _tags(account, bucket)
    if tags.get(TAG) != stack:
        return False
    place = account.client("s3").get_bucket_location(Bucket=bucket, ExpectedBucketOwner=account.id)
    return (place.get("LocationConstraint") or "us-east-1") == account.region


def mark(account: Account, bucket: str, stack: str) -> None:
    """Make sure that the bucket can be found by its tag when its stack is forgotten.

    CloudFormation has put the stack's tags on it; some emulators do not.
    """
    tags = _tags(account, bucket)
    if TAG not in tags and bucket_exists(account, bucket):
        wanted = [{"Key": key, "Value": value} for key, value in (tags | {TAG: stack}).items()]
        s3 = account.client("s3")
        s3.put_bucket_tagging(Bucket=bucket, ExpectedBucketOwner=account.id, Tagging={"TagSet": wanted})


def _tags(account: Account, bucket: str) -> dict[str, str]:
    try:
        answer = account.client("s3").get_bucket_tagging(Bucket=bucket, ExpectedBucketOwner=account.id)
    except ClientError:  # no tags, or not ours to see: nothing of the installation's
        return {}
    return {tag["Key"]: tag["Value"] for tag in answer["TagSet"]}


def bucket_exists(account: Account, name: str) -> bool:
    """Whether the bucket is there and ours."""
    try:
        account.client("s3").head_bucket(Bucket=name, ExpectedBucketOwner=account.id)
    except ClientError as error:
        if errors.status(error) == 404:
            return False
        raise
    return True


def cluster_exists(account: Account, name: str) -> bool:
    """Whether the ECS cluster is there (a deleted one stays visible for a while, as INACTIVE)."""
    found = account.client("ecs").describe_clusters(clusters=[name])["clusters"]
    return any(cluster.get("status") != "INACTIVE" for cluster in found)


_TAGGED = {  # what the tagging API finds that no listing above looks for: services in ARNs
    "budgets",
    "elasticfilesystem",
    "secretsmanager",
    "ssm",
}


def tagged(account: Account, stack: str) -> list[Thing]:
    """What else carries the stack's tag. The tagging API lags behind, so it is only asked about what is not listed."""
    client = account.client("resourcegroupstaggingapi")
    found = []
    try:
        for page in client.get_paginator("get_resources").paginate(TagFilters=[{"Key": TAG, "Values": [stack]}]):
            for one in page["ResourceTagMappingList"]:
                arn = one["ResourceARN"]
                if arn.split(":")[2] in _TAGGED:
                    found.append(Thing("tagged", arn))
    except ClientError:  # not allowed, or not here: the listings stand
        return []
    return found
