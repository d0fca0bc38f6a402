"""An AWS account on moto with all resources that Hippodrome needs, and with bridges over the gaps of moto.

`MotoWorld` is a context manager; the fixture `moto_world` enters one for a test::

    def test_something(moto_world):
        task = moto_world.platform.tasks.run(request)
        event = moto_world.task_event(task, "RUNNING")  # an ECS event for `task_changed`
        ...
        assert "ecs:RunTask" in moto_world.actions

A comment at each bridge says which gap of moto 5.2 it closes (search for "Gap:"). Bridges change moto itself, so they
hold for every client.

Gap: moto's IAM does not judge calls by the roles of functions. Bridge: while a world is open, the handlers in
`lambdas/` run with the roles and variables of `infra/template.yml`; see `testing/iam/enforcement.py`. If a handler was
refused a call, the world fails when it closes.

This module copies collections of moto before it reads them, since handlers may change them in other threads meanwhile.
"""

from __future__ import annotations

import contextlib
import functools
import io
import json
import os
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Self
from unittest import mock

import botocore.handlers
import moto
import pytest
from botocore.awsrequest import AWSResponse
from moto.core.botocore_stubber import BotocoreStubber
from moto.core.responses import ActionResult
from moto.ec2.models import ec2_backends
from moto.ecs.exceptions import ECSException
from moto.ecs.models import EC2ContainerServiceBackend, ecs_backends
from moto.ecs.responses import EC2ContainerServiceResponse
from moto.moto_api import state_manager
from moto.route53.exceptions import Route53ClientError
from moto.route53.models import Route53Backend, route53_backends
from moto.route53.responses import Route53
from moto.s3.models import s3_backends
from moto.scheduler.models import scheduler_backends
from moto.sns.models import sns_backends
from moto.sqs.models import sqs_backends

from hippodrome.control.aws import AwsPlatform
from testing import aws_events
from testing.aws_events import ACCOUNT, IMAGE
from testing.botocore_sessions import botocore_session
from testing.iam.enforcement import ApiCall, IamEnforcement


@dataclass
class ScriptedAnswer:
    """An answer that the next `times` calls of an operation get instead of moto's."""

    service: str
    operation: str
    parsed: dict[str, Any]
    status: int
    times: int
    when: Callable[[Mapping[str, Any]], bool] | None = None  # only calls count whose parameters satisfy this


class MotoWorld:
    """One account. `env` are the functions' environment variables; `platform` is an `AwsPlatform` made from them.

    `raw_delivery`: whether the queues get messages without SNS's envelope. `enforce`: whether calls of handlers are
    judged.
    """

    def __init__(self, region: str = "us-east-1", raw_delivery: bool = True, enforce: bool = True) -> None:
        self.region = region
        self.root_domain = "example.org"
        self.raw_delivery = raw_delivery
        self.calls: list[ApiCall] = []
        self.in_sync = True  # False: Route 53 answers PENDING to every GetChange
        self.env: dict[str, str] = {}
        self.ids: dict[str, str] = {}  # the ids of the account's resources: VPC, zone, queue URLs and ARNs, …
        self._lock = threading.RLock()
        self._answers: list[ScriptedAnswer] = []
        self._tokens: dict[tuple[str, str], tuple[str, list[Any]]] = {}
        self._versions: Counter[str] = Counter()
        self._stack = contextlib.ExitStack()
        self._enforce = enforce
        self.iam: IamEnforcement | None = None  # judges the handlers' calls

    # -- opening and closing -----------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        self._stack.enter_context(mock.patch.dict(os.environ, MOTO_EC2_LOAD_DEFAULT_AMIS="false"))  # 0.1 s
        self._stack.enter_context(moto.mock_aws())
        self._bridge()
        self._record()
        self._build()
        self.platform = AwsPlatform(self.env, botocore_session())
        if self._enforce:
            self.enforce(IamEnforcement.of(self))
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()
        findings = self.iam.findings() if self.iam else []
        assert error[0] or not findings, findings

    def enforce(self, iam: IamEnforcement | None) -> None:
        """Judge the handlers' calls by these roles until the world closes; None judges nothing."""
        self.iam = iam
        if iam:
            self._stack.enter_context(iam.enforced())

    def client(self, service: str) -> Any:
        """Return a client of the world's own: its calls are not recorded, not judged, and never scripted."""
        with _making:
            return _own_client(service, self.region)

    # -- recording and scripting the calls -------------------------------------------------------------------------

    @property
    def actions(self) -> list[str]:
        """The action of every call so far, such as `ecs:RunTask`, in order."""
        return [call.action for call in self.calls]

    @contextlib.contextmanager
    def recording(self) -> Iterator[list[ApiCall]]:
        """Give a list that holds the calls of the block after its end."""
        recorded: list[ApiCall] = []
        start = len(self.calls)
        yield recorded
        recorded.extend(self.calls[start:])

    def answer(self, action: str, parsed: dict[str, Any], status: int = 200, times: int = 1) -> None:
        """Answer the next `times` calls of `action` ("ecs:RunTask") with `parsed`; they do not reach moto."""
        service, operation = action.split(":")
        self._answers.append(ScriptedAnswer(service, operation, parsed, status, times))

    def fail(
        self, action: str, code: str, message: str = "made up", status: int = 400, times: int = 1, **more: Any
    ) -> None:
        """Let the next `times` calls of `action` fail with this error. botocore never retries such a call."""
        self.answer(action, {"Error": {"Code": code, "Message": message}, **more}, status, times)

    def refuse(self, action: str, when: Callable[[Mapping[str, Any]], bool], code: str, message: str) -> None:
        """Let every later call of `action` fail whose parameters satisfy `when`."""
        service, operation = action.split(":")
        parsed = {"Error": {"Code": code, "Message": message}}
        self._answers.append(ScriptedAnswer(service, operation, parsed, 400, sys.maxsize, when))

    def _record(self) -> None:
        def before_build(params: Mapping[str, Any], model: Any, context: dict[str, Any], **_: Any) -> None:
            context["hippodrome_params"] = {name: _summary(value) for name, value in params.items()}

        def before_call(model: Any, params: Any, context: dict[str, Any], **_: Any) -> Any:
            call = ApiCall(model.service_model.service_name, model.name, context.get("hippodrome_params", {}))
            with self._lock:
                self.calls.append(call)
                refusal = self.iam.judge(call) if self.iam else None
                if refusal:
                    return AWSResponse(params["url"], 403, {}, None), {
                        **refusal,
                        "ResponseMetadata": {"HTTPStatusCode": 403},
                    }
                for answer in self._answers:
                    fits = (answer.service, answer.operation) == (call.service, call.operation)
                    if fits and (answer.when is None or answer.when(call.params)):
                        answer.times -= 1
                        if not answer.times:
                            self._answers.remove(answer)
                        parsed = {**answer.parsed, "ResponseMetadata": {"HTTPStatusCode": answer.status}}
                        return AWSResponse(params["url"], answer.status, {}, None), parsed
            return None

        ours: list[tuple[str, Any]] = [("before-parameter-build", before_build), ("before-call", before_call)]
        botocore.handlers.BUILTIN_HANDLERS.extend(ours)  # for every session made from now on, boto3's too

        def forget() -> None:
            for handler in ours:
                botocore.handlers.BUILTIN_HANDLERS.remove(handler)

        self._stack.callback(forget)

    # -- bridges --------------------------------------------------------------------------------------------------

    def one_at_a_time(self, app: Callable[..., Any]) -> Callable[..., Any]:
        """Wrap a WSGI application for this account, such as moto's server, so that it serves one request at a time."""

        def serve(environ: dict[str, Any], start_response: Any) -> Any:
            with self._lock:
                return app(environ, start_response)

        return serve

    def _bridge(self) -> None:
        world = self

        # Gap: moto reads, compares and writes without a lock, so two conditional writes in two threads can both win.
        # AWS decides each one atomically. Bridge: one request at a time; see `one_at_a_time` for moto's server.
        serve = BotocoreStubber.__call__

        def one_at_a_time(stubber: Any, event_name: str, request: Any, **kwargs: Any) -> Any:
            with world._lock:
                return serve(stubber, event_name, request, **kwargs)

        self._patch(BotocoreStubber, "__call__", one_at_a_time)

        # Gap: RunTask ignores clientToken. On ECS the same token and parameters in a cluster give the same task again,
        # and other parameters a ConflictException that names it.
        run_task = EC2ContainerServiceResponse.run_task

        def run_once(response: Any) -> Any:
            token = response._get_param("clientToken")
            if not token:
                return run_task(response)
            request = json.dumps(json.loads(response.body), sort_keys=True)
            key = (response._get_param("cluster", "default"), token)
            if key in world._tokens:
                before, tasks = world._tokens[key]
                if before != request:
                    raise _TokenConflict([task.task_arn for task in tasks])
                return ActionResult({"tasks": tasks, "failures": []})
            result: Any = run_task(response)
            world._tokens[key] = (request, result.result["tasks"])
            return result

        self._patch(EC2ContainerServiceResponse, "run_task", run_once)

        # Gap: StopTask of an unknown task is an internal error in moto; ECS says InvalidParameterException.
        stop_task = EC2ContainerServiceBackend.stop_task

        def stop_known(backend: Any, cluster_str: str, task_str: str, reason: str) -> Any:
            cluster = backend._get_cluster(cluster_str)
            known = backend.tasks.get(cluster.name) or {}
            if not any(arn.endswith(aws_events.last(task_str)) for arn in known):
                raise _EcsError("InvalidParameterException", "The referenced task was not found.")
            return stop_task(backend, cluster_str, task_str, reason)

        self._patch(EC2ContainerServiceBackend, "stop_task", stop_known)

        # Gap: ListTasks gives tasks in any state; on ECS only those not told to stop, unless it is asked for the others.
        list_tasks = EC2ContainerServiceBackend.list_tasks

        def list_asked(backend: Any, *args: Any, **kwargs: Any) -> Any:
            asked = "STOPPED" if "STOPPED" in (*args, *kwargs.values()) else "RUNNING"
            return [task for task in list_tasks(backend, *args, **kwargs) if task.desired_status == asked]

        self._patch(EC2ContainerServiceBackend, "list_tasks", list_asked)

        # Gap: a cluster with tasks can be deleted; ECS says ClusterContainsTasksException.
        delete_cluster = EC2ContainerServiceBackend.delete_cluster

        def delete_empty(backend: Any, cluster_str: str) -> Any:
            cluster = backend._get_cluster(cluster_str)
            if any(task.last_status != "STOPPED" for task in backend.tasks.get(cluster.name, {}).values()):
                raise _EcsError(
                    "ClusterContainsTasksException", "The Cluster cannot be deleted while Tasks are active."
                )
            return delete_cluster(backend, cluster_str)

        self._patch(EC2ContainerServiceBackend, "delete_cluster", delete_empty)

        # Gap: list_clusters names deleted (INACTIVE) clusters, too, and create_cluster replaces an existing cluster.
        list_clusters = EC2ContainerServiceBackend.list_clusters
        create_cluster = EC2ContainerServiceBackend.create_cluster

        def list_active(backend: Any) -> list[str]:
            inactive = {cluster.arn for cluster in backend.clusters.values() if cluster.status == "INACTIVE"}
            return [arn for arn in list_clusters(backend) if arn not in inactive]

        def create_once(backend: Any, cluster_name: str, *args: Any, **kwargs: Any) -> Any:
            present = backend.clusters.get(cluster_name)
            if present is not None and present.status == "ACTIVE":
                return present
            return create_cluster(backend, cluster_name, *args, **kwargs)

        self._patch(EC2ContainerServiceBackend, "list_clusters", list_active)
        self._patch(EC2ContainerServiceBackend, "create_cluster", create_once)

        # Gap: moto's Route 53 deletes a record whatever values the change has, and answers InvalidInput for an unknown
        # record. AWS refuses the whole batch (InvalidChangeBatch) unless every DELETE matches in name, TTL and values.
        change_sets = Route53Backend.change_resource_record_sets

        def change_strictly(backend: Any, zoneid: str, change_list: list[dict[str, Any]]) -> Any:
            _check_batch(backend.get_hosted_zone(zoneid), change_list)
            return change_sets(backend, zoneid, change_list)

        self._patch(Route53Backend, "change_resource_record_sets", change_strictly)

        # Gap: every change is INSYNC at once in moto. Bridge: `world.in_sync = False` makes changes wait.
        get_change = Route53.get_change

        def get_change_in_time(response: Any) -> Any:
            result: Any = get_change(response)
            if not world.in_sync:
                result.result["ChangeInfo"]["Status"] = "PENDING"
            return result

        self._patch(Route53, "get_change", get_change_in_time)

        # Gap: each DescribeTasks moves a task on, from RUNNING to STOPPED. Bridge: only `task_event` changes its state.
        state_manager.set_transition("ecs::task", {"progression": "manual", "times": 10**9})
        self._stack.callback(state_manager.unset_transition, "ecs::task")

    def _patch(self, owner: type, name: str, replacement: Any) -> None:
        self._stack.enter_context(mock.patch.object(owner, name, replacement))

    # -- the account ----------------------------------------------------------------------------------------------

    def _build(self) -> None:
        """Make the account's resources as moto's own objects, which is 46 ms faster for each world than API calls."""
        ec2, ecs = ec2_backends[ACCOUNT][self.region], ecs_backends[ACCOUNT][self.region]
        vpc = ec2.create_vpc("10.0.0.0/16").id
        ec2.modify_vpc_attribute(vpc, "enable_dns_hostnames", "true")  # Gap: moto's RunTask fails without it
        zones = ec2.describe_availability_zones()
        subnets = [ec2.create_subnet(vpc, f"10.0.{16 * n}.0/20", availability_zone=zones[n].name).id for n in range(2)]
        group = ec2.create_security_group("hippodrome", "servers", vpc_id=vpc).id

        ecs.create_cluster("hippodrome", capacity_providers=["FARGATE", "FARGATE_SPOT"])
        role = f"arn:aws:iam::{ACCOUNT}:role/hippodrome-task_execution_role"
        container = {
            "name": "trial",
            "image": IMAGE,
            "essential": True,
            "memory": 2048,  # Gap: moto requires it of the container, even if the task has its own
            "portMappings": [{"containerPort": 5000, "protocol": "tcp"}],
        }
        ecs.register_task_definition(
            "hippodrome",
            [container],
            network_mode="awsvpc",
            requires_compatibilities=["FARGATE"],
            cpu="1024",
            memory="2048",
            execution_role_arn=role,
        )

        bucket = f"hippodrome-{ACCOUNT}"
        s3_backends[ACCOUNT]["aws"].create_bucket(bucket, self.region)
        zone = route53_backends[ACCOUNT]["aws"].create_hosted_zone(f"{self.root_domain}.", False, "world")
        zone_id = zone.id.removeprefix("/hostedzone/")

        start = self._topic("start", "hippodrome-start-server", "hippodrome-start")
        stop = self._topic("stop", "hippodrome-stop-server", "hippodrome-stop")
        tasks = self._queue("task", "hippodrome-tasks")

        scheduler_backends[ACCOUNT][self.region].create_schedule_group("hippodrome", [])
        self.ids |= {"vpc": vpc, "zone": zone_id, "bucket": bucket, "task_execution_role": role}
        self.env |= {
            "AWS_REGION": self.region,
            "BUCKET": bucket,
            "CLUSTER": "hippodrome",
            "HOSTED_ZONE_ID": zone_id,
            "MAX_RUNTIME": "120",
            "ROOT_DOMAIN": self.root_domain,
            "SERVERS_HOST": "servers",
            "SCHEDULE_GROUP": "hippodrome",
            "SCHEDULE_ROLE_ARN": f"arn:aws:iam::{ACCOUNT}:role/hippodrome-schedule",
            "SECURITY_GROUP": group,
            "SIGN_URL": f"https://study.{self.root_domain}/sign",
            "START_SERVER_TOPIC_ARN": start,
            "STOP_SERVER_TOPIC_ARN": stop,
            "SUBNET": ",".join(subnets),
            "TASK_DEFINITION": "hippodrome",
            "TASK_QUEUE_URL": tasks,
        }

    def _topic(self, key: str, topic_name: str, queue_name: str) -> str:
        sns = sns_backends[ACCOUNT][self.region]
        topic = str(sns.create_topic(topic_name).arn)
        self._queue(key, queue_name)
        subscription = sns.subscribe(topic, self.ids[f"{key}_queue_arn"], "sqs")
        sns.set_subscription_attributes(subscription.arn, "RawMessageDelivery", self.raw_delivery)
        return topic

    def _queue(self, key: str, name: str) -> str:
        sqs_backends[ACCOUNT][self.region].create_queue(name)
        url = f"https://sqs.{self.region}.amazonaws.com/{ACCOUNT}/{name}"
        self.ids |= {f"{key}_queue": url, f"{key}_queue_arn": f"arn:aws:sqs:{self.region}:{ACCOUNT}:{name}"}
        return url

    # -- queues ---------------------------------------------------------------------------------------------------

    def receive(self, queue: str, at_most: int = 10) -> dict[str, Any]:
        """Return the messages of `queue` ("start", "stop", "task") as the SQS event that its function would get.

        The messages are deleted from the queue, as after a success. A delayed message comes after its delay, or after
        `skip_delays`.
        """
        sqs, url = self.client("sqs"), self.ids[f"{queue}_queue"]
        held = sqs_backends[ACCOUNT][self.region].queues[aws_events.last(url)]
        bodies: list[str] = []
        while len(bodies) < at_most and held.messages:  # no call for an empty queue, which is the usual case
            wanted = min(10, at_most - len(bodies))
            found = sqs.receive_message(QueueUrl=url, MaxNumberOfMessages=wanted, WaitTimeSeconds=0).get("Messages", [])
            if not found:
                break
            for message in found:
                bodies.append(message["Body"])
                sqs.delete_message(QueueUrl=url, ReceiptHandle=message["ReceiptHandle"])
        return self.sqs_event(queue, bodies)

    def sqs_event(self, queue: str, bodies: list[Any]) -> dict[str, Any]:
        """Return an SQS event with these bodies, as if they came from `queue`. Bodies that are no texts become JSON."""
        return aws_events.sqs_event(bodies, self.ids[f"{queue}_queue_arn"], self.region)

    def skip_delays(self) -> None:
        """Make every delayed message of every queue visible now."""
        for queue in sqs_backends[ACCOUNT][self.region].queues.values():
            for message in queue._messages:
                message.delayed_until = 0

    # -- tasks ----------------------------------------------------------------------------------------------------

    def task(self, task: str) -> Any:
        """Return moto's own object of the task with this ARN or id. Raises LookupError if there is none."""
        for tasks in list(ecs_backends[ACCOUNT][self.region].tasks.values()):
            for arn, found in list(tasks.items()):
                if arn.endswith(aws_events.last(task)):
                    return found
        raise LookupError(task)

    def task_arns(self) -> list[str]:
        """Return the ARN of every task so far, in the order of RunTask within each cluster."""
        return [arn for tasks in list(ecs_backends[ACCOUNT][self.region].tasks.values()) for arn in list(tasks)]

    def task_event(
        self,
        task: str,
        status: str,
        *,
        stop_code: str | None = None,
        reason: str | None = None,
        exit_code: int | None = 0,
        container_reason: str = "",
        desired: str | None = None,
        version: int | None = None,
        time: datetime | None = None,
    ) -> dict[str, Any]:
        """Move `task` to `status`, and return the "ECS Task State Change" event of that, in the form of `tests/events`.

        Gap: moto sends no events and gives no public address. Bridge: RUNNING associates an address with the task's
        network interface; DEPROVISIONING ends the task's container; STOPPED removes the interface, too, as Fargate
        does.

        The default of `stop_code` is UserInitiated after StopTask, with the reason of that call, else
        EssentialContainerExited; the default of `version` counts the events of the task. RUNNING with
        `desired="STOPPED"` is Spot's warning.
        """
        found = self.task(task)
        arn = found.task_arn
        details = {item["name"]: item["value"] for item in found.attachments[0]["details"]}
        interface = details["networkInterfaceId"]
        if status == "RUNNING":
            self.public_ip(arn)
        if status == "DEPROVISIONING":
            found.last_status, found.desired_status = status, "STOPPED"
        if status == "STOPPED":
            found.last_status = found.desired_status = "STOPPED"
            self._remove_interface(interface)
        self._versions[arn] += 1
        return aws_events.ecs_event(
            region=self.region,
            arn=arn,
            cluster_arn=found.cluster_arn,
            definition=found.task_definition_arn,
            status=status,
            desired=desired or found.desired_status,
            started_by=found.started_by,
            capacity_provider=found.capacity_provider_name,
            overrides=found.overrides,
            subnet=details["subnetId"],
            interface=interface,
            private_ip=details["privateIPv4Address"],
            stop_code=stop_code or ("UserInitiated" if found.stopped_reason else "EssentialContainerExited"),
            reason=reason or found.stopped_reason or None,
            exit_code=exit_code,
            container_reason=container_reason,
            version=version or self._versions[arn],
            time=time or datetime.now(UTC),
        )

    def public_ip(self, task: str) -> str:
        """Return the public IPv4 address of a task; associate one first if it has none.

        Gap: `assignPublicIp` has no effect in moto. Bridge: an elastic address, which DescribeNetworkInterfaces shows
        in the same way.
        """
        ec2 = self.client("ec2")
        details = {item["name"]: item["value"] for item in self.task(task).attachments[0]["details"]}
        interface = details["networkInterfaceId"]
        with self._lock:
            found = ec2.describe_network_interfaces(NetworkInterfaceIds=[interface])["NetworkInterfaces"][0]
            if found.get("Association"):
                return str(found["Association"]["PublicIp"])
            address = ec2.allocate_address(Domain="vpc")
            ec2.associate_address(AllocationId=address["AllocationId"], NetworkInterfaceId=interface)
            return str(address["PublicIp"])

    def _remove_interface(self, interface: str) -> None:
        backend = ec2_backends[ACCOUNT][self.region]
        with self._lock:
            if interface in backend.enis:
                backend.addresses = [a for a in backend.addresses if a.eni is None or a.eni.id != interface]
                del backend.enis[interface]

    # -- names ----------------------------------------------------------------------------------------------------

    def records(self) -> dict[str, str]:
        """Return, by name without the final dot, the addresses of the zone's A records."""
        zone = route53_backends[ACCOUNT]["aws"].get_hosted_zone(self.ids["zone"])
        return {r.name.rstrip("."): r.records[0] for r in list(zone.rrsets) if r.type == "A"}

    # -- timers ---------------------------------------------------------------------------------------------------

    def timers(self) -> dict[str, tuple[datetime, dict[str, Any]]]:
        """Return the one-time schedules by name, each with its time (UTC) and message."""
        schedules = scheduler_backends[ACCOUNT][self.region].schedule_groups["hippodrome"].schedules
        found = {}
        for name, schedule in list(schedules.items()):
            at = datetime.strptime(schedule.schedule_expression, "at(%Y-%m-%dT%H:%M:%S)").replace(tzinfo=UTC)
            found[name] = (at, json.loads(schedule.target["Input"]))
        return found

    def fire_timer(self, name: str) -> dict[str, Any]:
        """Publish the schedule's input to its target's topic, then delete it, as the Scheduler does.

        Return the message.

        Gap: schedules never fire in moto. Raises KeyError if there is no such schedule.
        """
        schedules = scheduler_backends[ACCOUNT][self.region].schedule_groups["hippodrome"].schedules
        schedule = schedules[name]
        self.client("sns").publish(TopicArn=schedule.target["Arn"], Message=schedule.target["Input"])
        if schedule.action_after_completion == "DELETE":
            del schedules[name]
        return dict(json.loads(schedule.target["Input"]))


_making = threading.Lock()  # making a client is not thread-safe, using one is
_own_session = botocore_session()  # made before the handlers of any world: its calls are not recorded


@functools.cache
def _own_client(service: str, region: str) -> Any:
    return _own_session.create_client(service, region_name=region)


@pytest.fixture
def moto_world() -> Iterator[MotoWorld]:
    """Open a `MotoWorld` for a test."""
    with MotoWorld() as world:
        yield world


def _summary(value: Any) -> Any:
    if isinstance(value, bytes | bytearray):
        return f"<{len(value)} bytes>"
    if isinstance(value, io.BytesIO):  # botocore wraps the body of an S3 request
        return f"<{value.getbuffer().nbytes} bytes>"
    return value


# -- errors and checks that moto lacks ----------------------------------------------------------------------------


class _EcsError(ECSException):
    pass


class _TokenConflict(_EcsError):
    def __init__(self, tasks: list[str]) -> None:
        super().__init__(
            "ConflictException",
            "The provided clientToken is already in use with a different RunTask request.",
        )
        self.resource_ids = tasks


def _check_batch(zone: Any, change_list: list[dict[str, Any]]) -> None:
    """Raise Route 53's InvalidChangeBatch if the zone would refuse one of these changes."""
    present = {
        (_fold(r.name), r.type): (int(r.ttl), sorted(r.records))
        for r in list(zone.rrsets)
        if r.ttl is not None and r.records
    }
    wrong = []
    for change in change_list:
        record = change["ResourceRecordSet"]
        key = (_fold(record["Name"]), record["Type"])
        values = (int(record.get("TTL") or 0), sorted(item["Value"] for item in record.get("ResourceRecords") or ()))
        record_set = f"resource record set [name='{key[0]}', type='{key[1]}']"
        if change["Action"] == "DELETE":
            if key not in present:
                wrong.append(f"Tried to delete {record_set} but it was not found")
            elif present[key] != values:
                wrong.append(f"Tried to delete {record_set} but the values provided do not match the current values")
            else:
                del present[key]
        elif change["Action"] == "CREATE" and key in present:
            wrong.append(f"Tried to create {record_set} but it already exists")
        else:
            present[key] = values
        # Gap: moto accepts any name. Route 53 refuses the batch (external-dns, issues 2839 and 1517).
        for label in record["Name"].rstrip(".").split("."):
            if len(label) > 63:
                wrong.append(f"FATAL problem: DomainLabelTooLong (Domain label is too long) encountered with '{label}'")
        if record["Type"] == "A" and (key[0], "CNAME") in present:
            wrong.append(
                f"RRSet of type A with DNS name {key[0]} is not permitted because a conflicting RRSet of type  CNAME "
                f"with the same DNS name already exists in zone {zone.name}"
            )
    if wrong:
        raise _InvalidBatch(wrong)


def _fold(name: str) -> str:
    return name.rstrip(".").lower() + "."


class _InvalidBatch(Route53ClientError):
    def __init__(self, messages: list[str]) -> None:
        super().__init__("InvalidChangeBatch", f"[{', '.join(messages)}]")
