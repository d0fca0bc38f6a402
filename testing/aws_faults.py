"""Faults of AWS in the HTTP answers that botocore receives, at one call of the functions at a time.

Faults are injected *below* botocore, where moto takes the place of the network. The bodies have the form of each
service's own protocol, so botocore parses them, decides whether to try again, and gives up, as it does on AWS. A fault
has one of these reaches:

* `Reach.ATTEMPT`: one attempt of a call fails. Where botocore tries again by itself (at most 3 attempts), the functions
  should not notice the fault.
* `Reach.CALL`: every attempt of one call fails. botocore gives up, and the port gets the error.
* `Reach.SPELL`: every call of the operation fails until the invocation ends; for errors after which the ports try again
  themselves.

Nothing sleeps: `AwsFaultInjector.waited` adds up the pauses of botocore and of the ports, each at its longest.
"""

from __future__ import annotations

import contextlib
import json
import re
from collections.abc import Iterator
from enum import StrEnum
from functools import partial
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest import mock

import botocore.session
from botocore.awsrequest import AWSResponse
from botocore.exceptions import ConnectionClosedError, ConnectTimeoutError, ReadTimeoutError
from botocore.retries import quota, standard
from moto.core.botocore_stubber import BotocoreStubber, MockRawResponse

from hippodrome.aws import dns, documents
from hippodrome.aws.retry import retry_while_busy


class FaultKind(StrEnum):
    """The kind of a fault."""

    THROTTLED = "throttled"  # the service's own error for too many calls
    INTERNAL = "internal error"  # 500, and nothing was done
    NOT_NOW = "not now"  # the operation's own error, from the table `NOT_NOW`
    CONNECT = "connect timeout"  # nothing was done
    CLOSED = "connection closed"  # a kept connection was closed; nothing was done
    READ = "reply lost"  # read timeout: the call was carried out, but the caller cannot know
    BROKEN = "body breaks off"  # only a part of the body of a document comes


class Reach(StrEnum):
    """The duration of a fault. The module's docstring says what each value means."""

    ATTEMPT = "one attempt"
    CALL = "the call"
    SPELL = "the invocation"


class AwsFault(NamedTuple):
    """A fault of the `number`-th call of the functions, counted from 1."""

    number: int
    kind: FaultKind
    reach: Reach


class MadeCall(NamedTuple):
    """A call: the function that made it, and the action, as `service:Operation`."""

    function: str
    action: str


class Error(NamedTuple):
    """An error of AWS: HTTP status, code, message."""

    status: int
    code: str
    message: str


# The error with which each service throttles (API references of the services, their common errors; retry codes of
# botocore 1.44).
THROTTLED = {
    "s3": Error(503, "SlowDown", "Please reduce your request rate."),
    "ecs": Error(400, "ThrottlingException", "Rate exceeded"),
    "ec2": Error(503, "RequestLimitExceeded", "Request limit exceeded."),
    "route53": Error(400, "Throttling", "Rate exceeded"),
    "scheduler": Error(429, "ThrottlingException", "Rate exceeded"),
    "sns": Error(400, "Throttling", "Rate exceeded"),
    "sqs": Error(403, "RequestThrottled", "Request is throttled."),
}
INTERNAL = {
    "s3": Error(500, "InternalError", "We encountered an internal error. Please try again."),
    "ecs": Error(500, "ServerException", "Service Unavailable. Please try again later."),
    "ec2": Error(500, "InternalError", "An internal error has occurred"),
    "route53": Error(500, "InternalFailure", "We encountered an internal error."),
    "scheduler": Error(500, "InternalServerException", "Internal error"),
    "sns": Error(500, "InternalError", "Internal error"),
    "sqs": Error(500, "InternalFailure", "Internal error"),
}
_PRIOR = "The request was rejected because Route 53 was still processing a prior request."
_CHANGING = "The schedule is being changed or deleted."
NOT_NOW: dict[str, Error | dict[str, Any]] = {
    "s3:PutObject": Error(409, "ConditionalRequestConflict", "A conflicting conditional operation is under way."),
    "route53:ChangeResourceRecordSets": Error(400, "PriorRequestNotComplete", _PRIOR),
    # EC2 throttles, and ECS reports that with an error code of its own.
    "ecs:RunTask": Error(400, "InvalidParameterException", "Error retrieving subnet information: Request limit exceeded."),
    "ecs:DeleteCluster": Error(400, "ClusterContainsTasksException", "The Cluster cannot be deleted yet."),
    "scheduler:CreateSchedule": Error(409, "ConflictException", _CHANGING),  # an update finds no such schedule
    "scheduler:DeleteSchedule": Error(409, "ConflictException", _CHANGING),
    # EC2 does not know the interface yet. {interface} is filled in.
    "ec2:DescribeNetworkInterfaces": Error(400, "InvalidNetworkInterfaceID.NotFound", "The ID '{interface}' does not exist"),
    # Gap: moto's lists are always up to date. On ECS they may be late; here the list then lacks a task that was just run.
    "ecs:ListTasks": {"taskArns": []},
}  # fmt: skip

SOLD_OUT = {"tasks": [], "failures": [{"reason": "Capacity is unavailable at this time. Please try again later"}]}


def kinds(action: str) -> list[FaultKind]:
    """Return the kinds of faults that a call of this action, `service:Operation`, can have."""
    return [
        FaultKind.THROTTLED,
        FaultKind.INTERNAL,
        *([FaultKind.NOT_NOW] if action in NOT_NOW else []),
        FaultKind.CONNECT,
        FaultKind.CLOSED,
        FaultKind.READ,
        *([FaultKind.BROKEN] if action == "s3:GetObject" else []),
    ]


# Errors after which the ports try again themselves, after botocore has given up: documents.py, dns.py, timers.py.
PATIENT = {
    ("s3:PutObject", FaultKind.NOT_NOW),
    ("route53:ChangeResourceRecordSets", FaultKind.NOT_NOW),
    ("route53:ChangeResourceRecordSets", FaultKind.THROTTLED),
    ("scheduler:CreateSchedule", FaultKind.NOT_NOW),
}


def reaches(action: str, kind: FaultKind) -> list[Reach]:
    """Return the reaches that such a fault can have.

    `Reach.ATTEMPT` is left out where botocore does not try again: for a body that breaks off, and for an error that it
    takes as final.
    """
    single = kind is FaultKind.BROKEN or (kind is FaultKind.NOT_NOW and action != "route53:ChangeResourceRecordSets")
    spell = [Reach.SPELL] if (action, kind) in PATIENT else []
    return [*([] if single else [Reach.ATTEMPT]), Reach.CALL, *spell]


def invisible(fault: AwsFault, made: MadeCall) -> bool:
    """Return whether botocore alone should hide the fault from the functions.

    botocore cannot hide the lost reply of a conditional write: S3 answers the second attempt with 412, as if another
    writer had been faster. The outcome must still be right, but a message may come again.
    """
    again = fault.kind is FaultKind.READ and made.action == "s3:PutObject"
    return fault.reach is Reach.ATTEMPT and fault.kind not in (FaultKind.NOT_NOW, FaultKind.BROKEN) and not again


class AwsFaultInjector:
    """Counts the calls of one botocore session, and injects `fault` into the call that it names."""

    def __init__(self) -> None:
        """Make the injector while a `MotoWorld` is open."""
        self.session = botocore.session.get_session()
        self.session.register("before-call", self._before_call)
        self.session.register("after-call", self._after_call)
        self.session.register("after-call-error", self._after_call)
        self.spot = True  # False: ECS has no capacity on Fargate Spot
        self.begin(None)

    def begin(self, fault: AwsFault | None) -> None:
        """Count from 1 again, with this fault."""
        self.fault = fault
        self.calls: list[MadeCall] = []  # the calls so far
        self.struck = 0  # HTTP requests that the fault has changed
        self.waited = 0.0  # seconds of timeouts and pauses since `invocation`
        self._action = ""  # the action of the call under way
        self._attempts = 0
        self._function = self._spell = ""
        self._config: Any = None

    def invocation(self, function: str) -> None:
        """Begin an invocation of this function. A fault of reach `SPELL` is over, and `waited` is 0 again."""
        self._function, self._spell, self.waited = function, "", 0.0

    def wait(self, seconds: float) -> None:
        """Count a pause instead of sleeping."""
        self.waited += seconds

    @contextlib.contextmanager
    def installed(self) -> Iterator[None]:
        """Inject the fault, and count pauses instead of sleeping, within the block."""
        serve, delay = BotocoreStubber.__call__, standard.ExponentialBackoff.delay_amount

        def served(stubber: Any, event_name: str, request: Any, **kwargs: Any) -> Any:
            if self._action == "ecs:RunTask" and not self.spot and "FARGATE_SPOT" in _text(request.body):
                return self._serve(lambda: _response(request, 200, {}, json.dumps(SOLD_OUT)), request)
            return self._serve(partial(serve, stubber, event_name, request, **kwargs), request)

        def at_once(backoff: Any, context: Any) -> float:
            backoff._random = lambda: 1.0
            self.wait(delay(backoff, context))
            return 0.0

        with contextlib.ExitStack() as stack:
            for patch in (
                mock.patch.object(BotocoreStubber, "__call__", served),
                mock.patch.object(standard.ExponentialBackoff, "delay_amount", at_once),
                # Clients outlive hundreds of runs here; in each run a client must have its full quota of retries.
                mock.patch.object(quota.RetryQuota, "acquire", return_value=True),
                mock.patch.object(
                    dns,
                    "retry_while_busy",
                    partial(retry_while_busy, sleep=self.wait, chance=lambda: 1.0, clock=lambda: self.waited),
                ),
                mock.patch.object(documents, "time", SimpleNamespace(sleep=self.wait)),
            ):
                stack.enter_context(patch)
            yield

    def _before_call(self, model: Any, context: dict[str, Any], **_: Any) -> None:
        self._action = f"{model.service_model.service_name}:{model.name}"
        self.calls.append(MadeCall(self._function, self._action))
        self._attempts = 0
        self._protocol = model.service_model.metadata["protocol"]
        self._config = context["client_config"]

    def _after_call(self, **_: Any) -> None:
        self._action = ""

    def _due(self) -> bool:
        """Return whether the fault strikes the present attempt."""
        fault, number = self.fault, len(self.calls)
        if fault is None or not self._action:
            return False
        if self._spell == self._action:
            return True
        if fault.number != number:
            return False
        if fault.reach is Reach.SPELL:
            self._spell = self._action
        return fault.reach is not Reach.ATTEMPT or self._attempts == 1

    def _serve(self, serve: Any, request: Any) -> Any:
        self._attempts += 1
        if not self._due():
            return serve()
        assert self.fault is not None
        self.struck += 1
        match self.fault.kind:
            case FaultKind.THROTTLED:
                return self._answer(request, THROTTLED[self._action.split(":")[0]])
            case FaultKind.INTERNAL:
                return self._answer(request, INTERNAL[self._action.split(":")[0]])
            case FaultKind.NOT_NOW:
                return self._not_now(request)
            case FaultKind.CONNECT:
                self.wait(self._config.connect_timeout)
                raise ConnectTimeoutError(endpoint_url=request.url, error="timed out")
            case FaultKind.CLOSED:
                raise ConnectionClosedError(endpoint_url=request.url)
            case FaultKind.READ:
                serve()
                self.wait(self._config.read_timeout)
                raise ReadTimeoutError(endpoint_url=request.url, error="timed out")
            case FaultKind.BROKEN:
                return _cut(serve())

    def _not_now(self, request: Any) -> Any:
        answer = NOT_NOW[self._action]
        if isinstance(answer, dict):
            return _response(request, 200, {}, json.dumps(answer))
        found = re.search(r"eni-[0-9a-z]+", _text(request.body))
        return self._answer(request, answer._replace(message=answer.message.format(interface=found and found[0])))

    def _answer(self, request: Any, error: Error) -> Any:
        """Return the error in the form of the service's protocol."""
        plain = f"<Code>{error.code}</Code><Message>{error.message}</Message>"
        headers = {"x-amzn-RequestId": "made-up"}
        if self._action.startswith("s3:"):
            body = f"<Error>{plain}</Error>"
        elif self._protocol == "ec2":
            body = f"<Response><Errors><Error>{plain}</Error></Errors><RequestID>made-up</RequestID></Response>"
        elif self._protocol in ("json", "rest-json"):
            headers["x-amzn-ErrorType"] = error.code
            body = json.dumps({"__type": error.code, "message": error.message})
        else:
            kind = "Receiver" if error.status >= 500 else "Sender"
            body = f"<ErrorResponse><Error><Type>{kind}</Type>{plain}</Error><RequestId>made-up</RequestId></ErrorResponse>"
        return _response(request, error.status, headers, body)


def _text(body: Any) -> str:
    return body.decode() if isinstance(body, bytes) else str(body)


def _response(request: Any, status: int, headers: dict[str, str], body: str) -> AWSResponse:
    return AWSResponse(request.url, status, headers, MockRawResponse(body))


def _cut(whole: AWSResponse) -> AWSResponse:
    """Return the answer without the second half of its body."""
    body = whole.raw.read()
    headers = {**whole.headers, "content-length": str(len(body))}
    return AWSResponse(whole.url, whole.status_code, headers, MockRawResponse(body[: len(body) // 2]))
