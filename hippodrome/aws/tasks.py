"""Servers as ECS tasks on Fargate, and their public addresses from EC2.

Facts (ECS API Reference and Developer Guide, read November 2026). A `clientToken` makes RunTask repeatable within a
cluster for 24 hours at most; with other parameters it is a ConflictException that names the tasks it already ran.
`startedBy` must be the only filter of ListTasks. The overrides may have 8,192 characters, the JSON's own included. A
capacity provider without a `weight` has 0, and one with 0 places no tasks. When Fargate is full, RunTask says so in
`failures` ("Capacity is unavailable at this time. Please try again later or in a different availability zone"); a quota
is a ClientException ("You've reached the limit on the number of vCPUs you can run concurrently"). In new accounts a
quota may also be a failure ("The requested CPU configuration is above your limit", dask-cloudprovider issue 299; it is
one by the guide's page "Amazon ECS service event messages", where "Internal error." stands beside them). Throttling of
the EC2 calls behind RunTask comes dressed as InvalidParameterException ("… Request limit exceeded", dask-cloudprovider
issue 56).
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.aws import errors
from hippodrome.model import ids
from hippodrome.ports import Address, NoCapacity, Refused, RunningTask, TaskRequest

CONTAINER = "trial"  # the name of the container in the task definition
OVERRIDES = 8192  # characters
PROVIDERS = ["FARGATE", "FARGATE_SPOT"]
UNMEASURED = [{"name": "containerInsights", "value": "disabled"}]
"""Overrides the account's setting (API Reference, ClusterSetting): Container Insights costs by the metric, and leaves a
log group of each cluster's name behind."""

_FULL = re.compile(
    r"capacity is unavailable|insufficient capacity|(reached the|above your) limit|RESOURCE:|internal error",
    re.IGNORECASE,
)
_PASSING = re.compile(r"limit ?exceeded|rate exceeded|throttl|service.linked role", re.IGNORECASE)
_REFUSALS = {
    "AccessDeniedException",
    "BlockedException",
    "ClientException",
    "ClusterNotFoundException",
    "InvalidParameterException",
    "PlatformTaskDefinitionIncompatibilityException",
    "PlatformUnknownException",
    "UnsupportedFeatureException",
}
_GONE = re.compile(r"not found|inactive", re.IGNORECASE)
_INTERFACE = re.compile(r"eni-[0-9a-zA-Z]+")


class EcsTasks:
    """Implements `hippodrome.ports.Tasks`. A task's id is its ARN."""

    def __init__(self, ecs: Callable[[], Any], ec2: Callable[[], Any], need: Callable[[str], str]) -> None:
        self._ecs = ecs
        self._ec2 = ec2
        self._need = need

    def run(self, request: TaskRequest) -> str:
        """One RunTask. Its environment gets `STORE`, `HOST` and `PORT` besides what the request brings."""
        overrides = self._overrides(request)
        try:
            answer = self._ecs().run_task(
                cluster=request.cluster,
                taskDefinition=request.definition,
                capacityProviderStrategy=[
                    {"capacityProvider": "FARGATE_SPOT" if request.spot else "FARGATE", "weight": 1}
                ],
                networkConfiguration={
                    "awsvpcConfiguration": {
                        "subnets": [part.strip() for part in self._need("SUBNET").split(",") if part.strip()],
                        "securityGroups": [self._need("SECURITY_GROUP")],
                        "assignPublicIp": "ENABLED",
                    }
                },
                overrides=overrides,
                propagateTags="TASK_DEFINITION",  # for the bill
                startedBy=request.name,
                clientToken=client_token(request),
                count=1,
            )
        except ClientError as error:
            existing = error.response.get("resourceIds")
            if errors.code(error) == "ConflictException" and existing:
                return str(existing[0])
            raise _meaning(error, request) from error
        if answer["tasks"]:
            return str(answer["tasks"][0]["taskArn"])
        raise _failure([str(failure.get("reason", "")) for failure in answer.get("failures", ())])

    def stop(self, task: str, cluster: str, reason: str) -> None:
        try:
            self._ecs().stop_task(cluster=cluster, task=task, reason=reason[:255])
        except ClientError as error:
            gone = errors.code(error) in {"InvalidParameterException", "ClientException"}
            if errors.code(error) != "ClusterNotFoundException" and not (gone and _GONE.search(errors.message(error))):
                raise

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        """One DescribeNetworkInterfaces, and another for those that exist if some do not.

        Not by a filter, which would not mind missing ones: EC2 pages through all interfaces of the account for it.
        """
        wanted = sorted(set(interfaces))
        while wanted:
            try:
                found = self._ec2().describe_network_interfaces(NetworkInterfaceIds=wanted)["NetworkInterfaces"]
            except ClientError as error:
                if errors.code(error) != "InvalidNetworkInterfaceID.NotFound":
                    raise
                missing = set(_INTERFACE.findall(errors.message(error)))
                left = [interface for interface in wanted if interface not in missing]
                if len(left) == len(wanted):
                    raise  # no id in the message is one of ours
                wanted = left
            else:
                public = ((i["NetworkInterfaceId"], i.get("Association", {}).get("PublicIp")) for i in found)
                return {interface: Address(host) for interface, host in public if host}
        return {}

    def find(self, name: str, cluster: str) -> str | None:
        """One ListTasks. Like all lists of ECS it may not know yet of a task that was run a moment ago."""
        try:
            found = self._ecs().list_tasks(cluster=cluster, startedBy=name)["taskArns"]
        except ClientError as error:
            if errors.code(error) == "ClusterNotFoundException":
                return None
            raise
        return str(found[0]) if found else None

    def list(self) -> Iterator[RunningTask]:
        """Tasks of the installation's cluster and of the participants' own; those told to stop are left out."""
        for cluster in itertools.chain([self._need("CLUSTER")], self.clusters()):
            yield from self._list(cluster)

    def create_cluster(self, name: str) -> None:
        self._ecs().create_cluster(clusterName=name, capacityProviders=PROVIDERS, settings=UNMEASURED)

    def delete_cluster(self, name: str) -> None:
        """Raises ECS's ClusterContainsTasksException or UpdateInProgressException while something is leaving it."""
        try:
            self._ecs().delete_cluster(cluster=name)
        except ClientError as error:
            if errors.code(error) != "ClusterNotFoundException":
                raise

    def clusters(self) -> Iterator[str]:
        """Clusters that are called like a server."""
        for page in self._ecs().get_paginator("list_clusters").paginate():
            for arn in page["clusterArns"]:
                name = str(arn).rpartition("/")[2]
                if ids.parse_server_name(name):
                    yield name

    def _overrides(self, request: TaskRequest) -> dict[str, Any]:
        environment = {
            **request.environment,
            "STORE": self._need("SIGN_URL"),
            "HOST": "0.0.0.0",  # noqa: S104 - the trial is there to be reached
            "PORT": str(request.port),
        }
        container = {
            "name": CONTAINER,
            "environment": [{"name": name, "value": value} for name, value in sorted(environment.items())],
        }
        overrides = {
            "cpu": str(round(request.cpu * 1024)),
            "memory": str(round(request.memory * 1024)),
            "containerOverrides": [container],
        }
        length = len(json.dumps(overrides))
        if length > OVERRIDES:
            raise Refused(
                f"what the server should be told takes {length} characters, and ECS allows {OVERRIDES}; "
                "shorten the trial's settings in config.yml"
            )
        return overrides

    def _list(self, cluster: str) -> Iterator[RunningTask]:
        ecs = self._ecs()
        try:
            for page in ecs.get_paginator("list_tasks").paginate(cluster=cluster):
                yield from _described(ecs, cluster, page["taskArns"])
        except ClientError as error:
            if errors.code(error) != "ClusterNotFoundException":  # deleted since it was listed
                raise

    def count(self) -> int:
        """How many tasks live in our clusters, by lists alone: DescribeTasks would also tell what servers are told."""
        clusters = [self._need("CLUSTER"), *self.clusters()]
        return sum(self._count(cluster) for cluster in clusters)

    def _count(self, cluster: str) -> int:
        try:
            pages = self._ecs().get_paginator("list_tasks").paginate(cluster=cluster)
            return sum(len(page["taskArns"]) for page in pages)
        except ClientError as error:
            if errors.code(error) != "ClusterNotFoundException":  # deleted since it was listed
                raise
            return 0


def client_token(request: TaskRequest) -> str:
    """64 characters that are the same for the same server and kind: a repeated RunTask finds the first one's task."""
    kind = "FARGATE_SPOT" if request.spot else "FARGATE"
    return hashlib.sha256(f"{request.name}\0{kind}\0{request.nonce}".encode()).hexdigest()


def _described(ecs: Any, cluster: str, tasks: Iterable[str]) -> Iterator[RunningTask]:
    arns: list[str] = [*tasks]
    if not arns:  # DescribeTasks takes 1 to 100; ListTasks gives at most 100 a page
        return
    for task in ecs.describe_tasks(cluster=cluster, tasks=arns)["tasks"]:
        name = task.get("startedBy", "")
        if task["lastStatus"] != "STOPPED" and ids.parse_server_name(name):
            details = (d for attached in task.get("attachments", ()) for d in attached.get("details", ()))
            interface = next((d["value"] for d in details if d.get("name") == "networkInterfaceId"), None)
            yield RunningTask(task["taskArn"], cluster, name, interface, task["lastStatus"] == "RUNNING")


def _meaning(error: ClientError, request: TaskRequest) -> Exception:
    """What a failed RunTask means to the caller; the error itself if trying again later is all there is to do."""
    same: Exception = error
    name, text = errors.code(error), errors.message(error)
    if _PASSING.search(text) or name not in _REFUSALS:
        return same
    if _FULL.search(text):
        return NoCapacity(text)
    settling = name == "ClusterNotFoundException" or "capacity provider" in text.lower()
    if settling and ids.parse_server_name(request.cluster):
        return same  # a participant's own cluster, created a moment ago
    return Refused(f"{name}: {text}")


def _failure(reasons: Sequence[str]) -> Exception:
    """What RunTask means that ran nothing and raised nothing."""
    text = "; ".join(reasons) or "RunTask started no task and gave no reason"
    return NoCapacity(text) if not reasons or _FULL.search(text) or _PASSING.search(text) else Refused(text)
