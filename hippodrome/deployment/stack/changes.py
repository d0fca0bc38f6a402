"""Compares the stack with the built template and its parameters, and makes CloudFormation's change sets."""

from __future__ import annotations

import contextlib
import re
import secrets
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from botocore.exceptions import ClientError

from hippodrome.console.problem import Problem
from hippodrome.control.aws import errors
from hippodrome.deployment.aws import regions
from hippodrome.deployment.aws.account import Account, is_no_stack, parameters_of
from hippodrome.deployment.aws.resource_names import TAG
from hippodrome.deployment.code import build
from hippodrome.deployment.code.packages import Target
from hippodrome.deployment.code.template import Template
from hippodrome.deployment.stack import states
from hippodrome.deployment.stack.code_bucket import CodeBucket
from hippodrome.deployment.stack.settings import StackSettings, option
from hippodrome.deployment.stack.stack import Stack
from hippodrome.deployment.stack.states import StackAction

PREFIX = "hippodrome-"  # begins the names of Hippodrome's change sets
_NO_CHANGES = ("didn't contain changes", "No updates are to be performed")


@dataclass(frozen=True)
class Prepared:
    """The input of `plan` and `apply`: the stack, and the template and parameters that it shall have."""

    account: Account
    stack: Stack
    described: Mapping[str, Any] | None  # the stack, as DescribeStacks returns it; None if there is none
    template: Template
    functions: Sequence[build.Function]
    parameters: Mapping[str, str]
    bucket: CodeBucket

    @property
    def status(self) -> str:
        """The stack's state; empty if there is no stack."""
        return str(self.described["StackStatus"]) if self.described else ""

    @property
    def existing(self) -> Mapping[str, Any] | None:
        """The stack from DescribeStacks; None if there is none, or if it was never complete."""
        makes = states.action_for(self.status) in {StackAction.CREATE, StackAction.RECREATE}
        return None if makes else self.described

    @cached_property
    def before(self) -> dict[str, str]:
        """The present parameters of the stack."""
        return parameters_of(self.existing)

    def changed_parameters(self) -> dict[str, tuple[str, str]]:
        """Return the parameters that will change, by name: the present value and the new one."""
        names = sorted(set(self.before) | set(self.parameters))
        pairs = {name: (self.before.get(name, ""), self.parameters.get(name, "")) for name in names}
        return {name: pair for name, pair in pairs.items() if pair[0] != pair[1]}

    def unchanged(self) -> bool:
        """Whether the stack has this template, code, parameters and tags, so that no change set is needed."""
        if (
            self.existing is None
            or states.action_for(self.status) is not StackAction.UPDATE
            or self.changed_parameters()
        ):
            return False
        tags = {tag["Key"]: tag["Value"] for tag in self.existing.get("Tags", ())}
        return tags.get(TAG) == self.stack.name and _same_text(self.stack.template(), self.template.text)


def _same_text(stored: str, ours: str) -> bool:
    """Whether the text from GetTemplate is this template. GetTemplate returns ? for characters outside of ASCII.

    (aws-cloudformation/cloudformation-coverage-roadmap, issues 814 and 1220.)
    """
    return re.sub(r"[^\x00-\x7f]", "?", stored).strip() == re.sub(r"[^\x00-\x7f]", "?", ours).strip()


def prepare(account: Account, name: str, settings: StackSettings) -> Prepared:
    """Build the functions, read the stack, and determine its parameters. Changes nothing in AWS.

    Raises `Problem` if a setting is missing or refused, the functions cannot be built, or the stack is of others.
    """
    stack, bucket = Stack(account, name), CodeBucket(account, name)
    existing = stack.describe()
    source = Template.read().for_region(account.region)
    parameters = settings.parameters(account, source.defaults, parameters_of(existing), bucket.name, _subnets(existing))
    wrong = [f"{option(name)} {parameters[name]!r} {what}" for name, what in source.refused(parameters)]
    if account.region in regions.WITHOUT_BUDGETS and parameters.get("MonthlyBudget", "0") != "0":
        wrong.append(f"--budget must be 0 in {account.region}: make it in the console, Billing and Cost Management")
    if wrong:
        raise Problem("The installation cannot be made like this.", "Correct the options that are named.", wrong)
    functions = build.functions(Target.from_env())
    template = source.with_code(functions)
    used = [function for function in functions if function.name in source.functions]
    return Prepared(account, stack, existing, template, used, parameters, bucket)


def _subnets(stack: Mapping[str, Any] | None) -> list[str]:
    """Return the ids in the output `Subnets` of a described stack; empty if it has none."""
    outputs = {output["OutputKey"]: output["OutputValue"] for output in (stack or {}).get("Outputs", ())}
    return [name for name in outputs.get("Subnets", "").split(",") if name]


@dataclass
class ChangeSet:
    """A change set at CloudFormation."""

    arn: str
    stack_id: str
    changes: list[dict[str, Any]] = field(default_factory=list)  # empty: there is nothing to do
    warnings: list[str] = field(default_factory=list)  # reasons why it may fail, such as a quota that is used up


@contextlib.contextmanager
def change_set(prepared: Prepared, keep: bool) -> Iterator[ChangeSet]:
    """Upload the template and make a change set. Delete it after the block, with the empty stack of a first one.

    With `keep`, for a block that executes the change set, it stays if it has changes and the block raises nothing.
    Raises `Problem` if CloudFormation refuses the change set.
    """
    client = prepared.account.client("cloudformation")
    url = prepared.bucket.put_template(prepared.template.text)
    try:
        answer = client.create_change_set(
            StackName=prepared.stack.name,
            ChangeSetName=f"{PREFIX}{int(time.time())}-{secrets.token_hex(3)}",
            ChangeSetType="UPDATE" if prepared.existing else "CREATE",
            TemplateURL=url,
            Parameters=[{"ParameterKey": key, "ParameterValue": value} for key, value in prepared.parameters.items()],
            Capabilities=["CAPABILITY_NAMED_IAM"],
            Tags=[{"Key": TAG, "Value": prepared.stack.name}],
        )
    except ClientError as error:
        if errors.code(error) == "ValidationError":
            raise Problem(
                f"CloudFormation does not accept this: {errors.message(error)}",
                "Nothing was changed. Put that right, and run the same command again.",
            ) from None
        raise
    changes = ChangeSet(answer["Id"], answer["StackId"])
    is_kept = False
    try:
        changes.changes = _wait(client, changes)
        changes.warnings = _findings(client, changes, "WARN")
        yield changes
        is_kept = keep and bool(changes.changes)
    finally:
        if not is_kept:
            _discard(client, changes, prepared)


def _wait(client: Any, change_set: ChangeSet) -> list[dict[str, Any]]:
    pause = 0.2
    while True:
        answer = client.describe_change_set(ChangeSetName=change_set.arn, StackName=change_set.stack_id)
        if answer["Status"] == "CREATE_COMPLETE":
            break
        if answer["Status"] in {"FAILED", "DELETE_COMPLETE"}:
            reason = str(answer.get("StatusReason", "")).strip()
            if any(text in reason for text in _NO_CHANGES):
                return []
            raise Problem(
                f"CloudFormation cannot make a plan of this: {reason or answer['Status']}",
                details=_findings(client, change_set, "FAIL"),
            )
        time.sleep(pause)
        pause = min(3.0, pause * 1.5)
    changes = list(answer.get("Changes", ()))
    while answer.get("NextToken"):
        answer = client.describe_change_set(
            ChangeSetName=change_set.arn, StackName=change_set.stack_id, NextToken=answer["NextToken"]
        )
        changes += answer.get("Changes", ())
    return changes


def _findings(client: Any, change_set: ChangeSet, mode: str) -> list[str]:
    """Read the first five findings of CloudFormation's validation of a change set; empty if they cannot be read.

    `mode` is FAIL for findings that made the change set fail, WARN for other ones, such as a quota that is used up
    (CloudFormation User Guide, "Validate stack deployments"; API Reference, OperationEvent).
    """
    sentences: list[str] = []
    with contextlib.suppress(ClientError):
        for page in client.get_paginator("describe_events").paginate(ChangeSetName=change_set.arn):
            sentences += [
                f"{event.get('LogicalResourceId', '')}: {event.get('ValidationStatusReason', '')}"
                for event in page["OperationEvents"]
                if event.get("EventType") == "VALIDATION_ERROR"
                and event.get("ValidationFailureMode", "FAIL") == mode
                and event.get("ValidationStatus", "FAILED") == "FAILED"  # and not SKIPPED
            ]
    return sentences[:5]


def delete_old_change_sets(prepared: Prepared) -> None:
    """Delete change sets that an interrupted run left behind."""
    if not prepared.described:
        return
    client = prepared.account.client("cloudformation")
    try:
        pages = client.get_paginator("list_change_sets").paginate(StackName=prepared.stack.name)
        for summary in [summary for page in pages for summary in page["Summaries"]]:
            ours = summary["ChangeSetName"].startswith(PREFIX)
            if ours and summary.get("ExecutionStatus") != "EXECUTE_IN_PROGRESS":
                client.delete_change_set(ChangeSetName=summary["ChangeSetId"], StackName=prepared.stack.name)
    except ClientError as error:
        if not is_no_stack(error):
            raise


def _discard(client: Any, change_set: ChangeSet, prepared: Prepared) -> None:
    """Delete the change set, and the empty stack that comes with a first one."""
    with contextlib.suppress(ClientError):
        client.delete_change_set(ChangeSetName=change_set.arn, StackName=change_set.stack_id)
    if prepared.existing is None:
        with contextlib.suppress(ClientError):
            stack = client.describe_stacks(StackName=change_set.stack_id)["Stacks"][0]
            if stack["StackStatus"] == "REVIEW_IN_PROGRESS":
                client.delete_stack(StackName=change_set.stack_id)
