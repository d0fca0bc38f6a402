"""Registered projects, and the master list of them (`project_master_list.json`). Pure."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Literal, NamedTuple

import msgspec

from hippodrome.control.model import design, hippo_entry, ids
from hippodrome.control.model.design import Assignment, Block, End, Factor, Step
from hippodrome.control.model.matching import MATCH
from hippodrome.control.model.records import Record, from_data, from_json, to_json
from hippodrome.protocol.loopback import is_loopback

MASTER_LIST = "project_master_list.json"
STEPS_FOLDER: Literal["steps"] = "steps"
GAME_PAGES = ("instructions", "betweenEpisodes")
"""The keys of `trial` that may name a page."""
DEFAULT_PORT = 5000  # HIPPO's port, for registrations that name none; also the trial's default
MIN_RUNTIME_MARGIN = 60  # minutes; with warmServers, the installation's maxRuntime is at least this plus the project's


class Events(Record, frozen=True):
    """The keys of the steps at which the participant's server is started and stopped."""

    start_server_step: str | None = None
    stop_server_step: str | None = None


class AwsSetup(Record, frozen=True):
    """Where servers run, and their size: `cpu` in vCPU, `memory` in GB."""

    bucket: str | None = None
    region: str | None = None
    root_domain: str | None = None
    cpu: float = 1
    memory: float = 2


class ForPlayers(Record, frozen=True):
    """The last registration for this number of players, before another number was registered.

    The fields are those of `Project`. Servers of sessions with this number still run it. For 1 player these are the
    servers that participants had of their own before several players were registered.
    """

    players: int
    trial: Mapping[str, Any] = msgspec.field(default_factory=dict)
    game_pages: Mapping[str, int] = msgspec.field(default_factory=dict)
    task_definition: str | None = None
    server_port: int = DEFAULT_PORT
    use_a_w_s: bool = msgspec.field(default=False, name="useAWS")
    aws_setup: AwsSetup | None = None


class Project(Record, frozen=True):
    """One entry of `project_master_list.json`."""

    id: str
    steps: list[Step]
    conditions: tuple[Factor, ...] = ()  # factors between people
    blocks: tuple[Block, ...] = ()  # of steps that are repeated for factors within people; on a path there are none
    ends: tuple[End, ...] = ()
    name: str = ""
    researcher: str = ""
    contact: str = ""  # how participants reach the researchers
    team_members: list[str] = msgspec.field(default_factory=list)
    live: bool = False
    max_runtime: int = 60  # minutes
    use_a_w_s: bool = msgspec.field(default=False, name="useAWS")
    aws_setup: AwsSetup | None = None
    events: Events = Events()
    cluster: str = "installation"
    subdomain: str = "hash"
    plain_clients: bool = False  # whether its front end opens servers without a token
    front_end: list[str] = msgspec.field(default_factory=list)  # the origins of that front end
    allowed_hosts: list[str] = msgspec.field(default_factory=list)
    record_headers: list[str] = msgspec.field(default_factory=list)  # those of a first request that are kept
    max_participants: int | None = None
    max_servers: int | None = None  # how many servers may run at once
    max_server_hours: int | None = None  # of all servers together, from the first registration on
    warm_servers: int = 0  # how many servers to keep started ahead of participants
    signed_links: bool = False
    players: int = 1  # participants of one session; 1: each participant has a server of their own
    matching: str | dict[str, str] = "arrival"  # who plays with whom: see `matching.py`
    seats: str = "lot"  # who plays which player: see `matching.py`
    patience: float = 300  # seconds in the lobby
    after_patience: str = "unmatched"  # or `policies`
    texts: Mapping[str, str] = msgspec.field(default_factory=dict)  # the study's own words, by the names in `texts.py`
    trial: Mapping[str, Any] = msgspec.field(default_factory=dict)
    task_definition: str | None = None
    server_port: int = DEFAULT_PORT  # on AWS; the task definition must open it
    game_pages: Mapping[str, int] = msgspec.field(default_factory=dict)
    """The number of variants of each page that the game page shows, by the key of `trial` that names the page."""
    page_folder: Literal["steps", ""] = STEPS_FOLDER
    """The folder of the pages below {id}/. HIPPO's script puts them into {id}/ itself, which is ""."""
    other_numbers: tuple[ForPlayers, ...] = ()  # the last registrations for other numbers of players
    version: str = ""  # random, new at each registration
    salt: str = ""  # made at the first registration. Not secret; the secret is derived from it (`secret.py`)
    secret: str = ""  # signs tickets, links, codes. Never stored: `SecretCache.with_secret` sets it

    @property
    def final(self) -> Step:
        """The last step of the study."""
        return self.steps[-1]

    @property
    def game_steps(self) -> list[str]:
        """The keys of the steps that are played on a server, whose trial stores their answers: of all runs."""
        return [step.key for step in self.all_runs if step.type.on_server]

    @property
    def read_steps(self) -> list[str]:
        """The keys of the steps whose answers agents may read (`answers` in `trial` and in games): of all runs."""
        sections = (self.trial, *(section.trial for step in self.steps for section in step.sections))
        names = {name for section in sections for name in section.get("answers", ())}
        return [step.key for step in self.all_runs if step.step_name in names]

    @property
    def all_runs(self) -> list[Step]:
        """The steps, with all runs of each block, also those that only some participants have."""
        whole = tuple(msgspec.structs.replace(block, take=None) for block in self.blocks)
        return design.own_steps(self.steps, whole, None) if whole else self.steps

    @property
    def assigns(self) -> bool:
        """Whether participants get an assignment: the study has factors, or a game with keys of `trial` of its own.

        A path has no blocks any more, but runs, which have a name.
        """
        return bool(self.conditions or self.blocks or any(step.sections or step.name for step in self.steps))

    @property
    def factors(self) -> object:
        """What participants are assigned to, to be compared: the names of factors and levels, and the orders."""

        def named(factors: Iterable[Factor]) -> list[tuple[str, list[str]]]:
            return [(factor.name, list(factor.levels)) for factor in factors]

        return named(self.conditions), [(named(block.factors), block.order, block.take) for block in self.blocks]

    def own(self, assignment: Assignment | None) -> Project:
        """Return the project with the path of a participant who has this assignment, or none yet."""
        if not self.assigns:
            return self
        steps = design.own_steps(self.steps, self.blocks, assignment)
        first = next((step.key for step in steps if step.step_name == self.events.start_server_step), None)
        events = msgspec.structs.replace(self.events, start_server_step=first)
        return msgspec.structs.replace(self, steps=steps, blocks=(), events=events)

    def at_game(self, step: Step, assignment: Assignment | None) -> Project:
        """Return the project with the section `trial` that this game has on the participant's path."""
        game = assignment.games.get(step.key) if assignment else None
        own_keys = game.trial if game else {}
        if not own_keys:
            return self
        variants = {key: number for key, number in self.game_pages.items() if key not in own_keys}
        return msgspec.structs.replace(self, trial={**self.trial, **own_keys}, game_pages=variants)

    @property
    def uses_llm(self) -> bool:
        """Whether a game of the study has a language model (`trial.llm`) elsewhere than on its server.

        Then its servers need the model's key.
        """
        own_sections = (section.trial for step in self.steps for section in step.sections)
        models = (trial.get("llm") for trial in (self.trial, *own_sections))
        return any(model and not is_loopback(str(model.get("url"))) for model in models)

    @property
    def pages_in_game(self) -> list[Step]:
        """The pages that game steps show, each as a `Step` with the key of `trial` that names the page."""
        pages = {key: self.trial.get(key) for key in GAME_PAGES} if self.game_steps else {}
        return [Step(key, page, self.game_pages.get(key, 0)) for key, page in pages.items() if isinstance(page, str)]

    @property
    def all_pages(self) -> list[Step]:
        """Every page that a participant may see, as a `Step` whose page has no `{factor}` any more."""
        at_levels = [page for step in self.all_runs for page in design.pages_of(step, self.conditions)]
        own = [
            Step(f"{step.key}.{key}", page)
            for step in self.steps
            for section in step.sections
            for key in GAME_PAGES
            if isinstance(page := section.trial.get(key), str)
        ]
        return [*at_levels, *self.pages_in_game, *own, *(Step(end.name, end.page) for end in self.ends if end.page)]

    @property
    def size(self) -> AwsSetup:
        return self.aws_setup or AwsSetup()

    @property
    def has_sessions(self) -> bool:
        """Whether several participants share a server."""
        return self.players > 1

    def following(self, before: Project | None) -> Project:
        """Return this registration, with the last registrations for other numbers of players.

        These are taken from `before`, the present registration, which this one replaces.
        """
        by_players = {other_number.players: other_number for other_number in (before.other_numbers if before else ())}
        if before is not None:
            by_players[before.players] = ForPlayers(
                **{name: getattr(before, name) for name in ForPlayers.__struct_fields__}
            )
        others = tuple(by_players[players] for players in sorted(by_players.keys() - {self.players}))
        return msgspec.structs.replace(self, other_numbers=others)

    def for_session(self, players: int) -> Project | None:
        """Return the project as it was registered last for sessions of this number of players.

        0 stands for the number that is registered now. The result is None if the number was never registered. The
        result for another number has no warm servers: they run only the present registration.
        """
        if players in (0, self.players):
            return self
        registration = next(
            (other_number for other_number in self.other_numbers if other_number.players == players), None
        )
        if registration is None:
            return None
        return msgspec.structs.replace(self, **msgspec.structs.asdict(registration), warm_servers=0)

    @property
    def asks_match(self) -> bool:
        """Whether the function `match` of agent.py says who plays with whom."""
        return self.has_sessions and self.matching == MATCH

    @property
    def groups(self) -> int:
        """How many groups of participants there are; 0 if there are none."""
        return number_of_groups(page.variants for page in (*self.steps, *self.pages_in_game))

    @property
    def limits_servers(self) -> bool:
        """Whether a server needs a slot before it starts."""
        return self.max_servers is not None or self.max_server_hours is not None

    def page_key(self, file: str) -> str:
        """Return the key of a step page; `file` is the page's name without `.html`."""
        return step_key(self.id, file, self.page_folder)

    def index(self, key: str | None) -> int | None:
        """Return the position of this step, from 0; None if the project has no such step."""
        return next((i for i, step in enumerate(self.steps) if step.key == key), None)

    def step(self, key: str | None) -> Step | None:
        """Return the step with this key, or the run of a step; None if the project has none."""
        return next((step for step in self.all_runs if step.key == key), None)

    def step_of_ticket(self, user_id: str, key: str | None, ticket: str | None, shown: str = "") -> Step | None:
        """Return the step with this key, if the ticket proves that this participant was shown that step; else None.

        `shown` is what the page's form says of its showing (`ids.ticket`).
        """
        step = self.step(key)
        proven = step and ticket and ids.secrets_equal(ticket, ids.ticket(self.secret, user_id, step.key, shown))
        return step if proven else None

    def group(self, user_id: str, step: Step | None = None) -> int | None:
        """Return the participant's group at this step, if the step has variants; otherwise their group in the study.

        The result is None if there are no groups.
        """
        variants = (step.variants if step else 0) or self.groups
        return ids.group(self.id, user_id, variants) if variants else None

    def file(self, user_id: str, step: Step) -> str:
        """Return the name of the step file that this participant sees, such as `consent-1`; `page` if it has no
        variants.
        """
        return f"{step.page}-{ids.group(self.id, user_id, step.variants)}" if step.variants else step.page


def number_of_groups(variants: Iterable[int]) -> int:
    """Return the number of groups of participants, given the number of variants of each page; 0 if no page has
    variants.
    """
    return max(variants, default=0)


class UnreadableEntry(NamedTuple):
    """An entry of the master list that cannot be read as a project."""

    raw: bytes  # the entry's JSON, unchanged
    id: str | None  # the project's id, if it is valid
    why: str  # the reason why it cannot be read


class MasterList(Record, frozen=True):
    """`project_master_list.json`, in HIPPO's form. An entry that cannot be read does not affect the others.

    `by_hippo`: the JSON of the entries that HIPPO wrote, by project id. It is written back unchanged; `projects` has
    their projects.
    """

    projects: list[Project] = msgspec.field(default_factory=list)
    unreadable: tuple[UnreadableEntry, ...] = ()
    by_hippo: Mapping[str, bytes] = msgspec.field(default_factory=dict)

    def find(self, project_id: str) -> Project | None:
        """Return the project with this id; None if the list has no entry of it that can be read."""
        return next((project for project in self.projects if project.id == project_id), None)

    def is_unreadable(self, project_id: str) -> bool:
        """Return whether this project has an entry that cannot be read, and none that can."""
        return self.find(project_id) is None and any(entry.id == project_id for entry in self.unreadable)

    def salt(self, project_id: str) -> str | None:
        """Return the project's salt, also from an entry that cannot be read; None if the project has no entry."""
        project = self.find(project_id)
        if project:
            return project.salt
        entries = (_as_object(entry.raw) for entry in self.unreadable if entry.id == project_id)
        return next((_string(entry, "salt") for entry in entries), None)

    def with_project(self, project: Project) -> MasterList:
        """Return the list with this project, which replaces any entry with its id, readable or not."""
        others = [p for p in self.projects if p.id != project.id]
        projects = sorted([*others, project], key=lambda p: p.id)
        unread = tuple(entry for entry in self.unreadable if entry.id != project.id)
        return MasterList(projects, unread, {key: raw for key, raw in self.by_hippo.items() if key != project.id})


class _MasterListDocument(Record, frozen=True):
    """The document, with its entries as raw JSON."""

    projects: list[msgspec.Raw] = msgspec.field(default_factory=list)


def read_list(body: bytes) -> MasterList:
    """Read the master list in a document. Raises ValueError if it is no list of entries."""
    projects: list[Project] = []
    unread: list[UnreadableEntry] = []
    others: list[bytes] = []  # HIPPO's entries. They are read last: of two entries with one id, ours counts
    for raw in map(bytes, from_json(body, _MasterListDocument).projects):
        try:
            projects.append(_checked(from_json(raw, Project)))
        except ValueError as error:
            if hippo_entry.is_from_hippo(_as_object(raw)):
                others.append(raw)
            else:
                unread.append(_unreadable(raw, error))
    by_hippo: dict[str, bytes] = {}
    for raw in others:
        try:
            project = _checked(from_data(hippo_entry.fields_of(_as_object(raw)), Project))
            if any(earlier.id == project.id for earlier in projects):
                raise ValueError("another entry has its id")
        except ValueError as error:
            unread.append(_unreadable(raw, error))
        else:
            projects.append(project)
            by_hippo[project.id] = raw
    return MasterList(projects, tuple(unread), by_hippo)


def _checked(project: Project) -> Project:
    """Return the project. Raises ValueError if it has no valid id or no steps."""
    if not ids.is_project_id(project.id) or not project.steps:
        raise ValueError("it has no steps" if project.steps == [] else "its id is not well formed")
    return project


def _unreadable(raw: bytes, error: Exception) -> UnreadableEntry:
    project_id = _as_object(raw).get("id")
    return UnreadableEntry(raw, project_id if ids.is_project_id(project_id) else None, str(error))


def write_list(listed: MasterList) -> bytes:
    """Return the master list as JSON. Entries that cannot be read, or that HIPPO wrote, are written back unchanged."""
    projects = [
        msgspec.Raw(listed.by_hippo.get(project.id) or msgspec.json.encode(project)) for project in listed.projects
    ]
    return to_json(_MasterListDocument([*projects, *(msgspec.Raw(entry.raw) for entry in listed.unreadable)]))


def _as_object(raw: bytes) -> Mapping[str, Any]:
    """An entry as a JSON object; empty if it is another value."""
    try:
        entry = msgspec.json.decode(raw)
    except (ValueError, RecursionError):
        return {}
    return entry if isinstance(entry, dict) else {}


def _string(entry: Mapping[str, Any], key: str) -> str:
    value = entry.get(key)
    return value if isinstance(value, str) else ""


def step_key(project_id: str, file: str, folder: str = STEPS_FOLDER) -> str:
    """Return the key of a step page; `file` is its name without `.html`, `folder` the project's `page_folder`."""
    return f"{project_id}/{folder}/{file}.html" if folder else f"{project_id}/{file}.html"
