"""The section `project` of config.yml, key by key: what each value may be by itself, its default, its meaning.

The keys of `trial` are in `protocol/trial.py`, because the servers check them too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, GetJsonSchemaHandler, model_validator
from pydantic.alias_generators import to_camel
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, core_schema

from hippodrome.config import fargate, project_values
from hippodrome.config.diagnostics import Keys
from hippodrome.config.project_values import FINAL
from protocol import values as plain
from protocol.trial import Trial, Ui, names
from protocol.values import Check


@dataclass(frozen=True, eq=False)  # equal only to itself, so that it can be hashed
class Rule:
    """Validates a field by one of our checks, so that the researcher reads its message, and describes it to editors."""

    check: Check
    schema: Mapping[str, Any] = field(default_factory=lambda: {"type": "string"})

    def __get_pydantic_core_schema__(self, _source: object, _handler: object) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)

    def __get_pydantic_json_schema__(self, _schema: CoreSchema, _handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return dict(self.schema)


def whole(low: int, high: int | None = None) -> Rule:
    """A whole number within bounds."""
    bounds = {"minimum": low} if high is None else {"minimum": low, "maximum": high}
    return Rule(plain.whole(low, high), {"type": "integer", **bounds})


def _one_of(*choices: str) -> Rule:
    return Rule(plain.one_of(*choices), {"enum": list(choices)})


def _items(what: str, limit: int, single: bool = False) -> BeforeValidator:
    return BeforeValidator(plain.items(what, limit, single))


_Flag = Annotated[bool, Rule(plain.flag, {"type": "boolean"})]
_Text = Annotated[str, Rule(plain.text())]
_Bucket = Annotated[
    str, Rule(project_values.bucket, {"type": "string", "pattern": "^[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]$"})
]
_ObjectKey = Annotated[str, Rule(project_values.object_key)]
_StepName = Annotated[
    str, Rule(project_values.step_name, {"anyOf": [{"type": "integer", "minimum": 1}, {"const": FINAL}]})
]

_ODD_NAMES = {"use_aws": "useAWS"}


class Model(BaseModel):
    """A section of the file. A key left empty counts as not given."""

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        alias_generator=lambda name: _ODD_NAMES.get(name) or to_camel(name),
    )

    @classmethod
    def names(cls) -> frozenset[str]:
        """The names of the keys as they stand in the file."""
        return frozenset(info.alias or name for name, info in cls.model_fields.items())

    def given(self, key: str) -> bool:
        """Whether the key (as in the file) was given and was good."""
        return any(type(self).model_fields[name].alias == key for name in self.model_fields_set)

    @model_validator(mode="before")
    @classmethod
    def _drop_empty(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        return {key: value for key, value in data.items() if value not in (None, "") or key not in cls.names()}


class AwsSetup(Model):
    """Where a project lies in AWS, and how large its servers are."""

    bucket: _Bucket | None = None
    """S3 bucket that holds the project's pages and data. Default: the installation's."""
    region: Annotated[str, Rule(project_values.region)] | None = None
    """AWS region, such as ca-central-1. Default: the installation's."""
    root_domain: Annotated[str, Rule(project_values.domain)] | None = None
    """Domain below which each server gets its name; without https://. Default: the installation's."""
    cpu: Annotated[float, Rule(fargate.cpu, {"enum": [int(n) if n >= 1 else n for n in fargate.SIZES]})] | None = None
    """vCPUs of each participant's server. Needed for AWS."""
    memory: Annotated[float, Rule(fargate.memory, {"type": "number", "minimum": 0.5, "maximum": 120})] | None = None
    """Memory of each participant's server in GB; must fit cpu. Needed for AWS."""


class Events(Model):
    """At which steps a participant's server starts and stops."""

    start_server_step: _StepName | None = None
    """The step whose reaching starts the server. Default with a game step: 2, or 1 if the game is step 1."""
    stop_server_step: _StepName | None = None
    """The step whose reaching stops the server. Default: the step after the last game step."""


class Ssl(Model):
    """Where the servers fetch their certificate: three keys or none."""

    ssl_bucket: _Bucket | None = None
    """S3 bucket that holds the certificate."""
    fullchain: _ObjectKey | None = None
    """Path of fullchain.pem within sslBucket."""
    privkey: _ObjectKey | None = None
    """Path of privkey.pem within sslBucket."""


class Project(Model):
    """Who runs the study, its steps, and where its servers run."""

    id: Annotated[
        str, Rule(project_values.project_id, {"type": ["string", "integer"], "pattern": "^(?!_)[A-Za-z0-9_-]{1,64}$"})
    ] = ""
    """The project's id: letters, digits, dashes and underscores; unique in your organization."""
    name: Annotated[str, Rule(plain.text("a name"))] = ""
    """A label for people. Default: the id."""
    researcher: _Text = ""
    """Who is responsible for the study."""
    team_members: Annotated[
        tuple[_Text, ...], _items("person", 200, single=True), Field(json_schema_extra={"type": ["array", "string"]})
    ] = ()
    """Others in the team: one name or a list."""
    live: _Flag = True
    """Whether participants can take part now."""
    max_runtime: Annotated[int, whole(1, 1440)] = 60
    """Minutes after which a server is stopped, whatever happens."""
    use_aws: _Flag = False
    """Whether the study is for AWS. false keeps it on one machine; left out, deploying it puts it on AWS."""
    aws_setup: AwsSetup = AwsSetup()
    """How large the servers are, and where on AWS; needed for AWS."""
    events: Events = Events()
    """When the participant's server starts and stops."""
    ssl: Ssl = Ssl()
    """Has no effect: servers get the installation's certificate. HIPPO's configurations have it."""
    steps: dict[Annotated[str, Rule(project_values.step_key)], Annotated[str, Rule(project_values.page)]] = Field(
        default={},
        json_schema_extra={
            "patternProperties": {"^[1-9][0-9]{0,2}$": {"type": ["string", "integer"]}},
            "properties": {FINAL: {"type": ["string", "null"]}},
            "additionalProperties": False,
        },
    )
    """The study's steps in order: 1, 2, 3 … and finalStep, each a file of the steps folder or game."""
    cluster: Annotated[str, _one_of("installation", "participant")] = "installation"
    """One ECS cluster for the installation, or one for each participant as HIPPO has it."""
    subdomain: Annotated[str, _one_of("hash", "userId")] = "hash"
    """What a server is called: a hash (keeps ids private), or the userId as in HIPPO."""
    plain_clients: _Flag = False
    """Whether HIPPO's front end plays without a token: then who knows an id can play in that participant's place."""
    front_end: Annotated[
        tuple[Annotated[str, Rule(project_values.page_origin)], ...],
        _items("https:// address", 5, single=True),
        Field(json_schema_extra={"type": ["array", "string"]}),
    ] = ()
    """Where that front end is: https:// origins, or http:// ones of this machine. Needed with plainClients."""
    allowed_hosts: Annotated[
        tuple[Annotated[str, Rule(project_values.origin)], ...], _items("https:// address", 50)
    ] = ()
    """https:// origins from which step pages may load images, media and frames."""
    max_participants: Annotated[int, whole(1, 100_000)] | None = None
    """How many may take part; whoever comes later is told that the study is full. Default: no limit."""
    max_servers: Annotated[int, whole(1, 10_000)] | None = None
    """How many servers may run at once. Default: no limit."""
    max_server_hours: Annotated[int, whole(1, 1_000_000)] | None = None
    """Hours that all servers together may run. Default: no limit."""
    warm_servers: Annotated[int, whole(0, 100)] = 0
    """Servers that are started ahead and wait, so that participants need not. Each is paid for while it waits."""
    signed_links: _Flag = False
    """Whether only links that `deploy links` has signed are let in."""


class Root(Model):
    project: Project = Project()


SECTIONS: dict[Keys, type[Model]] = {
    ("project",): Project,
    ("project", "awsSetup"): AwsSetup,
    ("project", "events"): Events,
    ("project", "ssl"): Ssl,
}
TRIAL_SECTIONS: dict[Keys, type[Trial | Ui]] = {("trial",): Trial, ("trial", "ui"): Ui}
NAMES: dict[Keys, frozenset[str]] = {
    **{path: names(section) for path, section in TRIAL_SECTIONS.items()},
    **{path: model.names() for path, model in SECTIONS.items()},
    (): frozenset({"project", "trial"}),
}
"""The keys of each section, as they stand in the file."""
STEPS: Keys = ("project", "steps")
