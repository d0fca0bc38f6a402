"""Runs servers as ECS tasks on Fargate, and reads their public addresses from EC2.

Facts (ECS API Reference and Developer Guide, read November 2026):

* A `clientToken` makes RunTask repeatable within a cluster for 24 hours at most. A call with the same token and other
  parameters is a ConflictException that names the tasks of the first call.
* `startedBy` must be the only filter of ListTasks.
* The overrides may have 8,192 characters, including those of the JSON syntax.
* A capacity provider's `weight` is 0 by default, and a provider of weight 0 places no tasks.
* If Fargate has no capacity, RunTask says so in `failures` ("Capacity is unavailable at this time. Please try again
  later or in a different availability zone"). A quota is a ClientException ("You've reached the limit on the number of
  vCPUs you can run concurrently"). In new accounts a quota may also be in `failures` ("The requested CPU configuration
  is above your limit", dask-cloudprovider issue 299; the guide's page "Amazon ECS service event messages"
  lists it so, beside "Internal error.").
* Throttling of the EC2 calls behind RunTask is an InvalidParameterException ("… Request limit exceeded",
  dask-cloudprovider issue 56).
"""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.control.aws import errors
from hippodrome.control.model import ids
from hippodrome.control.model.messages import CONTAINER
from hippodrome.control.ports import Address, NoCapacity, Refused, RunningTask, TaskRequest
from hippodrome.protocol import environment

MAX_OVERRIDES = 8192  # the most characters of a task's overrides
PROVIDERS = ["FARGATE", "FARGATE_SPOT"]
NO_CONTAINER_INSIGHTS = [{"name": "containerInsights", "value": "disabled"}]
"""The setting of participants' own clusters. It overrides the account's (API Reference, ClusterSetting): Container
Insights is billed per metric, and leaves behind a log group for each cluster."""

_NO_CAPACITY = re.compile(
    r"capacity is unavailable|insufficient capacity|(reached the|above your) limit|RESOURCE:|internal error",
    re.IGNORECASE,
)
_TRANSIENT = re.compile(r"limit ?exceeded|rate exceeded|throttl|service.linked role", re.IGNORECASE)
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
_ALREADY_STOPPED = re.compile(r"not found|inactive", re.IGNORECASE)
_INTERFACE = re.compile(r"eni-[0-9a-zA-Z]+")


class EcsTasks:
    """Implements `hippodrome.control.ports.Tasks`. A task's id is its ARN."""

    def __init__(self, ecs: Callable[[], Any], ec2: Callable[[], Any], need: Callable[[str], str]) -> None:
        self._ecs = ecs
        self._ec2 = ec2
        self._need = need

    def run(self, request: TaskRequest) -> str:
        """Start the task with one RunTask, and return its ARN.

        The server's environment also gets `STORE`, `HOST` and `PORT`. Raises `NoCapacity` or `Refused`.
        """
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
                propagateTags="TASK_DEFINITION",  # for cost allocation
                startedBy=request.name,
                clientToken=client_token(request),
                count=1,
            )
        except ClientError as error:
            existing = error.response.get("resourceIds")
            if errors.code(error) == "ConflictException" and existing:
                return str(existing[0])
            raise _run_error(error, request) from error
        if answer["tasks"]:
            return str(answer["tasks"][0]["taskArn"])
        raise _failures_error([str(failure.get("reason", "")) for failure in answer.get("failures", ())])

    def stop(self, task: str, cluster: str, reason: str) -> None:
        try:
            self._ecs().stop_task(cluster=cluster, task=task, reason=reason[:255])
        except ClientError as error:
            refused = errors.code(error) in {"InvalidParameterException", "ClientException"}
            if errors.code(error) != "ClusterNotFoundException" and not (
                refused and _ALREADY_STOPPED.search(errors.message(error))
            ):
                raise

    def addresses(self, interfaces: Sequence[str]) -> Mapping[str, Address]:
        """Return the public addresses of these network interfaces, by their ids.

        Interfaces that do not exist or have no address are left out. AWS calls: one DescribeNetworkInterfaces; if some
        interfaces do not exist, another one without their ids. (A filter would accept missing ids, but with a filter
        EC2 pages through all interfaces of the account.)
        """
        ids = sorted(set(interfaces))
        while ids:
            try:
                network_interfaces = self._ec2().describe_network_interfaces(NetworkInterfaceIds=ids)[
                    "NetworkInterfaces"
                ]
            except ClientError as error:
                if errors.code(error) != "InvalidNetworkInterfaceID.NotFound":
                    raise
                missing = set(_INTERFACE.findall(errors.message(error)))
                existing = [interface for interface in ids if interface not in missing]
                if len(existing) == len(ids):
                    raise  # the message names none of these interfaces, so a repetition would fail too
                ids = existing
            else:
                public = (
                    (i["NetworkInterfaceId"], i.get("Association", {}).get("PublicIp")) for i in network_interfaces
                )
                return {interface: Address(host) for interface, host in public if host}
        return {}

    def find(self, name: str, cluster: str) -> str | None:
        """Return the ARN of the living task of this name; None if there is none. AWS calls: one ListTasks.

        Like all listings of ECS, it may miss a task that was run a moment ago.
        """
        try:
            task_arns = self._ecs().list_tasks(cluster=cluster, startedBy=name)["taskArns"]
        except ClientError as error:
            if errors.code(error) == "ClusterNotFoundException":
                return None
            raise
        return str(task_arns[0]) if task_arns else None

    def list(self) -> Iterator[RunningTask]:
        """Yield the tasks of the installation's cluster and participants' own clusters, except those told to stop."""
        for cluster in itertools.chain([self._need("CLUSTER")], self.clusters()):
            yield from self._list(cluster)

    def create_cluster(self, name: str) -> None:
        self._ecs().create_cluster(clusterName=name, capacityProviders=PROVIDERS, settings=NO_CONTAINER_INSIGHTS)

    def delete_cluster(self, name: str) -> None:
        """Delete a participant's own cluster. AWS calls: one DeleteCluster.

        Raises ClusterContainsTasksException or UpdateInProgressException as long as a task is ending in it.
        """
        try:
            self._ecs().delete_cluster(cluster=name)
        except ClientError as error:
            if errors.code(error) != "ClusterNotFoundException":
                raise

    def clusters(self) -> Iterator[str]:
        """Yield the names of participants' own clusters: the clusters of the account that are named like servers."""
        for page in self._ecs().get_paginator("list_clusters").paginate():
            for arn in page["clusterArns"]:
                name = str(arn).rpartition("/")[2]
                if ids.parse_server_name(name):
                    yield name

    def _overrides(self, request: TaskRequest) -> dict[str, Any]:
        variables = {
            **request.environment,
            environment.STORE: self._need("SIGN_URL"),
            environment.HOST: "0.0.0.0",  # noqa: S104 - browsers connect to the trial
            environment.PORT: str(request.port),
        }
        container = {
            "name": CONTAINER,
            "environment": [{"name": name, "value": value} for name, value in sorted(variables.items())],
        }
        overrides = {
            "cpu": str(round(request.cpu * 1024)),
            "memory": str(round(request.memory * 1024)),
            "containerOverrides": [container],
        }
        length = len(json.dumps(overrides))
        if length > MAX_OVERRIDES:
            raise Refused(
                f"the server's environment takes {length} characters, and ECS allows {MAX_OVERRIDES}; "
                "shorten the trial's settings in config.yml"
            )
        return overrides

    def draining(self, *clusters: str) -> Iterator[RunningTask]:
        """Yield the servers' tasks in these clusters that are stopping. They may still store data."""
        for cluster in clusters:
            yield from self._list(cluster, "STOPPED")

    def count(self) -> int:
        """Return how many tasks live in the installation's cluster and in participants' own clusters.

        It calls ListTasks alone: DescribeTasks would also return the tasks' secrets.
        """
        return sum(len(self.arns(cluster)) for cluster in [self._need("CLUSTER"), *self.clusters()])

    def arns(self, cluster: str) -> Sequence[str]:
        """Return the ARNs of all living tasks in a cluster, also of other programs; none if the cluster is deleted."""
        return [arn for page in self._pages(cluster, "RUNNING") for arn in page]

    def _list(self, cluster: str, desired: str = "RUNNING") -> Iterator[RunningTask]:
        for arns in self._pages(cluster, desired):
            try:
                yield from _described(self._ecs(), cluster, arns)
            except ClientError as error:
                if errors.code(error) != "ClusterNotFoundException":
                    raise

    def _pages(self, cluster: str, desired: str) -> Iterator[Sequence[str]]:
        """Yield pages of at most 100 task ARNs; none if the cluster was deleted after it was listed."""
        try:
            for page in self._ecs().get_paginator("list_tasks").paginate(cluster=cluster, desiredStatus=desired):
                yield page["taskArns"]
        except ClientError as error:
            if errors.code(error) != "ClusterNotFoundException":
                raise


def client_token(request: TaskRequest) -> str:
    """Return the `clientToken` of a RunTask call: 64 hex digits.

    It is the same whenever this server is requested on the same kind of capacity, so a repeated RunTask returns the
    first task.
    """
    kind = "FARGATE_SPOT" if request.spot else "FARGATE"
    return hashlib.sha256(f"{request.name}\0{kind}\0{request.nonce}".encode()).hexdigest()


def _described(ecs: Any, cluster: str, arns: Sequence[str]) -> Iterator[RunningTask]:
    if not arns:  # DescribeTasks refuses an empty list; it takes 100, the most that ListTasks gives in a page
        return
    for task in ecs.describe_tasks(cluster=cluster, tasks=arns)["tasks"]:
        name = task.get("startedBy", "")
        if task["lastStatus"] != "STOPPED" and ids.parse_server_name(name):
            details = (d for attached in task.get("attachments", ()) for d in attached.get("details", ()))
            interface = next((d["value"] for d in details if d.get("name") == "networkInterfaceId"), None)
            yield RunningTask(task["taskArn"], cluster, name, interface, task["lastStatus"] == "RUNNING")


def _run_error(error: Exception, request: TaskRequest) -> Exception:
    """The port's error for a failed RunTask; the error itself if the caller can only retry later."""
    name, text = errors.code(error), errors.message(error)
    if _TRANSIENT.search(text) or name not in _REFUSALS:
        return error
    if _NO_CAPACITY.search(text):
        return NoCapacity(text)
    settling = name == "ClusterNotFoundException" or "capacity provider" in text.lower()
    if settling and ids.parse_server_name(request.cluster):
        return error  # the participant's own cluster was created a moment ago, so a later try succeeds
    return Refused(f"{name}: {text}")


def _failures_error(reasons: Sequence[str]) -> Exception:
    """The port's error for a RunTask that succeeded and yet ran no task."""
    text = "; ".join(reasons) or "RunTask started no task and gave no reason"
    return NoCapacity(text) if not reasons or _NO_CAPACITY.search(text) or _TRANSIENT.search(text) else Refused(text)
