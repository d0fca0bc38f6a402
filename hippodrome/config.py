"""A researcher's `config.yml`: read, checked in full, and turned into the registration that everything else works with.

    python -m hippodrome.config check [FOLDER]      print every mistake, in line order
    python -m hippodrome.config schema              print the JSON Schema, for editors

Three passes, so that all mistakes come at once: each value by itself (the models), values against each other
(`_relations`), and the step files. A value that fails is left out of the later passes.
"""

from __future__ import annotations

import argparse
import ast
import difflib
import inspect
import io
import itertools
import json
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    GetJsonSchemaHandler,
    ValidationError,
    model_validator,
)
from pydantic.alias_generators import to_camel
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, ErrorDetails, core_schema

from hippodrome import config_values as values
from hippodrome import fargate
from hippodrome.config_steps import StepFileError, open_folder
from hippodrome.config_values import FINAL, Check, Keys
from hippodrome.project import GAME

if TYPE_CHECKING:
    from hippodrome.config_lines import Document

NAMES = ("config.yml", "config.yaml")
MESSAGE = "message"  # the "file" of problems in a registration
LIMIT_VARIANTS = 1000


@dataclass(frozen=True, slots=True)
class Problem:
    """One mistake: the file's name, the line (None if there is none), the key ("" for the file), what to do."""

    file: str
    line: int | None
    where: str
    message: str

    def __str__(self) -> str:
        place = self.file if self.line is None else f"{self.file}:{self.line}"
        return f"{place}: {self.where}: {self.message}" if self.where else f"{place}: {self.message}"


class ConfigErrors(Exception):
    """Everything that is wrong with a configuration, in line order; str() has one line for each."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = list(problems)
        super().__init__(self.problems)

    def __str__(self) -> str:
        return "\n".join(str(problem) for problem in self.problems)


# --- the models: what each value may be by itself -------------------------------------------------


@dataclass(frozen=True, eq=False)  # equal only to itself, so that it can be hashed
class _Rule:
    """Validates a field by one of our checks, whose words the researcher then reads, and describes it to editors."""

    check: Check
    schema: Mapping[str, Any] = field(default_factory=lambda: {"type": "string"})

    def __get_pydantic_core_schema__(self, _source: object, _handler: object) -> CoreSchema:
        return core_schema.no_info_plain_validator_function(self.check)

    def __get_pydantic_json_schema__(self, _schema: CoreSchema, _handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        return dict(self.schema)


def _whole(low: int, high: int | None = None) -> _Rule:
    bounds = {"minimum": low} if high is None else {"minimum": low, "maximum": high}
    return _Rule(values.whole(low, high), {"type": "integer", **bounds})


def _one_of(*choices: str) -> _Rule:
    return _Rule(values.one_of(*choices), {"enum": list(choices)})


def _items(what: str, limit: int, single: bool = False) -> BeforeValidator:
    """Makes sure of a list of at most `limit` items; `single` takes one text for a list of one."""

    def check(value: object) -> list[object]:
        if single and isinstance(value, str | values.Plain):
            return [value]
        if not isinstance(value, list | tuple):
            raise ValueError(f"must be a list: a line with a dash for each {what}, not {values.show(value)}")
        if len(value) > limit:
            raise ValueError(f"must have at most {limit} items, not {len(value)}")
        return list(value)

    return BeforeValidator(check)


_Flag = Annotated[bool, _Rule(values.flag, {"type": "boolean"})]
_Text = Annotated[str, _Rule(values.text())]
_Bucket = Annotated[str, _Rule(values.bucket, {"type": "string", "pattern": "^[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]$"})]
_ObjectKey = Annotated[str, _Rule(values.object_key)]
_StepName = Annotated[str, _Rule(values.step_name, {"anyOf": [{"type": "integer", "minimum": 1}, {"const": FINAL}]})]
_FrameRate = Annotated[int, _whole(1, 240)]

_ODD_NAMES = {"use_aws": "useAWS", "s3upload": "s3upload"}


class _Model(BaseModel):
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


class AwsSetup(_Model):
    """Where a project lies in AWS, and how large its servers are."""

    bucket: _Bucket | None = None
    """S3 bucket that holds the project's pages and data."""
    region: Annotated[str, _Rule(values.region)] | None = None
    """AWS region, such as ca-central-1."""
    root_domain: Annotated[str, _Rule(values.domain)] | None = None
    """Domain below which each server gets its name; without https://."""
    cpu: Annotated[float, _Rule(values.cpu, {"enum": [int(n) if n >= 1 else n for n in fargate.SIZES]})] | None = None
    """vCPUs of each participant's server."""
    memory: Annotated[float, _Rule(values.memory, {"type": "number", "minimum": 0.5, "maximum": 120})] | None = None
    """Memory of each participant's server in GB; must fit cpu."""


class Events(_Model):
    """At which steps a participant's server starts and stops."""

    start_server_step: _StepName | None = None
    """The step whose reaching starts the server. Default 1 if there is a game step."""
    stop_server_step: _StepName | None = None
    """The step whose reaching stops the server. Default: the step after the last game step."""


class Ssl(_Model):
    """Where the servers fetch their certificate: three keys or none."""

    ssl_bucket: _Bucket | None = None
    """S3 bucket that holds the certificate."""
    fullchain: _ObjectKey | None = None
    """Path of fullchain.pem within sslBucket."""
    privkey: _ObjectKey | None = None
    """Path of privkey.pem within sslBucket."""


class Project(_Model):
    """Who runs the study, its steps, and where its servers run."""

    id: Annotated[str, _Rule(values.project_id, {"type": ["string", "integer"], "pattern": "^[A-Za-z0-9-]{1,64}$"})] = (
        ""
    )
    """The project's id: letters, digits and dashes; unique in your organization."""
    name: Annotated[str, _Rule(values.text("a name"))] = ""
    """A label for people. Default: the id."""
    researcher: _Text = ""
    """Who is responsible for the study."""
    team_members: Annotated[
        tuple[_Text, ...], _items("person", 200, single=True), Field(json_schema_extra={"type": ["array", "string"]})
    ] = ()
    """Others in the team: one name or a list."""
    live: _Flag = True
    """Whether participants can take part now."""
    max_runtime: Annotated[int, _whole(1, 1440)] = 60
    """Minutes after which a server is stopped, whatever happens."""
    use_aws: _Flag = False
    """Whether servers run on AWS; otherwise the study runs on one machine."""
    aws_setup: AwsSetup = AwsSetup()
    """Where on AWS; needed if useAWS is true."""
    events: Events = Events()
    """When the participant's server starts and stops."""
    ssl: Ssl = Ssl()
    """Where the servers' certificate is."""
    steps: dict[Annotated[str, _Rule(values.step_key)], Annotated[str, _Rule(values.page)]] = Field(
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
    allowed_hosts: Annotated[tuple[Annotated[str, _Rule(values.origin)], ...], _items("https:// address", 50)] = ()
    """https:// origins from which step pages may load images, media and frames."""


class Ui(_Model):
    """Which controls the game page shows. If the section is given, what it does not name is not shown."""

    left: _Flag = False
    right: _Flag = False
    up: _Flag = False
    down: _Flag = False
    start: _Flag = False
    stop: _Flag = False
    pause: _Flag = False
    reset: _Flag = False
    train_offline: _Flag = False
    train_online: _Flag = False
    good: _Flag = False
    bad: _Flag = False
    fps_set: _Flag = False
    fps_up: _Flag = False
    fps_down: _Flag = False


class Trial(_Model):
    """What happens on the participant's server."""

    action_buffer_lifespan: Annotated[int, _whole(1)] = 1
    """Environment steps for which an action stays in force unless another comes; 1 is no buffer."""
    max_episodes: Annotated[int, _whole(1)] = 20
    """Episodes until the trial is over."""
    game: Annotated[str, _Rule(values.text("the name of an environment"))] | None = None
    """Name of the environment, given to the agent's start(). Needed if there is a game step."""
    data_file: Annotated[str, _one_of("episode", "trial")] = "episode"
    """Whether a recording is written after each episode or once at the end of the trial."""
    s3upload: _Flag = True
    """Whether recordings are uploaded; otherwise they are lost with the server."""
    action_space: Annotated[
        tuple[Annotated[str, _Rule(values.text("the name of an action", 100))], ...], _items("action", 1000)
    ] = ()
    """Names of the actions, in the order of the environment's numbers."""
    allow_frame_rate_change: _Flag = False
    """Whether participants may change the frame rate."""
    frame_rate_step_size: _FrameRate = 5
    """Frames per second by which fpsUp and fpsDown change the rate."""
    min_frame_rate: _FrameRate = 1
    """Lowest rate, in frames per second."""
    max_frame_rate: _FrameRate = 90
    """Highest rate, in frames per second."""
    starting_frame_rate: _FrameRate = 30
    """Rate at which a trial starts, in frames per second."""
    ui: Ui = Ui(left=True, right=True, up=True, down=True, start=True, pause=True)
    """Controls on the game page. Default: left, right, up, down, start, pause."""
    record_observations: _Flag = False
    """Whether recordings hold the full observations, which can be large."""

    @model_validator(mode="before")
    @classmethod
    def _empty_ui_is_the_default(cls, data: object) -> object:
        if isinstance(data, dict) and data.get("ui") == {}:
            return {key: value for key, value in data.items() if key != "ui"}
        return data


class _Root(_Model):
    project: Project = Project()
    trial: Trial = Trial()


_SECTIONS: dict[Keys, type[_Model]] = {
    ("trial",): Trial,
    ("project",): Project,
    ("project", "awsSetup"): AwsSetup,
    ("project", "events"): Events,
    ("project", "ssl"): Ssl,
    ("trial", "ui"): Ui,
    (): _Root,
}
_STEPS: Keys = ("project", "steps")
_ENOUGH = 200  # mistakes after which unknown keys get no suggestions, which take time to find
_RIGHT, _MISSPELT = "allowFrameRateChange", "allowFramRateChange"  # HIPPO's documentation has the second


# --- the result -----------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class StepFiles:
    """One step: its key ("1" … or "finalStep"), its page (a file name without .html, or "game"), and its files.

    `variants` is 0 for one page for everybody, else the number of files `{page}-0.html`, `{page}-1.html` …
    """

    key: str
    page: str
    variants: int = 0
    files: tuple[Path, ...] = ()

    @property
    def game(self) -> bool:
        return self.page == GAME


@dataclass(frozen=True, slots=True)
class Config:
    """A project that is free of mistakes.

    `steps` are in order, the last one is where the study ends; `events` are resolved: keys of steps, or None.
    """

    project: Project
    trial: Trial
    steps: tuple[StepFiles, ...]
    events: Events

    def registration(self) -> dict[str, Any]:
        """The project for everybody else: a JSON-able dict in camelCase with every default filled in."""
        data = self.project.model_dump(mode="json", by_alias=True)
        return data | {
            "name": self.project.name or self.project.id,
            "awsSetup": _complete(self.project.aws_setup),
            "ssl": _complete(self.project.ssl),
            "events": self.events.model_dump(by_alias=True),
            "steps": [{"key": step.key, "page": step.page, "variants": step.variants} for step in self.steps],
            "trial": self.trial.model_dump(mode="json", by_alias=True),
        }

    def summary(self) -> str:
        """What the project is, in a line: "6 steps, step 4 is the game (CartPole-v1), …"."""
        parts = ["1 step" if len(self.steps) == 1 else f"{len(self.steps)} steps"]
        parts += [f"{_step(step.key)} is the game ({self.trial.game})" for step in self.steps if step.game]
        parts += [f"{step.page} in {step.variants} groups" for step in self.steps if step.variants]
        start, stop = self.events.start_server_step, self.events.stop_server_step
        if start and stop:
            parts.append(f"a server from {_step(start)} to {_step(stop)}, at most {self.project.max_runtime} minutes")
        if not self.project.live:
            parts.append("not live")
        return ", ".join(parts)


def _complete(section: AwsSetup | Ssl) -> dict[str, Any] | None:
    """The section if every key is given; a part of it is of no use to anybody."""
    data = section.model_dump(by_alias=True)
    if any(value is None for value in data.values()):
        return None
    return {key: int(v) if isinstance(v, float) and v.is_integer() else v for key, v in data.items()}


def _step(key: str) -> str:
    return key if key == FINAL else f"step {key}"


# --- first pass: each value by itself -------------------------------------------------------------


class _Finding(NamedTuple):
    """A mistake before it has a line: the path of keys, and what to do."""

    path: Keys
    message: str


@dataclass(slots=True)
class _Checked:
    """What the passes share: the good values, the keys of all steps, what was found, and where no more need be said."""

    root: _Root
    step_keys: list[str]
    has_project: bool
    findings: list[_Finding] = field(default_factory=list)
    spoilt: list[Keys] = field(default_factory=list)

    def sound(self, *paths: Keys) -> bool:
        """Whether nothing was found at, in or around these paths."""
        return not any(
            bad[: len(path)] == path or path[: len(bad)] == bad for bad, path in itertools.product(self.spoilt, paths)
        )


def _check(tree: dict[str, Any], spoilt: Iterable[Keys] = ()) -> _Checked:
    """Both passes that need no files, over a tree of sections. About what is `spoilt` already, no more is said."""
    tree = _copy(tree)
    early = list(_respell(tree))
    steps = _at(tree, _STEPS)
    keys = [key for key in steps if _is_step_key(key)] if isinstance(steps, dict) else []
    checked = _Checked(_Root(), _ordered(keys), "project" in tree, early, list(spoilt))
    while True:
        try:
            checked.root = _Root.model_validate(tree)
            break
        except ValidationError as error:
            _take(error.errors(include_url=False), checked, tree)
    checked.findings += _relations(checked)
    return checked


def _copy(tree: Any, depth: int = 5) -> Any:
    """A copy to change, no deeper than any good value is: a message can be nested without end."""
    if isinstance(tree, dict):
        return {str(key): _copy(value, depth - 1) for key, value in tree.items()} if depth else {}
    return [_copy(item, depth - 1) for item in tree] if isinstance(tree, list) and depth else tree


def _at(tree: Any, path: Keys) -> Any:
    for key in path:
        tree = tree.get(key) if isinstance(tree, dict) else None
    return tree


def _respell(tree: dict[str, Any]) -> Iterator[_Finding]:
    """Takes HIPPO's misspelt key for the right one, and a finalStep left empty for none."""
    trial, steps = tree.get("trial"), _at(tree, _STEPS)
    if isinstance(trial, dict) and _MISSPELT in trial:
        if trial.get(_RIGHT) is not None:
            yield _Finding(("trial", _MISSPELT), f"{_RIGHT} is given too; keep that one")
            trial.pop(_MISSPELT)
        else:
            trial[_RIGHT] = trial.pop(_MISSPELT)
    if isinstance(steps, dict) and steps.get(FINAL, "") in (None, ""):
        steps.pop(FINAL, None)


def _is_step_key(key: str) -> bool:
    try:
        return bool(values.step_key(key))
    except ValueError:
        return False


def _ordered(keys: Iterable[str]) -> list[str]:
    return sorted(keys, key=lambda key: (key == FINAL, 0 if key == FINAL else int(key)))


def _take(errors: Sequence[ErrorDetails], checked: _Checked, tree: dict[str, Any]) -> None:
    """Notes the errors in our words, and takes what they concern out of the tree."""
    for error in errors:
        path: Keys = error["loc"]
        if path[:2] == _STEPS:
            path = path[:3]  # pydantic adds a mark where a key, not its value, is wrong
        message = _words(error, path)
        if error["type"] == "extra_forbidden":
            message, meant = _unknown(path) if len(checked.findings) < _ENOUGH else ("unknown key", [])
            checked.spoilt += meant
        checked.findings.append(_Finding(path, message))
        checked.spoilt.append(path)
        _remove(tree, path)


def _remove(tree: Any, path: Keys) -> None:
    """Removes the value at `path`; for an item of a list, the list."""
    keys = list(itertools.takewhile(lambda key: isinstance(key, str), path))
    for key in keys[:-1]:
        tree = tree.get(key, {})
    tree.pop(keys[-1], None)


def _words(error: ErrorDetails, path: Keys) -> str:
    if "ctx" in error and isinstance(error["ctx"].get("error"), ValueError):
        return str(error["ctx"]["error"])
    model = _SECTIONS.get(path)
    example = "1: consent" if path == _STEPS else f"{min(model.names())}: …" if model else "key: value"
    return f'must be a section: indented lines such as "{example}" below it, not {values.show(error["input"])}'


def _unknown(path: Keys) -> tuple[str, list[Keys]]:
    """What to say about an unknown key, and the path it was meant for."""
    section, key = path[:-1], str(path[-1])
    homes = [home for home, model in _SECTIONS.items() if key in model.names()]
    if key == FINAL or key.isdecimal():
        homes = [_STEPS]
    if homes:
        home = homes[0]
        place = f"under {values.where_of(home)}" if home else "at the top of the file, not indented"
        return f"unknown key; it belongs {place} (check the indentation)", [(*home, key)]
    for home in (section, *_SECTIONS):
        names = {name.lower(): name for name in sorted(_SECTIONS[home].names())}
        near = difflib.get_close_matches(key.lower(), names, n=1, cutoff=0.6 if home == section else 0.8)
        if near:
            meant = (*home, names[near[0]])
            return f"unknown key; did you mean {meant[-1] if home == section else values.where_of(meant)}?", [meant]
    names_here = sorted(_SECTIONS[section].names())
    known = f"the keys here are {', '.join(names_here)}" if len(names_here) <= 5 else "docs/config.md lists all keys"
    return f"unknown key; {known}", []


# --- second pass: values against each other -------------------------------------------------------


def _relations(checked: _Checked) -> list[_Finding]:
    checks = (_missing, _aws, _ssl, _frame_rates, _actions, _step_numbers, _game_step, _event_steps)
    return [finding for check in checks for finding in check(checked)]


def _missing(checked: _Checked) -> Iterator[_Finding]:
    project = checked.root.project
    if not checked.has_project:
        if checked.sound(("project",)):
            yield _Finding((), "the section project is missing")
        return
    if not project.id and checked.sound(("project", "id")):
        yield _Finding(("project", "id"), "missing; give the project an id of letters, digits and dashes")
    if not checked.step_keys and checked.sound(_STEPS):
        yield _Finding(_STEPS, 'missing; list the pages in order, such as "1: consent"')
    has_game = GAME in project.steps.values()
    if has_game and not checked.root.trial.game and checked.sound(("trial", "game")):
        yield _Finding(("trial", "game"), "missing; a project with a game step needs the name of its environment")


_AWS_NEEDS = {
    "bucket": "the S3 bucket for pages and data",
    "region": "the AWS region, such as ca-central-1",
    "rootDomain": "the domain for the servers' names, such as example.org",
    "cpu": "the vCPUs of a server, such as 1",
    "memory": "the memory of a server in GB, such as 4",
}


def _aws(checked: _Checked) -> Iterator[_Finding]:
    setup = checked.root.project.aws_setup
    path: Keys = ("project", "awsSetup")
    if not checked.root.project.use_aws or not checked.sound(("project", "useAWS")):
        return
    for key, what in _AWS_NEEDS.items():
        if not setup.given(key) and checked.sound((*path, key)):
            yield _Finding((*path, key), f"missing; useAWS is true, so give {what}")
    if setup.cpu is not None and setup.memory is not None and not fargate.fits(setup.cpu, setup.memory):
        fitting = fargate.memory_choices(setup.cpu)
        yield _Finding((*path, "memory"), f"{setup.memory:g} GB do not go with cpu {setup.cpu:g}; choose {fitting}")


def _ssl(checked: _Checked) -> Iterator[_Finding]:
    """All of a certificate or nothing; only of interest on AWS."""
    ssl = checked.root.project.ssl
    if not checked.root.project.use_aws or not ssl.model_fields_set:
        return
    for key in ("sslBucket", "fullchain", "privkey"):
        if not ssl.given(key) and checked.sound(("project", "ssl", key)):
            yield _Finding(("project", "ssl", key), "missing; give sslBucket, fullchain and privkey, or none of them")


def _frame_rates(checked: _Checked) -> Iterator[_Finding]:
    trial = checked.root.trial
    rates = {
        "minFrameRate": trial.min_frame_rate,
        "startingFrameRate": trial.starting_frame_rate,
        "maxFrameRate": trial.max_frame_rate,
    }
    low, start, high = rates
    pairs = [(low, high)] if rates[low] > rates[high] else [(low, start), (start, high)]
    for lower, upper in pairs:
        if rates[lower] <= rates[upper] or not checked.sound(("trial", lower), ("trial", upper)):
            continue
        key = next(key for key in (start, low, high) if key in (lower, upper) and trial.given(key))
        other, bound = (upper, "most") if key == lower else (lower, "least")
        default = "" if trial.given(other) else " by default"
        hint = f"; set {other} too" if default else ""
        message = f"must be at {bound} {other}, which is {rates[other]}{default}, not {rates[key]}{hint}"
        yield _Finding(("trial", key), message)


def _actions(checked: _Checked) -> Iterator[_Finding]:
    path: Keys = ("trial", "actionSpace")
    first: dict[str, int] = {}
    for index, action in enumerate(checked.root.trial.action_space):
        if first.setdefault(action, index) != index and checked.sound(path):
            message = f"{values.show(action)} is item {first[action] + 1} already; names must differ"
            yield _Finding((*path, index), message)


def _keys_known(checked: _Checked) -> bool:
    """Whether there are steps, and all their keys are good."""
    spoilt = [path[2:] for path in checked.spoilt if path[:2] == _STEPS]
    return bool(checked.step_keys) and all(rest and rest[0] in checked.step_keys for rest in spoilt)


def _step_numbers(checked: _Checked) -> Iterator[_Finding]:
    if not _keys_known(checked):
        return
    numbers = [int(key) for key in checked.step_keys if key != FINAL]
    wanted = 1
    for number in numbers or [2]:
        if number > wanted:
            gap = f"step {wanted} is" if number == wanted + 1 else f"steps {wanted} to {number - 1} are"
            after = str(number) if numbers else FINAL
            yield _Finding((*_STEPS, after), f"{gap} missing before it; number the steps 1, 2, 3 … without gaps")
        wanted = number + 1


def _game_step(checked: _Checked) -> Iterator[_Finding]:
    if checked.step_keys and checked.root.project.steps.get(checked.step_keys[-1]) == GAME:
        path = (*_STEPS, checked.step_keys[-1])
        yield _Finding(path, "the game cannot be the last step; add a page after it, which stops the server")


def _event_steps(checked: _Checked) -> Iterator[_Finding]:
    steps, path = checked.root.project.steps, ("project", "events")
    if not _keys_known(checked):
        return
    keys = _walk(checked.step_keys, steps)
    places: dict[str, int | None] = {}
    events = checked.root.project.events.model_dump(by_alias=True)
    for name, key in events.items():
        places[name] = _place(key, keys)
        if key is not None and places[name] is None:
            yield _Finding((*path, name), f"there is no {_step(key)}; the steps are {_span(keys)}")
    start, stop = places.values()
    games = [place for place, key in enumerate(keys) if steps.get(key) == GAME]
    if start is not None and games and start > games[0]:
        yield _Finding(
            (*path, "startServerStep"),
            f"{_step(keys[start])} comes after the game, {_step(keys[games[0]])}, which needs the server; "
            "1 is the usual choice",
        )
    if stop is not None and games and stop <= games[-1]:
        after = f"{keys[games[-1] + 1]} or later" if games[-1] + 1 < len(keys) else "a step after it"
        yield _Finding(
            (*path, "stopServerStep"),
            f"{_step(keys[stop])} does not come after the game, {_step(keys[games[-1]])}, which needs the server; "
            f"use {after}",
        )
    if start is not None and stop is not None and stop < start and not games:
        message = f"{_step(keys[stop])} comes before startServerStep, {_step(keys[start])}"
        yield _Finding((*path, "stopServerStep"), message)


def _walk(keys: list[str], pages: Mapping[str, str]) -> list[str]:
    """The keys a participant walks through: finalStep only if it is another page than the last numbered step."""
    same = len(keys) > 1 and keys[-1] == FINAL and pages.get(FINAL) == pages.get(keys[-2])
    return keys[:-1] if same and FINAL in pages else keys


def _place(key: str | None, keys: list[str]) -> int | None:
    """Where a step stands; without a finalStep of its own, the last step is the final one."""
    if key == FINAL:
        return len(keys) - 1
    return keys.index(key) if key in keys else None


def _span(keys: list[str]) -> str:
    numbered = [key for key in keys if key != FINAL]
    words = f"{numbered[0]} to {numbered[-1]}" if len(numbered) > 1 else "".join(numbered)
    return words if numbered == keys else f"{words} and {FINAL}"


def _resolved(events: Events, keys: list[str], pages: Mapping[str, str]) -> Events:
    """The events with defaults, as keys of steps. The events have been checked."""
    start, stop = (_place(key, keys) for key in (events.start_server_step, events.stop_server_step))
    games = [place for place, key in enumerate(keys) if pages[key] == GAME]
    if games:
        start, stop = start or 0, games[-1] + 1 if stop is None else stop
    return Events.model_validate(
        {
            "startServerStep": None if start is None else keys[start],
            "stopServerStep": None if stop is None else keys[stop],
        }
    )


# --- reading --------------------------------------------------------------------------------------


def read_project(folder: Path) -> Config:
    """The project in `folder`: its config.yml (or config.yaml) and its step files, in `steps` or `StepFiles`.

    Raises ConfigErrors with every mistake found.
    """
    folder = Path(folder)
    file = _config_file(folder)
    document = _read(file)
    checked = _check(document.tree, [mistake.path for mistake in document.mistakes])
    steps, missing_files = _step_files(folder, checked)
    findings = checked.findings + missing_files
    if ("trial", _MISSPELT) in document.lines:
        document.lines.setdefault(("trial", _RIGHT), document.lines["trial", _MISSPELT])
    problems = [Problem(file.name, document.line(path), values.where_of(path), text) for path, text in findings]
    problems += [Problem(file.name, m.line, values.where_of(m.path), m.message) for m in document.mistakes]
    if problems:
        raise ConfigErrors(_sorted(problems))
    return _config(checked, steps)


def _config_file(folder: Path) -> Path:
    try:
        found = [folder / name for name in NAMES if (folder / name).is_file()]
    except (OSError, ValueError):
        found = []
    if len(found) > 1:
        raise ConfigErrors([Problem(NAMES[0], None, "", f"there is a {NAMES[1]} too; keep only one of them")])
    if not found:
        raise ConfigErrors([Problem(NAMES[0], None, "", f"there is no such file in {folder}")])
    return found[0]


def _read(file: Path) -> Document:
    from hippodrome import config_lines  # noqa: PLC0415 - a function that only parses registrations needs no YAML

    try:
        with file.open("rb") as stream:
            return config_lines.read_yaml(stream.read(config_lines.LIMIT_BYTES + 1))
    except config_lines.NotYaml as error:
        raise ConfigErrors([Problem(file.name, error.line, "", str(error))]) from None
    except OSError as error:
        message = f"the file cannot be read: {error.strerror or 'unknown reason'}"
        raise ConfigErrors([Problem(file.name, None, "", message)]) from None


def _step_files(folder: Path, checked: _Checked) -> tuple[list[StepFiles], list[_Finding]]:
    """The steps with their files, and what is wrong with files."""
    pages = checked.root.project.steps
    steps: list[StepFiles] = []
    findings: list[_Finding] = []
    try:
        pages_folder = open_folder(folder)
    except StepFileError as error:
        needed = any(page != GAME for page in pages.values())
        return [], [_Finding(_STEPS, str(error))] if needed else []
    for key in _walk(_ordered(pages), pages):
        page = pages[key]
        try:
            variants, files = (0, ()) if page == GAME else pages_folder.find(page)
            steps.append(StepFiles(key, page, variants, files))
        except StepFileError as error:
            findings.append(_Finding((*_STEPS, key), str(error)))
    return steps, findings


def _config(checked: _Checked, steps: list[StepFiles]) -> Config:
    project = checked.root.project
    events = _resolved(project.events, [step.key for step in steps], project.steps)
    return Config(project, checked.root.trial, tuple(steps), events)


def _sorted(problems: Iterable[Problem]) -> list[Problem]:
    return sorted(dict.fromkeys(problems), key=lambda problem: problem.line or 0)


# --- registrations --------------------------------------------------------------------------------


class _MessageStep(_Model):
    key: Annotated[str, _Rule(values.step_key)] = ""
    page: Annotated[str, _Rule(values.page)] = ""
    variants: Annotated[int, _whole(0, LIMIT_VARIANTS)] = 0


def parse_registration(data: object) -> dict[str, Any]:
    """A registration from outside, checked as if it were a config.yml, with defaults filled in.

    Raises ConfigErrors whose file is "message".
    """
    if not isinstance(data, dict):
        raise ConfigErrors([Problem(MESSAGE, None, "", "a registration must be a JSON object")])
    steps, findings = _message_steps(data.get("steps"))
    project = {key: value for key, value in data.items() if key not in ("trial", "steps")}
    if not findings:
        project["steps"] = {step.key: step.page for step in steps}
    checked = _check({"project": project, "trial": data.get("trial")})
    if findings:
        checked.findings = [finding for finding in checked.findings if finding.path[:2] != _STEPS] + findings
    if checked.findings:
        order = {step.key: index for index, step in enumerate(steps)}
        raise ConfigErrors(_sorted(_message_problem(finding, order) for finding in checked.findings))
    kept = _walk(checked.step_keys, checked.root.project.steps)
    return _config(checked, [StepFiles(s.key, s.page, s.variants) for s in steps if s.key in kept]).registration()


def _message_problem(finding: _Finding, order: Mapping[str, int]) -> Problem:
    path = finding.path[1:] if finding.path[:1] == ("project",) else finding.path
    if path[:1] == ("steps",) and len(path) > 1 and path[1] in order:
        path = ("steps", order[str(path[1])], *path[2:])
    return Problem(MESSAGE, None, values.where_of(path), finding.message)


def _message_steps(data: object) -> tuple[list[_MessageStep], list[_Finding]]:
    """The steps of a registration, each by itself; and that they are in order."""
    if not isinstance(data, list) or not data or len(data) > values.MAX_STEPS + 1:
        return [], [_Finding(_STEPS, f"must be a list of 1 to {values.MAX_STEPS} steps")]
    steps: list[_MessageStep] = []
    findings: list[_Finding] = []
    for index, item in enumerate(data):
        path = (*_STEPS, index)
        try:
            step = _MessageStep.model_validate(item)
        except ValidationError as error:
            for detail in error.errors(include_url=False):
                message = "unknown key" if detail["type"] == "extra_forbidden" else _words(detail, path)
                findings.append(_Finding((*path, *detail["loc"]), message))
            continue
        if not step.key or not step.page or (step.page == GAME and step.variants):
            findings.append(_Finding(path, "must have key and page, and variants only if it is no game step"))
        steps.append(step)
    keys = [step.key for step in steps]
    if not findings and keys != _ordered(set(keys)):
        findings.append(_Finding(_STEPS, f"must be in order, 1, 2, 3 … and perhaps {FINAL}, each once"))
    return steps, findings


# --- the schema and the command line --------------------------------------------------------------


def config_schema() -> dict[str, Any]:
    """A JSON Schema (2020-12) of config.yml for editors: names, types and bounds, each key by itself."""
    schema = _Root.model_json_schema()
    definitions = schema["$defs"]
    trial = definitions["Trial"]["properties"]
    trial[_MISSPELT] = {**trial[_RIGHT], "deprecated": True}
    definitions["Project"]["required"] = ["id", "steps"]
    schema |= {"title": "A Hippodrome project: config.yml", "required": ["project"]}
    meanings = _meanings()
    for name, section in ((_Root.__name__, schema), *definitions.items()):
        needed = section.get("required", ())
        section["properties"] = {
            key: meanings.get((name, key), {}) | _for_editors(prop, key in needed)
            for key, prop in section["properties"].items()
        }
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema


def _for_editors(prop: dict[str, Any], required: bool) -> dict[str, Any]:
    """The property as an editor should see it; unless required, it may be left empty: the same as not given."""
    about = {key: prop[key] for key in ("default", "deprecated") if key in prop}
    if about.get("default") in (None, "", {}) or "$ref" in prop:
        about.pop("default", None)
    kind = {key: value for key, value in prop.items() if key not in ("title", "default", "deprecated")}
    if required or {"type": "null"} in kind.get("anyOf", []):
        return about | kind
    return about | {"anyOf": [kind, {"type": "null"}]}


def _meanings() -> dict[tuple[str, str], dict[str, str]]:
    """What is written below each field, by model and key. Read here, because reading it at import would cost 0.1 s."""
    found = {(Trial.__name__, _MISSPELT): {"description": f"HIPPO's spelling of {_RIGHT}."}}
    for model in _SECTIONS.values():
        definition = ast.parse(inspect.getsource(model)).body[0]
        for node, below in itertools.pairwise(ast.iter_child_nodes(definition)):
            match node, below:
                case ast.AnnAssign(target=ast.Name(id=name)), ast.Expr(value=ast.Constant(value=str(meaning))):
                    found[model.__name__, model.model_fields[name].alias or name] = {"description": meaning}
    return found


def main(arguments: Sequence[str] | None = None) -> int:
    """The command line. Returns the exit status: 1 if there are mistakes."""
    parser = argparse.ArgumentParser(prog="python -m hippodrome.config", description="Check a project's config.yml.")
    commands = parser.add_subparsers(dest="command", required=True)
    check = commands.add_parser("check", help="print every mistake in a project folder")
    check.add_argument("folder", nargs="?", default=".", type=Path, help="the project's folder (default: this one)")
    commands.add_parser("schema", help="print the JSON Schema for editors")
    chosen = parser.parse_args(arguments)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")  # a console that lacks a character must not hide the mistake
    if chosen.command == "schema":
        sys.stdout.write(json.dumps(config_schema(), indent=2, ensure_ascii=False) + "\n")
        return 0
    try:
        config = read_project(chosen.folder)
    except ConfigErrors as errors:
        sys.stdout.write(f"{errors}\n")
        return 1
    sys.stdout.write(f"{_config_file(chosen.folder).name} is fine: {config.summary()}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
