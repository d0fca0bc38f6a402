"""Rules for the functions, and for what calls them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from typing import Any

from testing.template import listed
from tests.infra.rules.book import Rule, Template, each, first, number, one_of, put, setting, text
from tests.infra.situations import Installation, Resource

FUNCTION, MAPPING, PERMISSION, INVOKE = (
    f"AWS::Lambda::{kind}" for kind in ("Function", "EventSourceMapping", "Permission", "EventInvokeConfig")
)
CREATE = "Lambda API Reference, CreateFunction"
RESERVED = {
    *("_HANDLER", "_X_AMZN_TRACE_ID", "AWS_DEFAULT_REGION", "AWS_REGION", "AWS_EXECUTION_ENV"),
    *("AWS_LAMBDA_FUNCTION_NAME", "AWS_LAMBDA_FUNCTION_MEMORY_SIZE", "AWS_LAMBDA_FUNCTION_VERSION"),
    *("AWS_LAMBDA_INITIALIZATION_TYPE", "AWS_LAMBDA_LOG_GROUP_NAME", "AWS_LAMBDA_LOG_STREAM_NAME"),
    *("AWS_ACCESS_KEY", "AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY", "AWS_SESSION_TOKEN", "AWS_LAMBDA_RUNTIME_API"),
    *("LAMBDA_TASK_ROOT", "LAMBDA_RUNTIME_DIR"),
}


def _variables(one: Resource) -> dict[str, Any]:
    return dict(one.properties.get("Environment", {}).get("Variables", {}))


def _long_environment(one: Resource, there: Installation) -> Iterator[str]:
    size = len(json.dumps({key: str(value) for key, value in _variables(one).items()}).encode())
    if size > 4096:
        yield f"its variables have {size} bytes"


def _reserved(one: Resource, there: Installation) -> Iterator[str]:
    yield from (f"{name} is Lambda's own" for name in sorted(RESERVED & set(_variables(one))))


def _ill_named(one: Resource, there: Installation) -> Iterator[str]:
    yield from (name for name in _variables(one) if not re.fullmatch(r"[a-zA-Z][a-zA-Z0-9_]+", name))


def _keeps_capacity(one: Resource, there: Installation) -> Iterator[str]:
    if "ReservedConcurrentExecutions" in one.properties:
        yield "it reserves executions"


def _batches(one: Resource, there: Installation) -> Iterator[str]:
    size, window = one.properties["BatchSize"], one.properties.get("MaximumBatchingWindowInSeconds", 0)
    if not 1 <= size <= 10_000 or (size > 10 and window < 1):
        yield f"batches of {size} and a window of {window} s"


def _function_of(mapping: Resource, there: Installation) -> Resource:
    return next(
        one for one in there.of(FUNCTION) if one.properties["FunctionName"] == mapping.properties["FunctionName"]
    )


def _queue_of(mapping: Resource, there: Installation) -> Resource:
    arn = mapping.properties["EventSourceArn"]
    return next(one for one in there.of("AWS::SQS::Queue") if there.account.attribute(one.name, "Arn") == arn)


def _impatient(one: Resource, there: Installation) -> Iterator[str]:
    timeout = _function_of(one, there).properties["Timeout"]
    if _queue_of(one, there).properties.get("VisibilityTimeout", 30) < timeout:
        yield f"its queue's visibility timeout is less than the function's {timeout} s"


def _may_not_receive(one: Resource, there: Installation) -> Iterator[str]:
    """Lambda looks when the mapping is made; so the right must be part of the role, and not come with a later policy."""
    role = there.everything[_function_of(one, there).raw["Properties"]["Role"]["Fn::GetAtt"][0]]
    allowed = {
        action
        for policy in role.properties["Policies"]
        for statement in policy["PolicyDocument"]["Statement"]
        if statement["Effect"] == "Allow" and one.properties["EventSourceArn"] in listed(statement["Resource"])
        for action in listed(statement["Action"])
    }
    for action in ("sqs:ReceiveMessage", "sqs:DeleteMessage", "sqs:GetQueueAttributes"):
        if action not in allowed:
            yield f"{role.name} has no {action}"


def _open(one: Resource, there: Installation) -> Iterator[str]:
    if one.properties["Principal"].endswith(".amazonaws.com") and not one.properties.get("SourceArn"):
        yield "every account's events and APIs may call it"


def _uncalled(there: Installation) -> Iterator[str]:
    """EventBridge calls a function only with that function's permission."""
    permitted = {
        (one.properties["FunctionName"], one.properties.get("SourceArn"))
        for one in there.of(PERMISSION)
        if one.properties["Principal"] == "events.amazonaws.com"
    }
    names = {there.account.attribute(one.name, "Arn"): one.properties["FunctionName"] for one in there.of(FUNCTION)}
    for rule in there.of("AWS::Events::Rule"):
        for target in rule.properties["Targets"]:
            name = names.get(target["Arn"])
            if name is not None and (name, there.account.attribute(rule.name, "Arn")) not in permitted:
                yield f"{rule.name} may not call {name}"


def _variable(name: str, value: str) -> Any:
    return lambda template: put(first(template, FUNCTION), f"Environment.Variables.{name}", value)


def _weak_role(template: Template) -> None:
    for name, one in template["Resources"].items():
        if name == "StartServerRole":
            for statement in one["Properties"]["Policies"][0]["PolicyDocument"]["Statement"]:
                if "sqs:ReceiveMessage" in statement["Action"]:
                    statement["Action"] = ["sqs:DeleteMessage", "sqs:GetQueueAttributes"]


RULES = (
    *text(
        FUNCTION,
        "FunctionName",
        f"{CREATE}: 64 characters",
        most=64,
        pattern=r"[a-zA-Z0-9-_]+",
        spoiled="next.step",
    ),
    *text(FUNCTION, "Description", CREATE, most=256),
    *text(FUNCTION, "Handler", CREATE, most=128, pattern=r"[^\s]+", spoiled="lambdas. x"),
    number(
        FUNCTION,
        "MemorySize",
        f'{CREATE}; new accounts: "Member must have value less than or equal to 3008" (aws-lambda-power-tuning 181)',
        128,
        3008,
    ),
    one_of(FUNCTION, "RecursiveLoop", "Lambda API Reference, PutFunctionRecursionConfig", ("Allow", "Terminate")),
    number(FUNCTION, "Timeout", "Lambda Developer Guide, Lambda quotas: 900 seconds", 1, 900),
    each(
        FUNCTION,
        "Environment.Variables",
        "at most 4 KB in all",
        "Lambda Developer Guide, Lambda quotas",
        _long_environment,
        _variable("TEXT", "x" * 4096),
    ),
    each(
        FUNCTION,
        "Environment.Variables",
        "no name that Lambda keeps to itself",
        "Lambda Developer Guide, Defined runtime environment variables",
        _reserved,
        _variable("AWS_REGION", "us-east-1"),
    ),
    each(
        FUNCTION,
        "Environment.Variables",
        "names of a letter and more letters, digits and underscores",
        "Lambda API Reference, Environment",
        _ill_named,
        _variable("X", "1"),
    ),
    each(
        FUNCTION,
        "ReservedConcurrentExecutions",
        "not at all: an account of 10 executions, as new ones are, can reserve none",
        "Lambda API Reference, PutFunctionConcurrency; \"decreases account's UnreservedConcurrentExecution below its minimum "
        'value" (fhir-works-on-aws-deployment 691)',
        _keeps_capacity,
        setting(FUNCTION, "ReservedConcurrentExecutions", 5),
    ),
    each(
        MAPPING,
        "BatchSize",
        "at most 10, or 10,000 with a window of a second",
        "Lambda API Reference, CreateEventSourceMapping",
        _batches,
        setting(MAPPING, "BatchSize", 11),
    ),
    number(MAPPING, "MaximumBatchingWindowInSeconds", "Lambda API Reference, CreateEventSourceMapping", 0, 300),
    number(MAPPING, "ScalingConfig.MaximumConcurrency", "Lambda API Reference, ScalingConfig", 2, 1000),
    each(
        MAPPING,
        "EventSourceArn",
        "a queue whose messages stay hidden for at least as long as the function may run",
        "Lambda Developer Guide, Using Lambda with Amazon SQS: queue configuration",
        _impatient,
        lambda t: put(t["Resources"]["StartQueue"]["Properties"], "VisibilityTimeout", 59),
    ),
    each(
        MAPPING,
        "FunctionName",
        "a function whose role may receive, delete and look, from the first moment",
        'Lambda Developer Guide, SQS event source; "The provided execution role does not have permissions to call '
        'ReceiveMessage on SQS" (aws-cdk 6770)',
        _may_not_receive,
        _weak_role,
    ),
    each(
        PERMISSION,
        "SourceArn",
        "there, where a service calls",
        "Lambda API Reference, AddPermission",
        _open,
        lambda t: first(t, PERMISSION).pop("SourceArn"),
    ),
    one_of(PERMISSION, "Action", "Lambda API Reference, AddPermission", ("lambda:InvokeFunction",)),
    Rule(
        PERMISSION,
        "FunctionName",
        "one for each rule of EventBridge that calls a function",
        "EventBridge User Guide, Resource-based policies: Lambda",
        _uncalled,
        lambda t: put(t["Resources"]["SweepTimerPermission"]["Properties"], "FunctionName", {"Ref": "NextStep"}),
    ),
    number(INVOKE, "MaximumRetryAttempts", "Lambda API Reference, PutFunctionEventInvokeConfig", 0, 2),
    number(INVOKE, "MaximumEventAgeInSeconds", "Lambda API Reference, PutFunctionEventInvokeConfig", 60, 21_600),
    *text(
        INVOKE,
        "Qualifier",
        "Lambda API Reference, PutFunctionEventInvokeConfig",
        pattern=r"\$LATEST|[a-zA-Z0-9-_]{1,128}",
        spoiled="the newest",
    ),
)
