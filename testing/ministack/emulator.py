"""Runs ministack 1.5.33 with bridges over its gaps. ministack's own Python runs this file; tests do not import it.

    VENV/bin/python testing/ministack/emulator.py   # with ministack's environment variables, and DECISIONS=FILE

It ends when its standard input ends, so that it does not outlive the tests. It writes every decision about a caller
other than root to DECISIONS, one JSON object per line: `who`, `action`, `resource`, `allowed`.

With AUTH=true ministack judges each call by the caller's policies. But for some actions it judges another resource than
AWS does, or lacks condition keys, so that it refuses callers whom AWS allows the call. These gaps are bridged here, by
the Service Authorization Reference (read November 2026):

- ECS: every call that names a cluster is judged on the cluster. AWS: RunTask on the task definition with its revision,
  StopTask and DescribeTasks on each task, ListTasks on container instances, CreateCluster on the new cluster; and all
  of them with the key ecs:cluster.
- ECS RegisterTaskDefinition is judged on "*". AWS: on the task definition, with PassRole for its roles.
- CloudWatch DescribeAlarms is judged on "*". AWS: on `alarm:*` where the call lists alarms.
- Scheduler: every schedule is judged as one of the group `default`.
- Route 53: GetChange is judged on "*" instead of the change; ChangeResourceRecordSets lacks its three condition keys.
- S3: PutObject lacks the keys s3:if-match and s3:if-none-match.
- PassRole is never judged. AWS judges it for RunTask (the task definition's roles and those of the overrides) and for
  schedules, with iam:PassedToService; and for CloudFormation, Lambda and others that no function of ours calls.

Gaps elsewhere:

- ECS emits no events, and PutEvents refuses the source `aws.ecs` to all callers, as on AWS. Here root may use it.
- RunTask ignores clientToken. AWS: the same token and parameters in a cluster give the same task again, and other
  parameters a ConflictException that names it.
- CloudFormation passes a number that comes from a parameter on as text, with which Lambda's pollers cannot compute.
- EC2 does not remember to which interface an address was associated; and DescribeNetworkInterfaces leaves out unknown
  ids, while on AWS the call fails.
"""

from __future__ import annotations

import contextvars
import json
import os
import signal
import sys
import threading
import urllib.parse
from dataclasses import dataclass, field
from typing import Any

import defusedxml.ElementTree as xml
from ministack.core import iam_actions, iam_evaluator
from ministack.services import ec2, ecs, eventbridge, lambda_svc

ECS_TASKS = "ecs-tasks.amazonaws.com"

_lock = threading.Lock()
_decisions = open(os.environ["DECISIONS"], "a", buffering=1)  # noqa: SIM115 - as long as the process lives


@dataclass
class Asked:
    """The permissions that a request needs on AWS: its action on these resources, with these condition keys; and PassRole."""

    resources: list[str]
    context: dict[str, Any] = field(default_factory=dict)
    passed: list[tuple[str, str]] = field(default_factory=list)  # roles, each with the service to which it is passed


_asked: contextvars.ContextVar[tuple[str, Asked] | None] = contextvars.ContextVar("asked", default=None)


def asked_of_ecs(operation: str, data: dict[str, Any], place: str) -> Asked | None:
    named = str(data.get("cluster") or data.get("clusterName") or "default").rpartition("/")[2]
    arn = f"arn:aws:ecs:{place}"
    inside = {"ecs:cluster": f"{arn}:cluster/{named}"}
    if operation == "RunTask":
        key = ecs._resolve_td_key(data.get("taskDefinition", ""))
        definition = ecs._task_defs.get(key) or {}
        overrides = data.get("overrides") or {}
        roles = {overrides.get(k) or definition.get(k) for k in ("taskRoleArn", "executionRoleArn")} - {None, ""}
        passed = [(role, ECS_TASKS) for role in sorted(roles)]
        return Asked([definition.get("taskDefinitionArn") or f"{arn}:task-definition/{key}"], inside, passed)
    if operation == "RegisterTaskDefinition":
        roles = {data.get("taskRoleArn"), data.get("executionRoleArn")} - {None, ""}
        return Asked([f"{arn}:task-definition/{data.get('family')}:1"], passed=[(role, ECS_TASKS) for role in roles])
    if operation in {"StopTask", "DescribeTasks"}:
        tasks = data.get("tasks") or [data.get("task", "")]
        return Asked([task if task.startswith("arn:") else f"{arn}:task/{named}/{task}" for task in tasks], inside)
    if operation == "ListTasks":
        return Asked([f"{arn}:container-instance/{named}/any"], inside)
    if operation in {"CreateCluster", "DeleteCluster"}:
        return Asked([inside["ecs:cluster"]], inside)
    return None


def asked_of_scheduler(path: str, data: dict[str, Any], query: dict[str, Any], place: str) -> Asked | None:
    parts = [urllib.parse.unquote(part) for part in path.split("/") if part]
    if "schedules" not in parts or parts[-1] == "schedules":
        return None
    asked = query.get("groupName") or query.get("GroupName") or ["default"]
    group = data.get("GroupName") or (asked[0] if isinstance(asked, list) else asked)
    role = (data.get("Target") or {}).get("RoleArn")
    passed = [(role, "scheduler.amazonaws.com")] if role else []
    return Asked([f"arn:aws:scheduler:{place}:schedule/{group}/{parts[-1]}"], passed=passed)


def asked_of_route53(method: str, path: str, body: bytes) -> Asked | None:
    parts = [part for part in path.split("/") if part]
    if "change" in parts:
        return Asked([f"arn:aws:route53:::change/{parts[-1]}"])
    if method == "POST" and parts[-1] == "rrset":
        root = xml.fromstring(body)
        texts: dict[str, list[str]] = {"Name": [], "Type": [], "Action": []}
        for change in root.iter():
            name = change.tag.rpartition("}")[2]
            if name in texts and change.text:
                texts[name].append(change.text.strip())
        prefix = "route53:ChangeResourceRecordSets"
        keys = {
            f"{prefix}NormalizedRecordNames": [name.lower().rstrip(".") for name in texts["Name"]],
            f"{prefix}RecordTypes": texts["Type"],
            f"{prefix}Actions": texts["Action"],
        }
        return Asked([f"arn:aws:route53:::hostedzone/{parts[parts.index('hostedzone') + 1]}"], keys)
    return None


def asked_of_s3(method: str, headers: dict[str, str], theirs: str) -> Asked | None:
    conditions = {f"s3:{name}": headers[name] for name in ("if-match", "if-none-match") if headers.get(name)}
    return Asked([theirs], conditions) if method == "PUT" and conditions else None


def bridge_authorization() -> None:
    their_resource, their_enforce = iam_actions.extract_resource_arn, iam_evaluator.enforce

    def extract_resource_arn(
        service: str,
        method: str,
        path: str,
        headers: dict[str, str],
        body: bytes,
        query: dict[str, Any],
        region: str,
        account: str,
    ) -> str:
        theirs = their_resource(service, method, path, headers, body, query, region, account)
        place = f"{region}:{account}"
        data = json.loads(body) if service in {"ecs", "scheduler"} and body[:1] == b"{" else {}
        operation = headers.get("x-amz-target", "").rpartition(".")[2]
        if service == "ecs":
            found = asked_of_ecs(operation, data, place)
        elif service == "scheduler":
            found = asked_of_scheduler(path, data, query, place)
        elif service == "s3":
            found = asked_of_s3(method, headers, theirs)
        elif service == "route53":
            found = asked_of_route53(method, path, body)
        elif service == "monitoring" and b"DescribeAlarms" in body + operation.encode():
            found = Asked([f"arn:aws:cloudwatch:{place}:alarm:*"])
        else:
            found = None
        _asked.set((service, found) if found else None)
        return found.resources[0] if found else theirs

    def enforce(
        key: str,
        action: str,
        service: str,
        region: str,
        resource_arn: str = "*",
        service_context: dict[str, Any] | None = None,
    ) -> Any:
        asked = _asked.get()
        checks = [(action, resource_arn, dict(service_context or {}))]
        if asked and asked[0] == service:
            _asked.set(None)
            more = asked[1]
            checks = [(action, resource, {**(service_context or {}), **more.context}) for resource in more.resources]
            checks += [("iam:PassRole", role, {"iam:PassedToService": to}) for role, to in more.passed]
        denied = None
        for act, resource, context in checks:
            answer = their_enforce(key, act, service, region, resource_arn=resource, service_context=context)
            record(key, act, resource, answer)
            denied = denied or answer
        return denied

    iam_actions.extract_resource_arn = extract_resource_arn
    iam_evaluator.enforce = enforce


def record(key: str, action: str, resource: str, denied: Any) -> None:
    from ministack.core.responses import get_account_id

    if iam_evaluator.is_root_access_key(key):
        return
    principal = iam_evaluator.resolve_principal(key, get_account_id())
    who = getattr(principal, "arn", None) or "unknown"
    line = json.dumps({"who": who, "action": action, "resource": resource, "allowed": denied is None})
    with _lock:
        _decisions.write(line + "\n")


def bridge_events() -> None:
    theirs = eventbridge._put_events

    def put_events(data: Any, allow_aws_source: bool = False) -> Any:
        return theirs(data, allow_aws_source or iam_evaluator.caller_arn().endswith(":root"))

    eventbridge._put_events = put_events


def bridge_run_task() -> None:
    run_task = ecs._run_task
    known: dict[tuple[str, str], tuple[str, Any]] = {}

    def run_once(data: dict[str, Any]) -> Any:
        token = data.get("clientToken")
        if not token:
            return run_task(data)
        with _lock:
            key = (str(data.get("cluster")), token)
            asked = json.dumps(data, sort_keys=True)
            if key not in known:
                answer = run_task(data)
                if answer[0] != 200:
                    return answer
                known[key] = (asked, answer)
        before, answer = known[key]
        if before == asked:
            return answer
        tasks = [task["taskArn"] for task in json.loads(answer[2])["tasks"]]
        body = {"__type": "ConflictException", "message": "The token was used before.", "resourceIds": tasks}
        return 400, {"Content-Type": "application/x-amz-json-1.1"}, json.dumps(body).encode()

    ecs._run_task = run_once
    for table in vars(ecs).values():
        if isinstance(table, dict) and table.get("RunTask") is run_task:
            table["RunTask"] = run_once


def bridge_addresses() -> None:
    actions = ec2._ACTION_MAP
    associate, describe, fields = actions["AssociateAddress"], actions["DescribeNetworkInterfaces"], ec2._eni_fields_xml
    public: dict[str, str] = {}

    def associate_address(p: Any) -> Any:
        address = ec2._addresses.get(ec2._p(p, "AllocationId"))
        if address and (interface := ec2._p(p, "NetworkInterfaceId")):
            public[interface] = address["PublicIp"]
        return associate(p)

    def describe_network_interfaces(p: Any) -> Any:
        for interface in ec2._parse_member_list(p, "NetworkInterfaceId"):
            if interface not in ec2._network_interfaces:
                text = f"The networkInterface ID '{interface}' does not exist"
                return ec2._error("InvalidNetworkInterfaceID.NotFound", text, 400)
        return describe(p)

    def eni_fields_xml(eni: Any, tag: str = "item") -> str:
        text: str = fields(eni, tag=tag)
        address = public.get(eni["NetworkInterfaceId"])
        made = f"<association><publicIp>{address}</publicIp></association>" if address else ""
        return text.replace("<groupSet>", f"{made}<groupSet>", 1)

    actions["AssociateAddress"] = associate_address
    actions["DescribeNetworkInterfaces"] = describe_network_interfaces
    ec2._eni_fields_xml = eni_fields_xml


def bridge_pollers() -> None:
    theirs = lambda_svc._sqs_esm_concurrency

    def concurrency(*known: Any) -> int:
        return int(theirs(*known))

    lambda_svc._sqs_esm_concurrency = concurrency


def end_with_parent() -> None:
    """Kill this process group, to which the functions belong, when standard input ends, so that it does not outlive tests."""

    def wait() -> None:
        sys.stdin.buffer.read()
        os.killpg(0, signal.SIGKILL)

    threading.Thread(target=wait, daemon=True).start()


if __name__ == "__main__":
    from ministack import app

    if os.getpgid(0) != os.getpid():
        os.setpgid(0, 0)
    bridge_authorization()
    bridge_events()
    bridge_addresses()
    bridge_run_task()
    bridge_pollers()
    end_with_parent()
    app._port_is_bindable = lambda *_: False  # with TLS it would take port 443 as well
    app.main()
