"""Enforces roles on moto: each AWS call of a handler is judged by the role of its function in `infra/template.yml`.

While a `MotoWorld` is open, each handler of `lambdas` runs with its function's role and with a platform of its own,
which has only the environment variables that the template gives the function. A call that the role does not allow is
refused with AWS's error. When the world closes, it fails if a call was refused, or if a function has a permission that
only others need (`WHO_MAY`).
"""

from __future__ import annotations

import contextlib
import contextvars
import importlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol
from unittest import mock

import botocore.exceptions

from hippodrome.control.aws import AwsPlatform
from hippodrome.functions import installed
from testing import template as cfn
from testing.aws_events import ACCOUNT
from testing.botocore_sessions import botocore_session
from testing.iam.actions import asks
from testing.iam.judge import Judge, evaluator


class EnforcedWorld(Protocol):
    """The part of a `MotoWorld` that the enforcement needs."""

    platform: AwsPlatform
    region: str
    env: dict[str, str]
    ids: dict[str, str]

    def client(self, service: str) -> Any:
        """Return a client of the world's own, whose calls are not judged."""


@dataclass(frozen=True)
class ApiCall:
    """One call of an AWS API. Calls of the world's own clients (`EnforcedWorld.client`) are left out."""

    service: str  # as botocore names it: s3, ecs, ec2, route53, scheduler, sns, sqs
    operation: str  # PutObject
    params: Mapping[str, Any]  # as given to the client; bodies only as "<n bytes>"

    @property
    def action(self) -> str:
        """Service and operation: `ecs:RunTask`. Most IAM actions have this name (ListObjectsV2 needs `s3:ListBucket`)."""
        return f"{self.service}:{self.operation}"


NEXT, START, TASK, STOP = "next_step", "start_server", "task_changed", "stop_server"
SEND_START, SEND_STOP = "send_start_server_message", "send_stop_server_message"
REGISTER, SWEEP, RENEW, SIGN = "update_project_master_list", "sweep", "renew_certificate", "sign_requests"
CERTIFY = "certify_server"

WHO_MAY: dict[str, set[str]] = {
    # Without s3:ListBucket, S3 gives the same answer for a missing document as for a forbidden one.
    "s3:ListBucket": {NEXT, START, TASK, STOP, SEND_START, SEND_STOP, REGISTER, SWEEP, RENEW, SIGN, CERTIFY},
    # Most functions look up whether a project is live, and its game steps. stop_server stops a participant's servers of
    # all projects if the message names no project.
    "s3:GetObject project_master_list.json": {NEXT, START, TASK, STOP, SEND_START, SEND_STOP, REGISTER, SWEEP},
    "s3:PutObject project_master_list.json": {REGISTER},
    "s3:GetObject steps": {NEXT},
    "s3:GetObject participant.json": {NEXT},
    "s3:PutObject participant.json": {NEXT},
    # Studies with a design: the cells of a study, each participant's levels, and the end that they have reached. A
    # function that starts a server again looks at the participant's own path.
    "s3:GetObject assignment.json": {NEXT, START, TASK, SEND_START, SIGN},
    "s3:PutObject assignment.json": {NEXT},
    "s3:GetObject end.json": {NEXT},
    "s3:PutObject end.json": {NEXT},
    "s3:GetObject _cells": {NEXT, REGISTER},
    "s3:PutObject _cells": {NEXT},
    # Servers have no role: sign_requests presigns the requests with which they read and create documents, and may do no
    # more.
    "s3:GetObject answers": {NEXT, SIGN},
    "s3:PutObject answers": {NEXT, SIGN},
    "s3:GetObject trials": {SIGN},
    "s3:PutObject trials": {SIGN},
    "s3:GetObject SSL": {SIGN, RENEW, CERTIFY, START},
    "s3:GetObject handovers": {SIGN},
    # Sessions: a lobby's entries and its decisions, and the documents of sessions and of their members, which are written
    # once. start_server and stop_server note whether a participant is under way; the sweep finishes decisions that were
    # interrupted. A lost server is replaced unless all members have played; the relays look up a participant's session.
    "s3:GetObject _lobby": {NEXT, SWEEP},
    "s3:PutObject _lobby": {NEXT, START},
    "s3:DeleteObject _lobby": {NEXT, START, STOP, SWEEP},
    "s3:GetObject _lobbies": {NEXT, START, SWEEP},
    "s3:PutObject _lobbies": {NEXT, START, SWEEP},
    "s3:GetObject session.json": {NEXT, START, STOP, SEND_START, SEND_STOP, SWEEP},
    "s3:PutObject session.json": {NEXT, SWEEP},
    "s3:GetObject a session's session.json": {NEXT, START, TASK, STOP, SWEEP, SIGN},
    "s3:PutObject a session's session.json": {NEXT, SWEEP},
    "s3:GetObject a session's trials": {SIGN},
    "s3:PutObject a session's trials": {SIGN},
    # With `matching: match`, next_step asks who plays with whom, and servers answer. The sweep deletes old questions
    # and answers.
    "s3:GetObject _match": {NEXT, SIGN},
    "s3:PutObject _match": {NEXT},
    "s3:GetObject lobby/groups": {NEXT},
    "s3:PutObject lobby/groups": {SIGN},
    "s3:DeleteObject _match": {SWEEP},
    "s3:DeleteObject lobby/groups": {SWEEP},
    # Tickets, tokens and credentials are derived from the secret. It is made with the first project, or with the first
    # server after an upgrade.
    "s3:GetObject _secret.json": {NEXT, START, SEND_START, SEND_STOP, REGISTER, SIGN, CERTIFY},
    "s3:PutObject _secret.json": {START, REGISTER},
    # Functions that show, name, stop or remove servers read the record first; the relays compare the server's token.
    "s3:GetObject _servers": {NEXT, START, TASK, STOP, SEND_START, SEND_STOP, SWEEP, SIGN, CERTIFY},
    "s3:PutObject _servers": {START, TASK, STOP, SWEEP},
    # Slots of projects with limits. next_step takes a slot for a new participant, and registering counts the
    # participants who came before the limit; a function that starts a server takes a slot, and one that ends a server
    # releases it.
    "s3:GetObject slots": {NEXT, REGISTER},
    "s3:PutObject slots": {NEXT, REGISTER},
    "s3:GetObject _slots": {START, TASK, STOP, SWEEP},
    "s3:PutObject _slots": {START, TASK, STOP, SWEEP},
    # Warm servers: the pools (_warm), and the handover of each assigned server. The function that ends the server
    # deletes its handover.
    "s3:GetObject _warm": {START, TASK, STOP, SWEEP},
    "s3:PutObject _warm": {START, TASK, STOP, SWEEP},
    "s3:PutObject handovers": {START},
    "s3:DeleteObject handovers": {START, TASK, STOP, SWEEP},
    # A step or a relay requests a server; a function that finds a lost server requests the next attempt. Registering, and
    # assigning or ending a warm server, request that the pool is adjusted, which may stop servers. The sweep stops
    # servers by messages, and sends the messages of servers that make no progress again.
    "sns:Publish start": {NEXT, START, TASK, STOP, SEND_START, SWEEP, REGISTER},
    "sns:Publish stop": {NEXT, START, SEND_STOP, SWEEP},
    "sqs:SendMessage tasks": {TASK, SWEEP, CERTIFY},
    # The shutdown timer, and the stop relay's delay.
    "scheduler:CreateSchedule": {START, SEND_STOP},
    "scheduler:UpdateSchedule": {START, SEND_STOP},
    "iam:PassRole ScheduleRole": {START, SEND_STOP},
    # A function that ends a server deletes its timer; start_server ends a server whose task AWS refused.
    "scheduler:DeleteSchedule": {START, TASK, STOP, SWEEP},
    "scheduler:ListSchedules": {SWEEP},
    "ecs:RunTask": {START},
    "ecs:TagResource": {START},
    "iam:PassRole TaskExecutionRole": {START},
    "ecs:CreateCluster": {START},
    "ecs:DeleteCluster": {START, TASK, STOP, SWEEP},  # the functions that delete timers
    "ecs:StopTask": {TASK, STOP, SWEEP},  # task_changed: a task that runs too late
    "ecs:ListTasks": {STOP, SWEEP},  # stop_server: a task whose id is not known yet
    "ecs:DescribeTasks": {SWEEP},
    "ecs:ListClusters": {SWEEP},
    "ec2:DescribeNetworkInterfaces": {TASK},
    "route53:ChangeResourceRecordSets UPSERT A": {TASK},
    "route53:ChangeResourceRecordSets DELETE A": {TASK, STOP, SWEEP},  # of a server that has ended
    "route53:GetChange": {TASK, RENEW},
    "route53:ListResourceRecordSets": {SWEEP},
}

_REFUSALS = {"ecs": "AccessDeniedException", "scheduler": "AccessDeniedException", "ec2": "UnauthorizedOperation"}
_running: contextvars.ContextVar[str | None] = contextvars.ContextVar("function", default=None)

Handler = Callable[[dict[str, Any], object], Any]


def account_of(world: EnforcedWorld, of: Mapping[str, Any] | None = None, **parameters: str) -> cfn.ReferenceValues:
    """Return the values of the template's references in the world's account.

    `of` is the template, if it is another one; `parameters` are added to those that the world's environment gives.
    """
    env = world.env
    known = {
        "Bucket": env["BUCKET"],
        "Cluster": env["CLUSTER"],
        "ScheduleGroup": env["SCHEDULE_GROUP"],
        "ScheduleRole.Arn": env["SCHEDULE_ROLE_ARN"],
        "SecurityGroup.GroupId": env["SECURITY_GROUP"],
        "StartServerTopic": env["START_SERVER_TOPIC_ARN"],
        "StopServerTopic": env["STOP_SERVER_TOPIC_ARN"],
        "SubnetA": env["SUBNET"].split(",")[0],
        "SubnetB": env["SUBNET"].split(",")[1],
        "TaskQueue": env["TASK_QUEUE_URL"],
        "TaskQueue.Arn": world.ids["task_queue_arn"],
        "TaskExecutionRole.Arn": world.ids["task_execution_role"],
    }
    given = {
        "HostedZoneId": env["HOSTED_ZONE_ID"],
        "RootDomain": env["ROOT_DOMAIN"],
        "MaxRuntime": env["MAX_RUNTIME"],
        **parameters,
    }
    return cfn.ReferenceValues("hippodrome", ACCOUNT, world.region, given, known, of or cfn.template())


class IamEnforcement:
    """Judges the calls of one world. `refused` and `too_much` are the findings, in sentences."""

    def __init__(self, world: EnforcedWorld, of: Mapping[str, Any] | None = None, **parameters: str) -> None:
        self._world = world
        self.region, self.account = world.region, ACCOUNT
        self._account = account_of(world, of, **parameters)
        self._judge = Judge(self._account)
        self._rooms: dict[str, tuple[Any, dict[Any, Any]]] = {}
        self.kinds: set[str] = set()  # the kinds of permissions that were needed
        self.refused: list[str] = []
        self.too_much: list[str] = []

    @classmethod
    def of(cls, world: EnforcedWorld) -> IamEnforcement | None:
        """Return the enforcement of a world; None without an evaluator, which `test_enforcement.py` reports."""
        return cls(world) if evaluator() else None

    @contextlib.contextmanager
    def enforced(self) -> Iterator[None]:
        """Run handlers with the roles of their functions within the block."""
        with contextlib.ExitStack() as stack:
            for name in self._judge.functions:
                if name not in (RENEW, CERTIFY):  # need an authority; their calls are judged in test_enforcement.py
                    module = importlib.import_module(f"hippodrome.functions.{name}")
                    stack.enter_context(mock.patch.object(module, "handler", self._as_function(name, module.handler)))
            yield

    def findings(self) -> list[str]:
        """Return what was wrong, in sentences, each once."""
        return [*dict.fromkeys([*self.refused, *self.too_much])]

    def judge(self, call: ApiCall) -> dict[str, Any] | None:
        """Return AWS's error if the running function may not make this call; None if it may, or if no function runs."""
        function = _running.get()
        if function is None:
            return None
        try:
            wanted = asks(call.service, call.operation, call.params, self)
        except KeyError:
            return self._refuse(call, f"{function} calls {call.action}, which actions.py does not describe")
        for ask in wanted:
            self.kinds.add(ask.kind)
            if not self._judge.may(function, ask):
                return self._refuse(call, f"{function} may not {ask.kind} on {ask.resource}")
            others = self._judge.who_may(ask) - WHO_MAY.get(ask.kind, set())
            self.too_much += [f"{other} may {ask.kind} as well, which is not needed" for other in sorted(others)]
        return None

    def signed(self, call: ApiCall) -> None:
        """Judge a presigned request by the role of `sign_requests`, which has signed it."""
        token = _running.set(SIGN)
        try:
            self.judge(call)
        finally:
            _running.reset(token)

    def _refuse(self, call: ApiCall, why: str) -> dict[str, Any]:
        self.refused.append(why)
        return {"Error": {"Code": _REFUSALS.get(call.service, "AccessDenied"), "Message": why}}

    def _as_function(self, name: str, handler: Handler) -> Handler:
        def run(event: dict[str, Any], context: object) -> Any:
            token = _running.set(name)
            theirs = installed._platform, installed._made
            ours = theirs[0] is self._world.platform
            if ours:
                installed._platform, installed._made = self._room(name)
            try:
                return handler(event, context)
            finally:
                if ours:
                    installed._platform, installed._made = theirs
                _running.reset(token)

        return run

    def _room(self, name: str) -> tuple[Any, dict[Any, Any]]:
        """Return the function's own platform, and the cache that it keeps between invocations."""
        if name not in self._rooms:
            self._rooms[name] = (AwsPlatform(self.environment(name), botocore_session()), {})
        return self._rooms[name]

    def environment(self, name: str) -> dict[str, str]:
        """Return the environment variables that the template gives the function."""
        properties = self._account.of["Resources"][self._judge.functions[name]]["Properties"]
        return {
            "AWS_REGION": self.region,
            **self._account.resolve(properties.get("Environment", {}).get("Variables", {})),
        }

    # Facts for `asks`

    def exists(self, bucket: str, key: str) -> bool:
        try:
            self._world.client("s3").head_object(Bucket=bucket, Key=key)
        except botocore.exceptions.ClientError:
            return False
        return True

    def definition(self, name: str) -> tuple[str, list[str]]:
        found = self._world.client("ecs").describe_task_definition(taskDefinition=name)["taskDefinition"]
        return found["taskDefinitionArn"], [found[key] for key in ("taskRoleArn", "executionRoleArn") if key in found]

    def short_name(self, arn: str) -> str:
        names = {
            self._account.ref("StartServerTopic"): "start",
            self._account.ref("StopServerTopic"): "stop",
            self._account.attribute("TaskQueue", "Arn"): "tasks",
            **{self._account.attribute(role, "Arn"): role for role in ("ScheduleRole", "TaskExecutionRole")},
        }
        return names.get(arn, arn)
