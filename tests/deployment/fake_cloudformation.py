"""A fake CloudFormation that follows a script: stacks, change sets and events in the shapes of the real answers.

moto's CloudFormation says CREATE_COMPLETE of whatever it skips and never fails by itself. This fake does what
it is told: `operations` says what follows from the next execute, delete or continue. It is a list of steps, of which
each look at the stack takes one.

Instead of a script, `making` and `deleting` may say of each resource what its service says to CloudFormation: "" if it
did as it was told. So a world can refuse as AWS does (`tests/deployment/real_stack.py`).

The fake refuses change sets and rollbacks in the states in which CloudFormation refuses them.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from typing import Any

from botocore.exceptions import ClientError

Event = tuple[str, str, str, str]  # logical id, type, status, reason
Step = tuple[str, list[Event]]  # the stack's status, and the events of this step
DELETABLE = {"CREATE_IN_PROGRESS", "DELETE_IN_PROGRESS", "REVIEW_IN_PROGRESS"}  # statuses of an operation in progress

UPDATABLE = {  # by a change set
    "CREATE_COMPLETE",
    "UPDATE_COMPLETE",
    "UPDATE_ROLLBACK_COMPLETE",
    "IMPORT_COMPLETE",
    "IMPORT_ROLLBACK_COMPLETE",
}

NOTHING = "The submitted information didn't contain changes. Submit different information to create a change set."
INVALID = (
    "The following hook(s)/validation failed: [AWS::EarlyValidation::ResourceExistenceCheck]. To troubleshoot Early "
    "Validation errors, use the DescribeEvents API for detailed failure information."
)


def refusal(operation: str, code: str, message: str) -> ClientError:
    return ClientError({"Error": {"Code": code, "Message": message}, "ResponseMetadata": {}}, operation)


class FakeCloudFormation:
    def __init__(self, region: str = "ca-central-1", account: str = "123456789012") -> None:
        self.prefix = f"arn:aws:cloudformation:{region}:{account}"
        self.stack: dict[str, Any] | None = None
        self.text = ""
        self.events: list[dict[str, Any]] = []
        self.resources: list[dict[str, Any]] = []
        self.changes: list[dict[str, Any]] | None = None  # of the next change set; None: what the template adds
        self.change_set: dict[str, Any] | None = None
        # Change sets of ours that were neither executed nor deleted: names by ids.
        self.change_sets: dict[str, str] = {}
        self.failing = ""  # the reason for which the next change set fails
        self.validation: Callable[[], list[dict[str, str]]] = (
            list  # the findings of validation when a change set is made
        )
        self.found: list[dict[str, str]] = []  # the findings on the last change set
        self.operations: list[list[Step]] = []
        self.making: Callable[[dict[str, Any]], str] | None = None
        self.deleting: Callable[[dict[str, Any]], str] | None = None
        self.clock: Callable[[], datetime] | None = None  # without it, a second passes with each event
        self.past: list[tuple[dict[str, Any], list[dict[str, Any]], list[dict[str, Any]]]] = []
        self.script: list[Step | Callable[[], Step]] = []
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.outputs: dict[str, str] = {}
        self.interrupt_after = 10**9  # the number of looks at the stack before Ctrl-C
        self.others: list[dict[str, Any]] = []
        self._ids = itertools.count(1)
        self._now = datetime(2026, 11, 1, tzinfo=UTC)
        self.templates: dict[str, str] = {}

    # -- setting its state

    def stand(self, status: str, parameters: dict[str, str], text: str = "", name: str = "hippodrome") -> None:
        self.stack = {
            "StackName": name,
            "StackId": f"{self.prefix}:stack/{name}/{next(self._ids)}",
            "StackStatus": status,
            "Parameters": [{"ParameterKey": k, "ParameterValue": v} for k, v in parameters.items()],
            "Tags": [{"Key": "hippodrome:stack", "Value": name}],
            "Outputs": [{"OutputKey": k, "OutputValue": v} for k, v in self.outputs.items()],
        }
        self.text = text
        self._event(name, "AWS::CloudFormation::Stack", "CREATE_IN_PROGRESS", "User Initiated")
        self._event(name, "AWS::CloudFormation::Stack", "CREATE_COMPLETE", "")

    def called(self, operation: str) -> list[dict[str, Any]]:
        return [arguments for name, arguments in self.calls if name == operation]

    # -- the operations

    def get_paginator(self, operation: str) -> Any:
        fake = self

        class Pages:
            def paginate(self, **arguments: Any) -> Iterator[Any]:
                yield getattr(fake, operation)(**arguments)

        return Pages()

    def describe_stacks(self, StackName: str = "") -> Any:
        if not StackName:
            return {"Stacks": [*([self.stack] if self.stack else []), *self.others]}
        self.interrupt_after -= 1
        if self.interrupt_after == 0:
            raise KeyboardInterrupt
        for stack, _, _ in self.past:
            if stack["StackId"] == StackName:
                return {"Stacks": [dict(stack)]}
        self._advance()
        if self.stack is None or StackName not in {self.stack["StackName"], self.stack["StackId"]}:
            raise refusal("DescribeStacks", "ValidationError", f"Stack with id {StackName} does not exist")
        if self.stack["StackStatus"] == "DELETE_COMPLETE" and StackName == self.stack["StackName"]:
            raise refusal("DescribeStacks", "ValidationError", f"Stack with id {StackName} does not exist")
        return {"Stacks": [dict(self.stack)]}

    def describe_stack_events(self, StackName: str) -> Any:
        for stack, events, _ in self.past:
            if stack["StackId"] == StackName:
                return {"StackEvents": list(reversed(events))}
        return {"StackEvents": list(reversed(self.events))}

    def list_stack_resources(self, StackName: str) -> Any:
        for stack, _, resources in self.past:
            if stack["StackId"] == StackName:
                return {"StackResourceSummaries": list(resources)}
        return {"StackResourceSummaries": list(self.resources)}

    def list_stacks(self) -> Any:
        found = [*([self.stack] if self.stack else []), *(stack for stack, _, _ in self.past)]
        return {"StackSummaries": [dict(one) for one in found]}

    def get_template(self, StackName: str, TemplateStage: str = "Original") -> Any:
        self.calls.append(("get_template", {}))
        return {"TemplateBody": self.text}

    def create_change_set(self, **arguments: Any) -> Any:
        self.calls.append(("create_change_set", arguments))
        name = arguments["StackName"]
        if arguments["ChangeSetType"] == "CREATE":
            if self.stack and self.stack["StackStatus"] not in {"DELETE_COMPLETE", "REVIEW_IN_PROGRESS"}:
                raise refusal("CreateChangeSet", "ValidationError", f"Stack [{name}] already exists")
            if self.stack and self.stack["StackStatus"] == "DELETE_COMPLETE":
                self.past.insert(0, (self.stack, list(self.events), list(self.resources)))
            self.stack = {
                "StackName": name,
                "StackId": f"{self.prefix}:stack/{name}/{next(self._ids)}",
                "StackStatus": "REVIEW_IN_PROGRESS",
                "Outputs": [],
            }
            self.events.clear()
            self._event(name, "AWS::CloudFormation::Stack", "REVIEW_IN_PROGRESS", "User Initiated")
        assert self.stack
        self._only_in(UPDATABLE | {"REVIEW_IN_PROGRESS"}, "CreateChangeSet", "be updated")
        self.change_set = {
            "ChangeSetId": f"{self.prefix}:changeSet/{arguments['ChangeSetName']}/{next(self._ids)}",
            "Parameters": arguments["Parameters"],
            "Tags": arguments["Tags"],
            "Url": arguments["TemplateURL"],
        }
        self.change_sets[self.change_set["ChangeSetId"]] = arguments["ChangeSetName"]
        self.found = self.validation()
        return {"Id": self.change_set["ChangeSetId"], "StackId": self.stack["StackId"]}

    def describe_change_set(self, ChangeSetName: str, StackName: str, NextToken: str = "") -> Any:
        if self.failing:
            return {"Status": "FAILED", "StatusReason": self.failing}
        if any(one["ValidationFailureMode"] == "FAIL" for one in self.found):
            return {"Status": "FAILED", "StatusReason": INVALID}
        added = [added_resource("Bucket", "AWS::S3::Bucket"), added_resource("Sweep", "AWS::Lambda::Function")]
        changes = added if self.changes is None else self.changes
        if not NextToken and len(changes) > 1:
            return {"Status": "CREATE_COMPLETE", "Changes": changes[:1], "NextToken": "more"}
        return {"Status": "CREATE_COMPLETE", "Changes": changes[1:] if NextToken else changes}

    def describe_events(self, ChangeSetName: str) -> Any:
        return {"OperationEvents": self.found}

    def execute_change_set(self, **arguments: Any) -> Any:
        self.calls.append(("execute_change_set", arguments))
        assert self.stack
        self._only_in(UPDATABLE | {"REVIEW_IN_PROGRESS"}, "ExecuteChangeSet", "be executed")
        assert self.change_set
        self.change_sets.pop(arguments["ChangeSetName"])
        updating = self.stack["StackStatus"] != "REVIEW_IN_PROGRESS"
        kind = "UPDATE" if updating else "CREATE"
        self.script = [*self.operations.pop(0)] if self.operations else [*happy(kind)]
        if self.making and not updating:
            self.script = [("CREATE_IN_PROGRESS", []), self._making]
        self.stack |= {
            "Parameters": self.change_set["Parameters"],
            "Tags": self.change_set["Tags"],
            "Outputs": [{"OutputKey": k, "OutputValue": v} for k, v in self.outputs.items()],
        }
        return {}

    def delete_change_set(self, **arguments: Any) -> Any:
        self.calls.append(("delete_change_set", arguments))
        self.change_sets.pop(arguments["ChangeSetName"], None)
        return {}

    def list_change_sets(self, StackName: str) -> Any:
        old = {"ChangeSetName": "hippodrome-1-old", "ChangeSetId": "old", "ExecutionStatus": "AVAILABLE"}
        ours = [{"ChangeSetName": name, "ChangeSetId": arn} for arn, name in self.change_sets.items()]
        return {"Summaries": [old, {"ChangeSetName": "somebody-elses", "ChangeSetId": "theirs"}, *ours]}

    def delete_stack(self, **arguments: Any) -> Any:
        self.calls.append(("delete_stack", arguments))
        status = self.stack["StackStatus"] if self.stack else ""
        if status.endswith("_IN_PROGRESS") and status not in DELETABLE:
            what = f"Stack [{arguments['StackName']}] cannot be deleted while in status {status}"
            raise refusal("DeleteStack", "ValidationError", what)
        if self.stack and self.stack.get("EnableTerminationProtection"):
            what = f"Stack [{arguments['StackName']}] cannot be deleted while TerminationProtection is enabled"
            raise refusal("DeleteStack", "ValidationError", what)
        if arguments.get("RetainResources") and status != "DELETE_FAILED":
            what = (
                f"Invalid operation on stack [{arguments['StackName']}]: resources may be retained after DELETE_FAILED"
            )
            raise refusal("DeleteStack", "ValidationError", what)
        for one in self.resources:
            if one["LogicalResourceId"] in arguments.get("RetainResources", ()):
                one["ResourceStatus"] = "DELETE_SKIPPED"
        if self.stack and self.stack["StackStatus"] == "REVIEW_IN_PROGRESS":
            self.stack = None
        elif self.deleting and not self.operations:
            self.script = [("DELETE_IN_PROGRESS", []), self._deleting]
        else:
            self.script = [*self.operations.pop(0)] if self.operations else [*happy("DELETE")]
        return {}

    def continue_update_rollback(self, **arguments: Any) -> Any:
        self.calls.append(("continue_update_rollback", arguments))
        self._only_in({"UPDATE_ROLLBACK_FAILED"}, "ContinueUpdateRollback", "be rolled back")
        self.script = [*self.operations.pop(0)]
        return {}

    def rollback_stack(self, **arguments: Any) -> Any:
        self.calls.append(("rollback_stack", arguments))
        self._only_in({"CREATE_FAILED", "UPDATE_FAILED"}, "RollbackStack", "be rolled back")
        self.script = [*self.operations.pop(0)]
        return {}

    # -- inside

    def _only_in(self, states: set[str], operation: str, what: str) -> None:
        status = self.stack["StackStatus"] if self.stack else ""
        if status not in states:
            raise refusal(operation, "ValidationError", f"Stack is in {status} state and can not {what}.")

    def _advance(self) -> None:
        if self.stack is None or not self.script:
            return
        step = self.script.pop(0)
        status, events = step() if callable(step) else step
        before = self.stack["StackStatus"]
        self.stack["StackStatus"] = status
        if status == "DELETE_COMPLETE" and self.clock:
            self.stack["DeletionTime"] = self.clock()
        if status != before:
            self._event(self.stack["StackName"], "AWS::CloudFormation::Stack", status, "")
        for logical, kind, state, reason in events:
            self._event(logical, kind, state, reason)

    def _making(self) -> Step:
        """Return the steps of a creation: everything is made or, once something is refused, rolled back."""
        assert self.making
        events: list[Event] = []
        for one in self.resources:
            name, kind = one["LogicalResourceId"], one["ResourceType"]
            if reason := self.making(one):
                events.append((name, kind, "CREATE_FAILED", reason))
                return "ROLLBACK_COMPLETE", events
            one["ResourceStatus"] = "CREATE_COMPLETE"
            events.append((name, kind, "CREATE_COMPLETE", ""))
        return "CREATE_COMPLETE", events

    def _deleting(self) -> Step:
        """Return the steps of a deletion: what can be deleted is deleted, in the reverse order of its creation."""
        assert self.deleting
        events: list[Event] = []
        for one in reversed(self.resources):
            if one.get("ResourceStatus") in {"DELETE_COMPLETE", "DELETE_SKIPPED"}:
                continue
            reason = self.deleting(one)
            skipped = one["ResourceType"] == "AWS::S3::Bucket"
            one["ResourceStatus"] = "DELETE_FAILED" if reason else "DELETE_SKIPPED" if skipped else "DELETE_COMPLETE"
            events.append((one["LogicalResourceId"], one["ResourceType"], one["ResourceStatus"], reason))
        failed = any(state == "DELETE_FAILED" for _, _, state, _ in events)
        return "DELETE_FAILED" if failed else "DELETE_COMPLETE", events

    def _event(self, logical: str, kind: str, status: str, reason: str) -> None:
        assert self.stack
        self._now = self.clock() if self.clock else self._now + timedelta(seconds=1)
        own = kind == "AWS::CloudFormation::Stack"
        ids = {one["LogicalResourceId"]: one["PhysicalResourceId"] for one in self.resources}
        physical = ids.get(logical, f"physical-{logical}")
        self.events.append(
            {
                "EventId": str(next(self._ids)),
                "StackId": self.stack["StackId"],
                "LogicalResourceId": logical,
                "PhysicalResourceId": self.stack["StackId"] if own else physical,
                "ResourceType": kind,
                "ResourceStatus": status,
                "ResourceStatusReason": reason,
                "Timestamp": self._now,
            }
        )


def happy(kind: str) -> list[Step]:
    bucket = ("Bucket", "AWS::S3::Bucket")
    return [
        (f"{kind}_IN_PROGRESS", [(*bucket, f"{kind}_IN_PROGRESS", "")]),
        (f"{kind}_IN_PROGRESS", [(*bucket, f"{kind}_COMPLETE", "")]),
        (f"{kind}_COMPLETE", []),
    ]


def invalid(name: str, reason: str, mode: str = "FAIL", status: str = "FAILED") -> dict[str, str]:
    """Return a finding of validation before deployment on a resource (API Reference, OperationEvent)."""
    return {
        "EventType": "VALIDATION_ERROR",
        "LogicalResourceId": name,
        "ValidationFailureMode": mode,
        "ValidationStatus": status,
        "ValidationStatusReason": reason,
    }


def added_resource(name: str, kind: str) -> dict[str, Any]:
    return {"Type": "Resource", "ResourceChange": {"Action": "Add", "LogicalResourceId": name, "ResourceType": kind}}


def changed_resource(name: str, kind: str, *properties: str, **more: Any) -> dict[str, Any]:
    details = [{"Target": {"Attribute": "Properties", "Name": one}} for one in properties]
    change = {
        "Action": "Modify",
        "LogicalResourceId": name,
        "PhysicalResourceId": f"physical-{name}",
        "ResourceType": kind,
        "Replacement": "False",
        "Details": details,
    }
    return {"Type": "Resource", "ResourceChange": change | more}
