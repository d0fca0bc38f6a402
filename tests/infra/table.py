"""The table of `docs/permissions.md`, made from the template: `python -m tests.infra.table` writes it there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from testing import template as cfn

PATH = Path(__file__).resolve().parents[2] / "docs" / "permissions.md"
BEGIN, END = "<!-- made by python -m tests.infra.table from infra/template.yml -->", "<!-- end -->"

# What references are called in the table.
KNOWN = {
    "Bucket.Arn": "bucket",
    "Cluster.Arn": "cluster/<stack>",
    "Cluster": "<stack>",
    "HostedZoneId": "zone",
    "ScheduleGroup": "<stack>",
    "StartServerTopic": "start topic",
    "StopServerTopic": "stop topic",
    "StartQueue.Arn": "start queue",
    "StopQueue.Arn": "stop queue",
    "TaskQueue.Arn": "task queue",
    "Repository.Arn": "images",
    "TaskExecutionRole.Arn": "task execution role",
    "ScheduleRole.Arn": "schedule role",
    "UpdateProjectMasterList.Arn": "update_project_master_list",
    "TrialLogGroup.Arn": "the trials' log",
}
ROLES = {
    "TaskExecutionRole": "Fargate, before the container runs",
    "ScheduleRole": "shutdown timers",
    "ResearcherPolicy": "researchers (attached by the administrator)",
}


def account() -> cfn.ReferenceValues:
    logs = {f"{name}.Arn": "its log" for name in cfn.resources("AWS::Logs::LogGroup")}
    return cfn.ReferenceValues(
        "<stack>",
        "account",
        "region",
        {"RootDomain": "<domain>", "SiteHost": "<site>", "ServersHost": "<servers>"},
        {**logs, **KNOWN},
    )


def render() -> str:
    """Everything between the two markers."""
    lines = ["| function | trigger | memory | timeout | variables |", "|---|---|---|---|---|"]
    found = cfn.resources("AWS::Lambda::Function")
    for name, logical in cfn.functions().items():
        properties = found[logical]
        variables = ", ".join(f"`{key}`" for key in properties.get("Environment", {}).get("Variables", {}))
        lines.append(
            f"| `{name}` | {trigger(logical)} | {properties['MemorySize']} MB | {properties['Timeout']} s | {variables} |"
        )
    for name, logical in cfn.functions().items():
        lines += ["", f"### {name}", "", *permissions(found[logical]["Role"]["Fn::GetAtt"][0])]
    for role, title in ROLES.items():
        lines += ["", f"### {title}", "", *permissions(role)]
    return "\n".join(lines)


def trigger(logical: str) -> str:
    """Return what makes the function run."""
    for mapping in cfn.resources("AWS::Lambda::EventSourceMapping").values():
        if mapping["FunctionName"] == {"Ref": logical}:
            queue = account().attribute(mapping["EventSourceArn"]["Fn::GetAtt"][0], "Arn")
            window = mapping.get("MaximumBatchingWindowInSeconds")
            waits = f" or {window} s" if window else ""
            at_once = account().resolve(mapping["ScalingConfig"]["MaximumConcurrency"])
            return f"{queue}, {mapping['BatchSize']} messages{waits}, {at_once} at once"
    for rule in cfn.resources("AWS::Events::Rule").values():
        if rule.get("ScheduleExpression") and rule["Targets"][0]["Arn"]["Fn::GetAtt"][0] == logical:
            return f"timer, {rule['ScheduleExpression']}"
    targets = [
        name for name, i in cfn.resources("AWS::ApiGatewayV2::Integration").items() if i["IntegrationUri"]["Fn::GetAtt"][0] == logical
    ]  # fmt: skip
    routes = [
        route["RouteKey"]
        for route in cfn.resources("AWS::ApiGatewayV2::Route").values()
        if targets and route["Target"]["Fn::Sub"] == f"integrations/${{{targets[0]}}}"
    ]
    paths = {
        path: [key.split()[0] for key in routes if key.endswith(f" {path}")] for path in (r.split()[1] for r in routes)
    }
    return "HTTP " + "; ".join(f"`{', '.join(m)} {path}`" for path, m in paths.items()) if paths else "direct invoke"


def permissions(name: str) -> list[str]:
    """Return the statements of a role's policies, or of a managed policy, a row each."""
    one = cfn.template()["Resources"][name]
    managed = one["Type"] == "AWS::IAM::ManagedPolicy"
    documents = [one["Properties"]["PolicyDocument"]] if managed else cfn.role_documents(name)
    rows = ["| may | on | only if |", "|---|---|---|"]
    for statement in (account().resolve(s) for document in documents for s in document["Statement"]):
        actions = "<br>".join(f"`{action}`" for action in cfn.listed(statement["Action"]))
        if statement["Effect"] == "Deny":
            actions = f"never: {actions}"
        on = "<br>".join(f"`{short(resource)}`" for resource in cfn.listed(statement["Resource"]))
        rows.append(f"| {actions} | {on} | {'<br>'.join(conditions(statement.get('Condition', {})))} |")
    return rows


def conditions(condition: dict[str, Any]) -> list[str]:
    """Return a condition in words as few as can be."""
    found = []
    for operator, keys in condition.items():
        for key, values in keys.items():
            listed = ", ".join(f"`{short(str(value))}`" for value in cfn.listed(values))
            name = key.replace("route53:ChangeResourceRecordSets", "").replace("NormalizedRecordNames", "names")
            if operator == "Null":
                found.append(f"`{name}` is given")
            else:
                found.append(f"{name} {'are not' if 'Not' in operator else 'in'} {listed}")
    return found


def short(resource: str) -> str:
    """Return an ARN without what is the same everywhere; 20 question marks as an ellipsis."""
    return re.sub(r"^arn:[^:]*:[^:]*:[^:]*:[^:]*:", "", resource).replace("s????????????????????", "s…")


def written() -> str:
    """Return what stands between the markers now."""
    return PATH.read_text(encoding="utf-8").split(BEGIN)[1].split(END)[0].strip()


if __name__ == "__main__":
    text = PATH.read_text(encoding="utf-8")
    before, after = text.split(BEGIN)[0], text.split(END)[1]
    PATH.write_text(f"{before}{BEGIN}\n{render()}\n{END}{after}", encoding="utf-8")
