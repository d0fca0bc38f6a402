"""`deploy plan`: shows what `apply` would change, in words."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import TYPE_CHECKING, Any

from rich.text import Text

from hippodrome.console import screen
from hippodrome.console.problem import Exit, Problem
from hippodrome.deployment.aws.account import Account, open_account, site_host
from hippodrome.deployment.aws.resource_names import STACK
from hippodrome.deployment.code.template import Template
from hippodrome.deployment.core import options
from hippodrome.deployment.core.finding import Finding, look
from hippodrome.deployment.core.finding import show as show_findings
from hippodrome.deployment.lifecycle import preflight
from hippodrome.deployment.stack import states
from hippodrome.deployment.stack.changes import Prepared, change_set, prepare
from hippodrome.deployment.stack.settings import StackSettings, taking_settings
from hippodrome.deployment.stack.states import StackAction

if TYPE_CHECKING:
    from hippodrome.deployment.core.project_folder import ProjectFolder

STATEFUL = {  # resource type → what is lost if a new resource replaces an old one of this type
    "AWS::S3::Bucket": "participants' data",
    "AWS::ECR::Repository": "the projects' images",
    "AWS::SQS::Queue": "messages on their way",
    "AWS::Logs::LogGroup": "its logs",
    "AWS::ECS::Cluster": "running servers",
    "AWS::EC2::VPC": "running servers",
    "AWS::EC2::Subnet": "running servers",
    "AWS::EC2::SecurityGroup": "running servers",
    "AWS::Scheduler::ScheduleGroup": "the shutdown timers of running servers",
    "AWS::ApiGatewayV2::DomainName": "the links that participants have",
}
_KINDS = {  # resource type → its name in words; other types are shown as they are
    "AWS::ApiGatewayV2::Api": "HTTP API",
    "AWS::ApiGatewayV2::DomainName": "address of the site",
    "AWS::ApiGatewayV2::Route": "HTTP route",
    "AWS::Budgets::Budget": "budget",
    "AWS::CertificateManager::Certificate": "certificate of the site",
    "AWS::CloudWatch::Alarm": "alarm",
    "AWS::CloudWatch::Dashboard": "dashboard",
    "AWS::EC2::VPC": "VPC",
    "AWS::ECR::Repository": "image repository",
    "AWS::ECS::Cluster": "ECS cluster",
    "AWS::Events::Rule": "event rule",
    "AWS::IAM::ManagedPolicy": "IAM policy for researchers",
    "AWS::IAM::Role": "IAM role",
    "AWS::Lambda::Function": "function",
    "AWS::Logs::LogGroup": "log group",
    "AWS::Route53::RecordSet": "DNS record",
    "AWS::S3::Bucket": "S3 bucket",
    "AWS::SNS::Topic": "topic",
    "AWS::SQS::Queue": "queue",
    "AWS::Scheduler::ScheduleGroup": "schedule group",
}
_SIGNS = {"create": "+", "change": "~", "may replace": "±", "replace": "±", "remove": "-", "import": "+"}
_STYLES = {
    "create": "green",
    "import": "green",
    "change": "",
    "may replace": "yellow",
    "replace": "red",
    "remove": "red",
}


@dataclass(frozen=True)
class Change:
    """A change of one resource. `action`: `create`, `change`, `replace`, `may replace`, `remove` or `import`."""

    action: str
    name: str  # the function's file name in lambdas/, or the logical id
    type: str
    logical_id: str
    physical_id: str = ""
    properties: tuple[str, ...] = ()
    kept: bool = False  # the old resource stays, outside of the stack

    @property
    def danger(self) -> str:
        """A sentence on what this change loses or leaves behind; "" if it does neither."""
        if self.type not in STATEFUL or self.action not in {"replace", "may replace", "remove"}:
            return ""
        holds = STATEFUL[self.type]
        event = {"replace": "is replaced", "may replace": "may be replaced", "remove": "is removed"}[self.action]
        fate = f"the old one stays in AWS with {holds}, but is no longer used" if self.kept else f"{holds} are lost"
        return f"{self.name} ({self.type}) {event}: {fate}."


@dataclass(frozen=True)
class Plan:
    """The changes that `apply` would make. `kind` is `create`, `update` or `nothing`."""

    stack: str
    region: str
    kind: str
    changes: Sequence[Change] = ()
    parameters: Mapping[str, tuple[str, str]] = field(
        default_factory=dict
    )  # the parameters that change: name → (present value, new value)
    seconds: float = 0.0
    findings: Sequence[Finding] = ()  # what would make it fail, or is worth a look
    site: str = ""  # the host name that participants will open, if it is new

    @property
    def dangers(self) -> list[str]:
        """Sentences on what is lost or left behind. The administrator has to agree to them."""
        return [change.danger for change in self.changes if change.danger]

    def as_json(self) -> dict[str, Any]:
        """Return the plan as JSON data, for scripts."""
        return {
            "stack": self.stack,
            "region": self.region,
            "kind": self.kind,
            "changes": [asdict(change) for change in self.changes],
            "parameters": {name: {"before": old, "after": new} for name, (old, new) in self.parameters.items()},
            "dangers": self.dangers,
            "findings": [asdict(finding) for finding in self.findings],
            "seconds": round(self.seconds, 1),
            "site": self.site,
        }


def of_change_set(answer: Iterable[Mapping[str, Any]], template: Template) -> list[Change]:
    """Read the changes in `answer`, the list `Changes` of DescribeChangeSet."""
    files = template.function_names()
    changes = []
    for one in answer:
        change = one.get("ResourceChange")
        if not change:
            continue
        logical = change["LogicalResourceId"]
        changes.append(
            Change(
                action=_action(change),
                name=files.get(logical, logical),
                type=change["ResourceType"],
                logical_id=logical,
                physical_id=change.get("PhysicalResourceId", ""),
                properties=tuple(dict.fromkeys(_properties(change))),
                kept="Retain" in str(change.get("PolicyAction", "")),
            )
        )
    return changes


def of_creation(template: Template, parameters: Mapping[str, str]) -> list[Change]:
    """List the changes that a new stack of this template makes."""
    files = template.function_names()
    return [
        Change("create", files.get(name, name), resource["Type"], name)
        for name, resource in template.resources(parameters).items()
    ]


def _action(change: Mapping[str, Any]) -> str:
    action = str(change["Action"])
    if action == "Modify":
        return {"True": "replace", "Conditional": "may replace"}.get(str(change.get("Replacement")), "change")
    return {"Add": "create", "Remove": "remove", "Import": "import"}.get(action, "change")


def _properties(change: Mapping[str, Any]) -> Iterator[str]:
    for detail in change.get("Details", ()):
        target = detail.get("Target", {})
        yield str(target.get("Name") or target.get("Attribute") or "")


def lines(plan: Plan) -> Iterator[tuple[str, str]]:
    """Write the plan as lines of text, each with its style for the package rich."""
    if plan.kind == "nothing":
        yield f"The stack {plan.stack} in {plan.region} is as it should be: nothing to do.", ""
        return
    verb = "will be made" if plan.kind == "create" else "will be updated"
    yield f"The stack {plan.stack} in {plan.region} {verb}:", "bold"
    for name, (before, after) in sorted(plan.parameters.items()):
        yield f"  {name}: {before or 'nothing'} → {after or 'nothing'}", "cyan"
    created = [change for change in plan.changes if change.action == "create"]
    yield from _counted(created) if plan.kind == "create" else _each(created, "create")
    for action in ("change", "may replace", "replace", "remove", "import"):
        yield from _each([change for change in plan.changes if change.action == action], action)
    if plan.site:
        yield f"Participants will open https://{plan.site}/next", ""
    elif plan.kind == "create":
        yield "Participants will open an address of AWS's: it is shown when it is made.", ""
    for danger in plan.dangers:
        yield f"  ! {danger}", "bold red"


def _counted(created: Sequence[Change]) -> Iterator[tuple[str, str]]:
    kinds: dict[str, list[str]] = {}
    for change in created:
        kinds.setdefault(change.type if change.type in _KINDS else "", []).append(change.name)
    others = kinds.pop("", [])
    for kind, names in sorted(kinds.items(), key=lambda one: (-len(one[1]), one[0])):
        many = f"{len(names)} {_KINDS[kind]}s" if len(names) > 1 else _KINDS[kind]
        listed = f": {', '.join(sorted(names))}" if kind == "AWS::Lambda::Function" else ""
        yield f"  + {many}{listed}", "green"
    if others:
        yield f"  + {len(others)} parts that connect them (permissions, subscriptions, network)", "green"


def _each(changes: Sequence[Change], action: str) -> Iterator[tuple[str, str]]:
    only_code = [change.name for change in changes if change.properties == ("Code",)]
    if action == "change" and only_code:
        yield f"  ~ new code: {', '.join(sorted(only_code))}", ""
        changes = [change for change in changes if change.properties != ("Code",)]
    words = {
        "replace": "is replaced: ",
        "may replace": "may be replaced: ",
        "remove": "is removed",
        "import": "is taken in",
    }
    for change in changes:
        text = words.get(action, "") + ", ".join(property_name for property_name in change.properties if property_name)
        yield f"  {_SIGNS[action]} {change.name} ({_called(change.type)}) {text}".rstrip(), _STYLES[action]


def _called(kind: str) -> str:
    return _KINDS.get(kind, kind.removeprefix("AWS::").replace("::", " "))


def show(plan: Plan, answer: bool = False) -> None:
    """Print the plan: to stdout if it is the command's `answer`, else to stderr, before it is carried out."""
    console = screen.out if answer else screen.err
    for line, style in lines(plan):
        console.print(Text(line, style=style))


# -- the command ------------------------------------------------------------------------------------------------------


def plan(account: Account, stack: str, settings: StackSettings, *, study: ProjectFolder | None = None) -> Plan:
    """Make the plan of what `apply` would do now. Raises `Problem` if `apply` could not begin.

    The stack is not changed. For an update, a change set is made and deleted.
    """
    began = time.monotonic()
    prepared = prepare(account, stack, settings)
    if prepared.existing is None:
        found = of_creation(prepared.template, prepared.parameters)
        findings = preflight.look_at(prepared, study)
        seconds = time.monotonic() - began
        return Plan(stack, account.region, "create", found, {}, seconds, findings, new_site(prepared))
    act = states.action_for(prepared.status)
    if act is StackAction.STOP:
        raise states.problem(stack, prepared.status)
    if act is StackAction.WAIT:
        raise Problem(f"The stack {stack} is in {prepared.status}.", "Wait until CloudFormation is done.")
    if act is not StackAction.UPDATE:
        raise Problem(
            f"The stack {stack} is in {prepared.status}: an update of it failed.",
            "`hippodrome apply` takes that back first.",
        )
    if prepared.unchanged():
        return Plan(stack, account.region, "nothing", seconds=time.monotonic() - began)
    if not prepared.bucket.exists():
        raise Problem(f"The code bucket {prepared.bucket.name} is gone.", "`hippodrome apply` makes it anew.")
    with change_set(prepared, keep=False) as change_set_made:
        changes = of_change_set(change_set_made.changes, prepared.template)
    if not changes:
        return Plan(stack, account.region, "nothing", seconds=time.monotonic() - began)
    findings = [look("CloudFormation", warning) for warning in change_set_made.warnings]
    findings += preflight.look_at(prepared, study)
    changed, seconds = prepared.changed_parameters(), time.monotonic() - began
    return Plan(stack, account.region, "update", changes, changed, seconds, findings, new_site(prepared))


def new_site(prepared: Prepared) -> str:
    """Return the new host name of the site, which participants open; "" if it does not change."""
    site = site_host(prepared.parameters)
    return site if site != site_host(prepared.before) else ""


def run(
    account: Account, stack: str, settings: StackSettings, as_json: bool, study: ProjectFolder | None = None
) -> int:
    """Make the plan, print it with its findings, and return the command's exit code."""
    changes = plan(account, stack, settings, study=study)
    if as_json:
        screen.result_json(changes.as_json())
    else:
        show(changes, answer=True)
        show_findings(changes.findings, screen.err)
    return Exit.DONE if changes.kind == "nothing" else Exit.CHANGES


@taking_settings
def command(
    *,
    stack: options.Stack = STACK,
    region: options.Region = None,
    profile: options.Profile = None,
    settings: StackSettings,
    as_json: options.Json = False,
) -> int:
    """Show what `apply` would change. Exit code 0: nothing; 3: something."""
    return run(open_account(profile, region), stack, settings, as_json)
