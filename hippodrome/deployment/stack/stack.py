"""A stack at CloudFormation: its state, its operations and their progress, and why an operation failed."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from botocore.exceptions import ClientError
from rich.progress import Progress, TextColumn

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws.account import Account, describe_stack, is_no_stack
from hippodrome.deployment.core.explain import NOT_ACTIVE
from hippodrome.deployment.stack import states
from hippodrome.deployment.stack.states import StackAction

FIRST_PAUSE = 0.3  # seconds between the first two looks
PAUSE = 3.0  # seconds between two looks, later
LONG_FOR_A_CERTIFICATE = 300.0  # seconds; ACM validates a delegated domain in a few minutes

_BEGINS = {"CREATE_IN_PROGRESS", "UPDATE_IN_PROGRESS", "DELETE_IN_PROGRESS"}
_STACK_TYPE = "AWS::CloudFormation::Stack"
_BUSY = re.compile(r"cannot be deleted while in status|is in \w+_IN_PROGRESS state", re.IGNORECASE)
_CONSEQUENCE = re.compile(r"(creation|update|operation|deletion) cancell?ed", re.IGNORECASE)
_ROLE_IS_NEW = (
    r"Unable to assume the service linked role|cannot be assumed by Lambda|"
    r"execution role does not have permissions to call"
)
"""The services' error messages while IAM does not know a new role or its policy everywhere: of CreateCluster
(1Password/scim-examples, issue 356), CreateFunction (pulumi/pulumi-aws-native 148), and CreateEventSourceMapping
(milliHQ/terraform-aws-next-js 138)."""


@dataclass(frozen=True)
class FailedResource:
    """A resource that failed, and why."""

    logical_id: str
    type: str
    physical_id: str
    reason: str


class NotDeleted(Problem):
    """A stack could not be deleted; `failures` are the resources that could not."""

    def __init__(self, problem: Problem, failures: Sequence[FailedResource]) -> None:
        super().__init__(str(problem), problem.advice, problem.details, problem.exit_code)
        self.failures = tuple(failures)


@dataclass
class Operation:
    """An operation on a stack: the states of resources by logical id, and the failures in the order of time."""

    states: dict[str, str] = field(default_factory=dict)
    failures: list[FailedResource] = field(default_factory=list)

    @property
    def done(self) -> int:
        """The number of resources that the operation has finished."""
        return sum(state.endswith(("_COMPLETE", "_SKIPPED")) for state in self.states.values())

    @property
    def under_way(self) -> list[str]:
        """The logical ids of the resources that are being changed."""
        return [name for name, state in self.states.items() if state.endswith("_IN_PROGRESS")]


class Stack:
    """The stack of one name. Methods that wait show progress on stderr."""

    def __init__(self, account: Account, name: str, sleep: Callable[[float], None] = time.sleep) -> None:
        self.name = name
        self._client = account.client("cloudformation")
        self._account = account
        self._sleep = sleep

    def describe(self) -> Mapping[str, Any] | None:
        """Describe the stack, as CloudFormation does; None if there is none.

        Raises `Problem` if the stack of that name is not an installation of Hippodrome.
        """
        return describe_stack(self._account, self.name)

    @property
    def status(self) -> str:
        """The stack's state; "" if there is none."""
        stack = self.describe()
        return str(stack["StackStatus"]) if stack else ""

    def template(self) -> str:
        """Return the text of the stack's template; "" if it is JSON, so not Hippodrome's."""
        template_body = self._client.get_template(StackName=self.name, TemplateStage="Original")["TemplateBody"]
        return template_body if isinstance(template_body, str) else ""

    def resources(self, stack_id: str = "") -> list[dict[str, Any]]:
        """Return the stack's resources: LogicalResourceId, PhysicalResourceId, ResourceType, ResourceStatus."""
        pages = self._client.get_paginator("list_stack_resources").paginate(StackName=stack_id or self.name)
        return [dict(resource) for page in pages for resource in page["StackResourceSummaries"]]

    def ids_of(self, kind: str) -> list[str]:
        """Return the physical ids of the stack's existing resources of a type; empty if there is no stack."""
        try:
            resources = self.resources()
        except ClientError as error:
            if is_no_stack(error):
                return []
            raise
        return [
            str(resource["PhysicalResourceId"])
            for resource in resources
            if resource["ResourceType"] == kind
            and resource.get("PhysicalResourceId")
            and resource.get("ResourceStatus") not in {"DELETE_COMPLETE", "DELETE_SKIPPED"}
        ]

    def last_event(self, stack_id: str) -> str:
        """Return the id of the stack's newest event, by which `follow` recognises later ones; "" if there is none."""
        events = self._client.describe_stack_events(StackName=stack_id)["StackEvents"]
        return str(events[0]["EventId"]) if events else ""

    # -- waiting ------------------------------------------------------------------------------------------------------

    def follow(self, title: str, stack_id: str, total: int = 0, after: str | None = None) -> str:
        """Show the present operation until it ends, and return the stack's state then.

        `after` is the last event before the operation. Raises `Problem` on Ctrl-C: CloudFormation goes on, and the same
        command follows the operation again.
        """
        try:
            with screen.ProgressBars(TextColumn("{task.fields[now]}", markup=False), width=24) as bar:
                return self._follow(bar, bar.add_task(title, total=total or None, now=""), stack_id, after)
        except KeyboardInterrupt:
            raise Problem(
                f"Interrupted. CloudFormation goes on with the stack {self.name}.",
                "The same command shows how it goes on, and then goes on itself.",
                exit_code=Exit.INTERRUPTED,
            ) from None

    def _follow(self, bar: Progress, task: Any, stack_id: str, after: str | None) -> str:
        pause, began, failed, waited = FIRST_PAUSE, time.monotonic(), False, False
        while True:
            status = str((describe_stack(self._account, stack_id) or {"StackStatus": "DELETE_COMPLETE"})["StackStatus"])
            operation = self.operation(stack_id)
            started = after is None or self._started(stack_id, after) or status == "DELETE_COMPLETE"
            now = ", ".join(operation.under_way[:3]) + (" …" if len(operation.under_way) > 3 else "")
            if operation.failures:  # CloudFormation rolls back: how much there is to do is not known
                bar.update(task, total=None)
            bar.update(task, completed=operation.done, now=now)
            if operation.failures and not failed:
                failed = True
                screen.warning(f"{operation.failures[0].logical_id} failed: {operation.failures[0].reason}")
            if (
                not waited
                and time.monotonic() - began > LONG_FOR_A_CERTIFICATE
                and any("ertificate" in name for name in operation.under_way)
            ):
                waited = True
                screen.warning(
                    "The certificate is waiting for DNS: it comes only if the domain is delegated to the zone."
                )
            if started and not status.endswith("_IN_PROGRESS"):
                if status in {*states.COMPLETE, "DELETE_COMPLETE"}:
                    bar.update(task, total=operation.done, now="")
                return status
            self._sleep(pause)
            pause = min(PAUSE, pause * 1.5)

    def operation(self, stack_id: str) -> Operation:
        """Read the latest operation on the stack from its events."""
        operation = Operation()
        for event in reversed([*self._events(stack_id)]):
            if self._is_own(event):
                continue
            name, status = event["LogicalResourceId"], event["ResourceStatus"]
            operation.states[name] = status
            reason = str(event.get("ResourceStatusReason", ""))
            if status.endswith("_FAILED") and not _CONSEQUENCE.search(reason):
                physical = str(event.get("PhysicalResourceId", ""))
                operation.failures.append(FailedResource(name, event["ResourceType"], physical, reason))
        return operation

    def _events(self, stack_id: str) -> Iterator[Mapping[str, Any]]:
        """Yield the events of the latest operation, newest first."""
        try:
            for page in self._client.get_paginator("describe_stack_events").paginate(StackName=stack_id):
                for event in page["StackEvents"]:
                    yield event
                    if self._is_own(event) and event["ResourceStatus"] in _BEGINS:
                        return
        except ClientError as error:
            if not is_no_stack(error):
                raise

    def _is_own(self, event: Mapping[str, Any]) -> bool:
        """Whether the event is about the stack itself, not about a resource."""
        return bool(event["ResourceType"] == _STACK_TYPE and event["LogicalResourceId"] == self.name)

    def _started(self, stack_id: str, after: str) -> bool:
        """Whether an operation has begun since the event `after`."""
        for page in self._client.get_paginator("describe_stack_events").paginate(StackName=stack_id):
            for event in page["StackEvents"]:
                if event["EventId"] == after:
                    return False
                if self._is_own(event) and event["ResourceStatus"].endswith("_IN_PROGRESS"):
                    return True
        return True

    # -- operations without a change set ------------------------------------------------------------------------------

    def attach(self) -> None:
        """If an operation on the stack is under way, show it until it ends."""
        stack = self.describe()
        if stack and states.action_for(str(stack["StackStatus"])) is StackAction.WAIT:
            screen.info(f"The stack {self.name} is in {stack['StackStatus']}: waiting for that first.")
            self.follow("Waiting for CloudFormation", stack["StackId"])

    def settle(self) -> None:
        """Wait for the present operation, and roll back a failed update, so that the stack can be changed.

        Raises `Problem` if only the administrator can decide what to do.
        """
        self.attach()
        stack = self.describe()
        status = str(stack["StackStatus"]) if stack else ""
        action = states.action_for(status)
        if action is StackAction.STOP:
            raise states.problem(self.name, status)
        if stack is None or action not in {StackAction.ROLL_BACK, StackAction.CONTINUE}:
            return
        if action is StackAction.ROLL_BACK:
            screen.info(f"An update of {self.name} failed and was left as it is ({status}): back to before.")
            begin = self._client.rollback_stack
        else:
            screen.info(f"An earlier update of {self.name} could not be taken back: CloudFormation tries again.")
            begin = self._client.continue_update_rollback
        after = self.last_event(stack["StackId"])
        begin(StackName=self.name)
        status = self.follow("Taking back the update", stack["StackId"], after=after)
        if states.action_for(status) is not StackAction.UPDATE:
            raise self.problem("The update could not be taken back", stack["StackId"], status)

    def delete(self, title: str = "Deleting the stack", without: Sequence[str] = ()) -> None:
        """Delete the stack and wait. Raises `NotDeleted` if that fails, `Problem` if the stack is protected.

        `without`: logical ids of resources that could not be deleted before, and are now left in AWS.
        """
        stack = self.describe()
        if not stack:
            return
        self.must_not_be_protected(stack)
        stack_id, total = stack["StackId"], len(self.resources())
        after = self.last_event(stack_id)
        try:
            if without and stack["StackStatus"] == "DELETE_FAILED":  # RetainResources is allowed in no other state
                self._client.delete_stack(StackName=self.name, RetainResources=[*without])
            else:
                self._client.delete_stack(StackName=self.name)
        except ClientError as error:
            if not _BUSY.search(errors.message(error)):
                raise
            self.attach()  # another operation began in between; after it, the stack can be deleted
            after = self.last_event(stack_id)
            self._client.delete_stack(StackName=self.name)
        status = self.follow(title, stack_id, total, after)
        if status != "DELETE_COMPLETE":
            problem = self.problem(f"The stack {self.name} could not be deleted", stack_id, status)
            raise NotDeleted(problem, self.operation(stack_id).failures)

    def must_not_be_protected(self, stack: Mapping[str, Any]) -> None:
        """Raise `Problem` if the stack's termination protection is on."""
        if stack.get("EnableTerminationProtection"):
            raise Problem(
                f"The stack {self.name} is protected against deletion (termination protection).",
                "If it may go, take that away: aws cloudformation update-termination-protection "
                f"--no-enable-termination-protection --stack-name {self.name} --region {self._account.region}",
            )

    def problem(self, summary: str, stack_id: str, status: str) -> Problem:
        """Explain the latest operation's failure: its first three failed resources with reasons, the others by name."""
        failures = self.operation(stack_id).failures
        details: list[str] = []
        for failure in failures[:3]:
            physical = f", {failure.physical_id}" if failure.physical_id else ""
            details += [f"{failure.logical_id} ({failure.type}{physical}):", f"  {failure.reason}"]
        if len(failures) > 3:
            details.append(f"and {len(failures) - 3} more: {', '.join(failure.logical_id for failure in failures[3:])}")
        if not failures:
            reason = (describe_stack(self._account, stack_id) or {}).get("StackStatusReason", "")
            details = [str(reason)] if reason else []
        return Problem(f"{summary} (now {status}).", advice(failures, details), details)


_ADVICE = (  # a pattern for the reason of a failure, and the advice; the first that fits counts
    (r"needs a subscription|not subscribed|not signed up|OptInRequired|SubscriptionRequired", " ".join(NOT_ACTIVE)),
    (r"maximum number of VPCs|VpcLimitExceeded", "Use a VPC that is there: --vpc vpc-… --subnets subnet-…,subnet-…"),
    (
        r"UnreservedConcurrentExecution",
        "The account's Lambda concurrency is too small (new accounts have 10): ask for 1,000 in Service Quotas, then "
        "run the same command again.",
    ),
    (
        r"QueueDeletedRecently|wait 60 seconds after deleting a queue",
        "Run the same command again in a minute: AWS keeps the names of deleted queues for so long.",
    ),
    (
        rf"service.linked role|{_ROLE_IS_NEW}",
        "AWS does not know that role everywhere yet; run the same command again in a minute.",
    ),
    (
        r"is delegated|PENDING_VALIDATION|certificate.*(timed? ?out|validat)|CAA",
        "Delegate the domain to its hosted zone, and run the same command again.",
    ),
    (
        r"domain name.*already exists|already exists.*domain name|Tried to create resource record set",
        "Something else already answers at that address: remove it, or take another name with --site.",
    ),
    (r"not authorized|Access ?Denied|no identity-based policy", "Ask for that permission, and run it again."),
    (
        r"quota|limit exceeded|LimitExceeded|TooMany|maximum (number|limit)",
        "Ask for more in the Service Quotas console, or remove what is not needed, and run it again.",
    ),
    (r"ConflictException|concurrent (update|operation)", "Run the same command again: two parts were made at once."),
    (r"already exists", "Something of that name was left over or is not ours: remove it, or use another --stack."),
    (r"has dependencies|DependencyViolation|is in use|not empty", "Something still uses it: remove that first."),
    (
        r"Rate exceeded|Throttl|Internal ?Failure|ServiceUnavailable|timed? ?out|concurrent modification",
        "Run the same command again.",
    ),
)


def role_is_new(problem: Problem) -> bool:
    """Whether a resource failed because a role or its policy is so new that AWS does not know it everywhere."""
    return any(re.search(_ROLE_IS_NEW, line, re.IGNORECASE) for line in problem.details)


def advice(failures: Sequence[FailedResource], details: Sequence[str] = ()) -> str:
    """Advise on the first failure, or on the `details` if no resource failed."""
    reason = failures[0].reason if failures else " ".join(details)
    for pattern, text in _ADVICE:
        if re.search(pattern, reason, re.IGNORECASE):
            return text
    return "Put that right, and run the same command again; nothing has to be cleaned up before."
