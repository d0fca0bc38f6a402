"""A registered project as the functions see it: its steps in order, what happens where, who sees which page."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec

from hippodrome.model import ids
from hippodrome.model.records import Record, from_json, to_json
from hippodrome.model.step_types import StepType, type_of

LEGACY_PORT = 5000  # where servers listen if their registration names no port: those of before it could
MIN_WARM_WAIT = 60  # minutes at least between maxRuntime and that of the installation, if servers are kept warm


class Step(Record, frozen=True):
    """One step of the study. `page` is a step file without `.html`, or `game`; `variants` counts `{page}-0.html` …"""

    key: str
    page: str
    variants: int = 0

    @property
    def type(self) -> StepType:
        return type_of(self.page)


class Events(Record, frozen=True):
    """The steps whose reaching starts and stops the participant's server."""

    start_server_step: str | None = None
    stop_server_step: str | None = None


class AwsSetup(Record, frozen=True):
    """Where and how large the servers are: `cpu` in vCPU, `memory` in GB."""

    bucket: str | None = None
    region: str | None = None
    root_domain: str | None = None
    cpu: float = 1
    memory: float = 2


class Ssl(Record, frozen=True):
    """Where a server fetches its certificate: keys in a bucket."""

    ssl_bucket: str | None = None
    fullchain: str | None = None
    privkey: str | None = None


class Project(Record, frozen=True):
    """One entry of `project_master_list.json`."""

    id: str
    steps: list[Step]
    name: str = ""
    researcher: str = ""
    team_members: list[str] = msgspec.field(default_factory=list)
    live: bool = False
    max_runtime: int = 60  # minutes
    use_a_w_s: bool = msgspec.field(default=False, name="useAWS")
    aws_setup: AwsSetup | None = None
    ssl: Ssl | None = None
    events: Events = Events()
    cluster: str = "installation"
    subdomain: str = "hash"
    allowed_hosts: list[str] = msgspec.field(default_factory=list)
    max_participants: int | None = None
    max_servers: int | None = None  # at once
    max_server_hours: int | None = None  # of all servers together
    warm_servers: int = 0  # started ahead of participants, so that those who come need not wait
    signed_links: bool = False
    trial: Mapping[str, Any] = msgspec.field(default_factory=dict)
    task_definition: str | None = None
    server_port: int = LEGACY_PORT  # on AWS; it goes with the task definition, which must let servers listen there
    version: str = ""  # another one at each registration
    salt: str = ""  # made at the first registration; no secret, but the secret is derived from it (`secret.py`)
    secret: str = ""  # signs tickets, links and codes. `Secrets.with_secret` fills it in; earlier versions kept it here

    @property
    def final(self) -> Step:
        """The step where the study ends."""
        return self.steps[-1]

    @property
    def game_steps(self) -> list[str]:
        """The steps that take place on the participant's server, whose trial answers them."""
        return [step.key for step in self.steps if step.type.on_server]

    @property
    def size(self) -> AwsSetup:
        return self.aws_setup or AwsSetup()

    @property
    def limits_servers(self) -> bool:
        """Whether a server needs a place before it starts."""
        return self.max_servers is not None or self.max_server_hours is not None

    def index(self, key: str) -> int | None:
        """Where the step stands, from 0; None if the project has no such step."""
        return next((i for i, step in enumerate(self.steps) if step.key == key), None)

    def step(self, key: str | None) -> Step | None:
        """The step with this key; None if the project has no such step."""
        return next((step for step in self.steps if step.key == key), None)

    def step_of_ticket(self, user_id: str, key: str | None, ticket: str | None) -> Step | None:
        """The step that a ticket proves we showed this participant; None if it proves nothing."""
        step = self.step(key)
        proven = step and ticket and ids.secrets_equal(ticket, ids.ticket(self.secret, user_id, step.key))
        return step if proven else None

    def group(self, user_id: str, step: Step | None = None) -> int | None:
        """The participant's group: at a step with variants the one shown there, else the study's; None if no groups."""
        variants = (step.variants if step else 0) or max((s.variants for s in self.steps), default=0)
        return ids.group(self.id, user_id, variants) if variants else None

    def file(self, user_id: str, step: Step) -> str:
        """The step file this participant sees, such as `consent-1`; without variants, the page itself."""
        return f"{step.page}-{ids.group(self.id, user_id, step.variants)}" if step.variants else step.page


class UnreadableEntry(NamedTuple):
    """An entry of the master list that is no project: its JSON as it stands there, and what is wrong with it."""

    raw: bytes
    id: str | None  # the project's, if it says a well-formed one
    why: str


class MasterList(Record, frozen=True):
    """`project_master_list.json`, in HIPPO's shape. One entry that cannot be read takes nothing from the others."""

    projects: list[Project] = msgspec.field(default_factory=list)
    unreadable: tuple[UnreadableEntry, ...] = ()

    def find(self, project_id: str) -> Project | None:
        return next((project for project in self.projects if project.id == project_id), None)

    def is_unreadable(self, project_id: str) -> bool:
        """Whether this project has an entry, and it is no project."""
        return self.find(project_id) is None and any(entry.id == project_id for entry in self.unreadable)

    def salt(self, project_id: str) -> str | None:
        """What the project's secret is derived from, also of an entry that cannot be read; None if it has none."""
        found = self.find(project_id)
        if found:
            return found.salt
        entries = (_as_object(entry.raw) for entry in self.unreadable if entry.id == project_id)
        return next((_string(entry, "salt") for entry in entries), None)

    def secrets(self) -> dict[str, str]:
        """The secrets that an earlier version wrote into entries, also into those that cannot be read, by project."""
        unread = {entry.id: _string(_as_object(entry.raw), "secret") for entry in self.unreadable if entry.id}
        known = unread | {project.id: project.secret for project in self.projects}
        return {project_id: secret for project_id, secret in known.items() if secret}

    def without_secrets(self) -> MasterList:
        """The list as it is kept: whoever may read it learns no secret."""
        projects = [msgspec.structs.replace(project, secret="") for project in self.projects]
        return MasterList(projects, tuple(entry._replace(raw=_without_secret(entry.raw)) for entry in self.unreadable))

    def with_project(self, project: Project) -> MasterList:
        """The list with this project added, or in the place of the one with its id, be that readable or not."""
        others = [p for p in self.projects if p.id != project.id]
        projects = sorted([*others, project], key=lambda p: p.id)
        return MasterList(projects, tuple(entry for entry in self.unreadable if entry.id != project.id))


class _MasterListDocument(Record, frozen=True):
    """The document: entries as they stand there."""

    projects: list[msgspec.Raw] = msgspec.field(default_factory=list)


def read_list(body: bytes) -> MasterList:
    """The master list in a document. Raises ValueError or RecursionError if it is no list of anything."""
    projects: list[Project] = []
    unread: list[UnreadableEntry] = []
    for raw in from_json(body, _MasterListDocument).projects:
        try:
            project = msgspec.json.decode(raw, type=Project)
            if not ids.is_project_id(project.id) or not project.steps:
                raise ValueError("it has no steps" if project.steps == [] else "its id is not well formed")
        except (ValueError, RecursionError) as error:
            named = _as_object(raw).get("id")
            unread.append(UnreadableEntry(bytes(raw), named if ids.is_project_id(named) else None, str(error)))
        else:
            projects.append(project)
    return MasterList(projects, tuple(unread))


def write_list(listed: MasterList) -> bytes:
    """The master list as a document; what cannot be read stands in it as it stood."""
    projects = [msgspec.Raw(msgspec.json.encode(project)) for project in listed.projects]
    return to_json(_MasterListDocument([*projects, *(msgspec.Raw(entry.raw) for entry in listed.unreadable)]))


def _as_object(raw: bytes) -> Mapping[str, Any]:
    """What an entry says, whatever it is."""
    try:
        entry = msgspec.json.decode(raw)
    except (ValueError, RecursionError):
        return {}
    return entry if isinstance(entry, dict) else {}


def _string(entry: Mapping[str, Any], key: str) -> str:
    found = entry.get(key)
    return found if isinstance(found, str) else ""


def _without_secret(raw: bytes) -> bytes:
    """An entry that cannot be read, as it stands but for a secret that an earlier version wrote into it."""
    if not _string(_as_object(raw), "secret"):
        return raw
    entry = msgspec.json.decode(raw, type=dict[str, msgspec.Raw])
    return msgspec.json.encode({key: value for key, value in entry.items() if key != "secret"})


MASTER_LIST = "project_master_list.json"


def step_key(project_id: str, file: str) -> str:
    """Where a step page lies."""
    return f"{project_id}/steps/{file}.html"
