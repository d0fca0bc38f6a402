"""What a deployment would change, in words."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from hippodrome.deployment.code.template import Template
from hippodrome.deployment.core.finding import Finding

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
_ACTIONS = {  # action → its sign, its words, and its style for the package rich
    "create": ("+", "", "green"),
    "import": ("+", "is taken in", "green"),
    "change": ("~", "", ""),
    "may replace": ("±", "may be replaced: ", "yellow"),
    "replace": ("±", "is replaced: ", "red"),
    "remove": ("-", "is removed", "red"),
}


@dataclass(frozen=True)
class Change:
    """A change of one resource. `action`: `create`, `change`, `replace`, `may replace`, `remove` or `import`."""

    action: str
    name: str  # the function's file name in lambdas/, or the logical id
    type: str
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

    @property
    def kind(self) -> str:
        """The type in words: `Lambda Function`."""
        return self.type.removeprefix("AWS::").replace("::", " ")


@dataclass(frozen=True)
class Plan:
    """The changes that a deployment would make. `kind` is `create`, `update` or `nothing`."""

    stack: str
    region: str
    kind: str
    changes: Sequence[Change] = ()
    parameters: Mapping[str, tuple[str, str]] = field(default_factory=dict)  # name → (present value, new value)
    findings: Sequence[Finding] = ()  # what would make it fail, or is worth a look
    site: str = ""  # the host name that participants will open, if it is new

    @property
    def dangers(self) -> list[str]:
        """Sentences on what is lost or left behind. The administrator has to agree to them."""
        return [change.danger for change in self.changes if change.danger]

    def as_json(self) -> dict[str, Any]:
        """Return the plan as JSON data, for scripts."""
        parameters = {name: {"before": old, "after": new} for name, (old, new) in self.parameters.items()}
        return asdict(self) | {"parameters": parameters, "dangers": self.dangers}

    def lines(self) -> Iterator[tuple[str, str]]:
        """Write the plan as lines of text, each with its style for the package rich."""
        if self.kind == "nothing":
            yield f"The stack {self.stack} in {self.region} is as it should be: nothing to do.", ""
            return
        verb = "will be made" if self.kind == "create" else "will be updated"
        yield f"The stack {self.stack} in {self.region} {verb}:", "bold"
        for name, (before, after) in sorted(self.parameters.items()):
            yield f"  {name}: {before or 'nothing'} → {after or 'nothing'}", "cyan"
        yield from _created(self.changes) if self.kind == "create" else _changed(self.changes)
        if self.site:
            yield f"Participants will open https://{self.site}/next", ""
        elif self.kind == "create":
            yield "Participants will open an address of AWS's: it is shown when it is made.", ""
        for danger in self.dangers:
            yield f"  ! {danger}", "bold red"


def _created(changes: Sequence[Change]) -> Iterator[tuple[str, str]]:
    functions = sorted(change.name for change in changes if change.type == "AWS::Lambda::Function")
    yield f"  + {len(functions)} functions: {', '.join(functions)}", "green"
    kinds = Counter(change.kind for change in changes if change.type != "AWS::Lambda::Function")
    listed = ", ".join(f"{number} {kind}" for kind, number in kinds.most_common(5))
    yield f"  + {kinds.total()} other resources: {listed}{' …' if len(kinds) > 5 else ''}", "green"


def _changed(changes: Sequence[Change]) -> Iterator[tuple[str, str]]:
    if only_code := sorted(change.name for change in changes if change.properties == ("Code",)):
        yield f"  ~ new code: {', '.join(only_code)}", ""
    for action, (sign, words, style) in _ACTIONS.items():
        for change in changes:
            if change.action == action and change.name not in only_code:
                text = words + ", ".join(filter(None, change.properties))
                yield f"  {sign} {change.name} ({change.kind}) {text}".rstrip(), style


def of_change_set(answer: Iterable[Mapping[str, Any]], template: Template) -> list[Change]:
    """Read the changes in `answer`, the list `Changes` of DescribeChangeSet."""
    files = template.function_names()
    return [
        Change(
            action=_action(change),
            name=files.get(change["LogicalResourceId"], change["LogicalResourceId"]),
            type=change["ResourceType"],
            properties=tuple(dict.fromkeys(_properties(change))),
            kept="Retain" in str(change.get("PolicyAction", "")),
        )
        for entry in answer
        if (change := entry.get("ResourceChange"))
    ]


def of_creation(template: Template, parameters: Mapping[str, str]) -> list[Change]:
    """List the changes that a new stack of this template makes."""
    files = template.function_names()
    resources = template.resources(parameters).items()
    return [Change("create", files.get(name, name), resource["Type"]) for name, resource in resources]


def _action(change: Mapping[str, Any]) -> str:
    action = str(change["Action"])
    if action == "Modify":
        return {"True": "replace", "Conditional": "may replace"}.get(str(change.get("Replacement")), "change")
    return {"Add": "create", "Remove": "remove", "Import": "import"}.get(action, "change")


def _properties(change: Mapping[str, Any]) -> Iterator[str]:
    for detail in change.get("Details", ()):
        target = detail.get("Target", {})
        yield str(target.get("Name") or target.get("Attribute") or "")
