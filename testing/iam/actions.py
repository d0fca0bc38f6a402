"""The permissions that a call of an AWS API needs: actions on resources, with the values of the call's condition keys.

Source: AWS's Service Authorization Reference (read November 2026). Where it is silent or wrong, the messages of calls
that AWS has refused count: they name "*" (cdklabs/construct-hub pull request 1207) or `container-instance/{cluster}/*` for
ListTasks, so both must be allowed; `schedule/*/*` for ListSchedules, whatever its group; and the new cluster for
CreateCluster.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

from testing.aws_events import last


@dataclass(frozen=True)
class Ask:
    """A permission that a call needs: an action on a resource, with the condition keys `context`.

    `about` is the kind of the resource, such as `answers`.
    """

    action: str
    resource: str
    context: Mapping[str, Any] = field(default_factory=dict)
    about: str = ""

    @property
    def kind(self) -> str:
        """The name of this permission in tables for people, such as `s3:GetObject answers`."""
        return f"{self.action} {self.about}".strip()


class Facts(Protocol):
    """The facts of an account that decide which permissions a call needs."""

    region: str
    account: str

    def exists(self, bucket: str, key: str) -> bool:
        """Return whether the object exists."""

    def definition(self, name: str) -> tuple[str, list[str]]:
        """Return the ARN with revision of a task definition, and the ARNs of its roles."""

    def short_name(self, arn: str) -> str:
        """Return the short name of a topic, queue or role, such as "start" or "tasks"; of others the ARN."""


Params = Mapping[str, Any]


def asks(service: str, operation: str, params: Params, facts: Facts) -> list[Ask]:
    """Return the permissions that the call needs.

    Raises KeyError for an operation that the table below does not have.
    """
    return _TABLE[f"{service}:{operation}"](params, facts)


# -- S3


def about_key(key: str) -> str:
    """Return the kind of a document, such as `answers` for each `{projectId}/users/{userId}/answers/…`."""
    parts = key.split("/")
    if len(parts) > 3 and parts[1] == "users":
        return parts[3]
    if len(parts) > 3 and parts[1] == "sessions":
        return f"a session's {parts[3]}"
    if len(parts) > 2 and parts[1] == "lobby":
        return f"lobby/{parts[2]}"
    if len(parts) == 2 and key.endswith(".html"):
        return "steps"  # a page that HIPPO's script uploaded
    return parts[1] if len(parts) > 2 and parts[1] in ("steps", "slots", "handovers") else parts[0]


def _object(action: str, params: Params, context: Mapping[str, Any] | None = None) -> Ask:
    key = params["Key"]
    return Ask(action, f"arn:aws:s3:::{params['Bucket']}/{key}", context or {}, about_key(key))


def _bucket(params: Params) -> str:
    return f"arn:aws:s3:::{params['Bucket']}"


def _get_object(params: Params, facts: Facts) -> list[Ask]:
    """Return s3:GetObject; for a missing document also s3:ListBucket, without which S3 answers 403 instead of 404."""
    found = [_object("s3:GetObject", params)]
    if not facts.exists(params["Bucket"], params["Key"]):
        found.append(Ask("s3:ListBucket", _bucket(params)))
    return found


def _put_object(params: Params, facts: Facts) -> list[Ask]:
    """Return s3:PutObject; with If-Match also s3:GetObject, since the result tells about the stored document.

    (S3 User Guide, "How to prevent object overwrites with conditional writes".)
    """
    context = {}
    if "IfNoneMatch" in params:
        context["s3:if-none-match"] = params["IfNoneMatch"]
    if "IfMatch" in params:
        context["s3:if-match"] = params["IfMatch"]
    reads = [_object("s3:GetObject", params)] if "IfMatch" in params else []
    return [_object("s3:PutObject", params, context), *reads]


def _list_objects(params: Params, facts: Facts) -> list[Ask]:
    context = {"s3:prefix": params["Prefix"]} if "Prefix" in params else {}
    return [Ask("s3:ListBucket", _bucket(params), context)]


# -- ECS and EC2


def _ecs(facts: Facts, rest: str) -> str:
    return f"arn:aws:ecs:{facts.region}:{facts.account}:{rest}"


def _in_cluster(params: Params, facts: Facts) -> dict[str, str]:
    return {"ecs:cluster": _ecs(facts, f"cluster/{last(params['cluster'])}")}


def _run_task(params: Params, facts: Facts) -> list[Ask]:
    definition, roles = facts.definition(params["taskDefinition"])
    overrides = params.get("overrides", {})
    assert not {"taskRoleArn", "executionRoleArn"} & set(overrides), "other roles would have to be passed"
    return [
        Ask("ecs:RunTask", definition, _in_cluster(params, facts)),
        Ask("ecs:TagResource", _ecs(facts, f"task/{last(params['cluster'])}/*"), {"ecs:CreateAction": "RunTask"}),
        *(_pass(role, "ecs-tasks.amazonaws.com", facts) for role in roles),
    ]


def _pass(role: str, service: str, facts: Facts) -> Ask:
    return Ask("iam:PassRole", role, {"iam:PassedToService": service}, facts.short_name(role))


def _task(action: str, name: str) -> Callable[[Params, Facts], list[Ask]]:
    def needed(params: Params, facts: Facts) -> list[Ask]:
        tasks = params[name] if isinstance(params[name], list) else [params[name]]
        within = _in_cluster(params, facts)
        return [Ask(action, _ecs(facts, f"task/{last(params['cluster'])}/{last(task)}"), within) for task in tasks]

    return needed


def _list_tasks(params: Params, facts: Facts) -> list[Ask]:
    within = _in_cluster(params, facts)
    instances = _ecs(facts, f"container-instance/{last(params['cluster'])}/*")
    return [Ask("ecs:ListTasks", resource, within) for resource in ("*", instances)]


def _cluster(action: str, name: str) -> Callable[[Params, Facts], list[Ask]]:
    return lambda params, facts: [Ask(action, _ecs(facts, f"cluster/{last(params[name])}"))]


# -- Route 53


def _zone(params: Params) -> str:
    return f"arn:aws:route53:::hostedzone/{last(params['HostedZoneId'])}"


def normalized(name: str) -> str:
    """Return a name in the form of the condition key: lower case, no final dot, special characters as octal codes.

    https://docs.aws.amazon.com/Route53/latest/DeveloperGuide/specifying-rrset-conditions.html
    """
    return re.sub(r"[^a-z0-9_.-]", lambda m: f"\\{ord(m[0]):03o}", name.lower().rstrip("."))


def _change_records(params: Params, facts: Facts) -> list[Ask]:
    changes = params["ChangeBatch"]["Changes"]
    records = [change["ResourceRecordSet"] for change in changes]
    key = "route53:ChangeResourceRecordSets"
    context = {
        f"{key}NormalizedRecordNames": sorted({normalized(record["Name"]) for record in records}),
        f"{key}RecordTypes": sorted({record["Type"] for record in records}),
        f"{key}Actions": sorted({change["Action"] for change in changes}),
    }
    about = f"{'+'.join(context[f'{key}Actions'])} {'+'.join(context[f'{key}RecordTypes'])}"
    return [Ask(key, _zone(params), context, about)]


# -- Scheduler, SNS, SQS


def _schedule(action: str) -> Callable[[Params, Facts], list[Ask]]:
    def needed(params: Params, facts: Facts) -> list[Ask]:
        name = f"schedule/{params.get('GroupName', 'default')}/{params['Name']}"
        found = [Ask(action, f"arn:aws:scheduler:{facts.region}:{facts.account}:{name}")]
        if "Target" in params:
            found.append(_pass(params["Target"]["RoleArn"], "scheduler.amazonaws.com", facts))
        return found

    return needed


def _list_schedules(params: Params, facts: Facts) -> list[Ask]:
    return [Ask("scheduler:ListSchedules", f"arn:aws:scheduler:{facts.region}:{facts.account}:schedule/*/*")]


def _publish(params: Params, facts: Facts) -> list[Ask]:
    return [Ask("sns:Publish", params["TopicArn"], {}, facts.short_name(params["TopicArn"]))]


def _send_message(params: Params, facts: Facts) -> list[Ask]:
    arn = f"arn:aws:sqs:{facts.region}:{facts.account}:{last(params['QueueUrl'])}"
    return [Ask("sqs:SendMessage", arn, {}, facts.short_name(arn))]


_TABLE: dict[str, Callable[[Params, Facts], list[Ask]]] = {
    "s3:GetObject": _get_object,
    "s3:PutObject": _put_object,
    "s3:DeleteObject": lambda params, facts: [_object("s3:DeleteObject", params)],
    "s3:ListObjectsV2": _list_objects,
    "ecs:RunTask": _run_task,
    "ecs:StopTask": _task("ecs:StopTask", "task"),
    "ecs:DescribeTasks": _task("ecs:DescribeTasks", "tasks"),
    "ecs:ListTasks": _list_tasks,
    "ecs:CreateCluster": _cluster("ecs:CreateCluster", "clusterName"),
    "ecs:DeleteCluster": _cluster("ecs:DeleteCluster", "cluster"),
    "ecs:ListClusters": lambda params, facts: [Ask("ecs:ListClusters", "*")],
    "ec2:DescribeNetworkInterfaces": lambda params, facts: [Ask("ec2:DescribeNetworkInterfaces", "*")],
    "route53:ChangeResourceRecordSets": _change_records,
    "route53:GetChange": lambda p, facts: [Ask("route53:GetChange", f"arn:aws:route53:::change/{last(p['Id'])}")],
    "route53:ListResourceRecordSets": lambda p, facts: [Ask("route53:ListResourceRecordSets", _zone(p))],
    "scheduler:CreateSchedule": _schedule("scheduler:CreateSchedule"),
    "scheduler:UpdateSchedule": _schedule("scheduler:UpdateSchedule"),
    "scheduler:DeleteSchedule": _schedule("scheduler:DeleteSchedule"),
    "scheduler:ListSchedules": _list_schedules,
    "sns:Publish": _publish,
    "sqs:SendMessage": _send_message,
}
