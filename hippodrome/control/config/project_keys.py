"""The section `project` of config.yml: the check, the default and the meaning of each key.

First come the checks of single values, then the keys. A check accepts a value of any type: texts, `Plain` values from
YAML, and JSON values. It returns the value, or raises ValueError with what to write instead.
`hippodrome/protocol/values.py` has the checks that other sections use, too. `hippodrome/protocol/trial.py` has the keys
of `trial`, because servers also check them.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from hippodrome.control.config import fargate
from hippodrome.control.model import ids, step_types
from hippodrome.control.model.matching import MATCHED_BY, MATCHINGS, SEATS
from hippodrome.control.model.step_order import FINAL
from hippodrome.control.model.texts import ENGLISH
from hippodrome.protocol import section_keys as keyed
from hippodrome.protocol import values
from hippodrome.protocol.section_keys import Section
from hippodrome.protocol.session import MAX_PLAYERS
from hippodrome.protocol.similar import did_you_mean
from hippodrome.protocol.trial import TrialSection
from hippodrome.protocol.values import KeyPath, Plain, SectionProblem, as_text, is_blank, number_in, show, step_file

MAX_STEPS = 500
MAX_HOSTS = 50
"""Origins in `allowedHosts`."""
MAX_HEADERS = 20
"""Names in `recordHeaders`."""
MAX_TEXT = 500  # characters

_LABEL = r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?"
_DOMAIN = re.compile(rf"({_LABEL}\.)+(?![0-9]+$){_LABEL}", re.IGNORECASE)
_ORIGIN = re.compile(rf"https://(?P<host>(({_LABEL}\.)+(?![0-9]+(:|$)){_LABEL}|localhost))(:[0-9]{{1,5}})?")
_HERE = re.compile(rf"http://(({_LABEL}\.)*localhost|127\.0\.0\.1)(:[0-9]{{1,5}})?")
_REGION = re.compile(r"[a-z]{2,4}(-[a-z]+){1,2}-[0-9]{1,2}")
_HEADER = re.compile(r"[a-z0-9-]{1,64}")
_SECRET_HEADERS = ("authorization", "cookie", "proxy-authorization")
_STEP_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_]{0,31}")
_STEP_NUMBER = re.compile(r"[1-9][0-9]{0,2}")
_CERTIFICATES = "SSL"  # servers may not write into this folder (infra/template.yml), so a study there keeps no answers
_DNS_ROOM = 253 - 64  # characters of a DNS name without the server's own label and its dot


def header(value: object) -> str:
    """Check the name of a request's header. Headers that hold secrets are refused."""
    name = as_text(value, "the name of a header, such as user-agent").lower()
    if not _HEADER.fullmatch(name):
        raise ValueError(f"must be the name of a header, such as user-agent, not {show(value)}")
    if name in _SECRET_HEADERS:
        raise ValueError(f"{name} may hold secrets of the browser, and is never kept")
    return name


def project_id(value: object) -> str:
    """Check a project's id: 1 to 64 letters, digits, dashes and underscores, with no underscore at the beginning."""
    found = as_text(value, "letters, digits, dashes and underscores")
    if found == _CERTIFICATES:
        raise ValueError(f"must not be {found}: that is the folder of the servers' certificate in the bucket")
    if ids.is_project_id(found):
        return found
    if len(found) > 64:
        raise ValueError(f"must be at most 64 characters long, not {len(found)}")
    better = re.sub(r"[^A-Za-z0-9_]+", "-", found).strip("-_")
    hint = f'; write for example "{better}"' if better else ""
    if found.startswith("_"):
        raise ValueError(f"must not begin with an underscore{hint}")
    raise ValueError(f"may hold only letters, digits, dashes and underscores, not {show(found)}{hint}")


def region(value: object) -> str:
    """Check the code of an AWS region."""
    found = as_text(value, "an AWS region such as ca-central-1")
    if _REGION.fullmatch(found):
        return found
    if _REGION.fullmatch(found[:-1]) and found[-1:].isalpha():
        raise ValueError(f"{found} is an availability zone; the region is {found[:-1]}")
    raise ValueError(f"must be an AWS region such as ca-central-1, not {show(found)}")


def domain(value: object) -> str:
    """Check a DNS name of at least two labels, and return it in small letters."""
    found = as_text(value, "a domain name such as example.org")
    name = found.lower().rstrip(".")
    if _DOMAIN.fullmatch(name) and len(name) <= _DNS_ROOM and name == found.lower():
        return name
    bare = re.sub(r"^[a-z]+://", "", name).split("/")[0].split(":")[0].rstrip(".")
    if bare != found and _DOMAIN.fullmatch(bare):
        raise ValueError(f"must be the domain name only, without https:// or a path; write {bare}")
    if len(name) > _DNS_ROOM:
        raise ValueError(f"must be at most {_DNS_ROOM} characters, so that the servers' names fit in front")
    raise ValueError(f"must be a domain name such as example.org, not {show(found)}")


def origin(value: object) -> str:
    """Check an https origin: https://name, perhaps with a port, without a path and without a wildcard."""
    found = as_text(value, "an address such as https://example.org")
    whole_match = _ORIGIN.fullmatch(found.lower())
    if whole_match and len(whole_match["host"]) <= 253:
        return found.lower()
    if _ORIGIN.fullmatch("https://" + found.lower()):
        raise ValueError(f"must begin with https://; write https://{found.lower()}")
    start = _ORIGIN.match(found.lower())
    if start and found[start.end() : start.end() + 1] in {"/", "?", "#"}:
        raise ValueError(f"must be the host only, without a path; write {start[0]}")
    raise ValueError(f"must be an address such as https://example.org, without path and without *, not {show(found)}")


def page_origin(value: object) -> str:
    """Check the origin of a front end's pages, and return it as browsers write it.

    It is an https origin, or an http origin of this machine (localhost, a name below it, 127.0.0.1).
    """
    found = as_text(value, "an address such as https://play.example.org").lower()
    if _HERE.fullmatch(found):
        return found.removesuffix(":80")
    return origin(value).removesuffix(":443")


def step_key(value: object) -> str:
    """Check a key of `steps`: a number from 1, or finalStep."""
    found = value.text if isinstance(value, Plain) else value
    if isinstance(found, str) and (found == FINAL or (_STEP_NUMBER.fullmatch(found) and int(found) <= MAX_STEPS)):
        return found
    if isinstance(found, str) and found.lower().replace("_", "") == FINAL.lower():
        raise ValueError(f"write {FINAL}")
    if isinstance(found, str) and found.isdecimal() and len(found) < 18 and int(found) > MAX_STEPS:
        raise ValueError(f"a project has at most {MAX_STEPS} steps")
    raise ValueError(f"a step's key is 1, 2, 3 … or {FINAL}")


def any_step_key(value: object) -> str:
    """Check the key of a step in a registration: a number from 1, finalStep, or a name."""
    return value if isinstance(value, str) and _STEP_NAME.fullmatch(value) else step_key(value)


def designed_page(value: object) -> str:
    """Check the page of a step in a registration, which may hold `{factor}`."""
    if isinstance(value, str) and "{" in value:
        step_file(re.sub(r"\{[A-Za-z]\w*\}", "x", value))
        return value
    return page(value)


def step_name(value: object) -> str:
    """Check the step that an event names: a number, finalStep, or the name of a step."""
    if isinstance(value, str) and (value.strip() == FINAL or _STEP_NAME.fullmatch(value.strip())):
        return value.strip()
    found = number_in(value)
    if found is None or found != int(found) or not 0 < found <= MAX_STEPS + 1:
        raise ValueError(f"must be the number of a step or {FINAL}, not {show(value)}")
    return str(int(found))


def page(value: object) -> str:
    """Check the page of a step, and return its file without `.html`, or the type of a step such as `game`."""
    if values.is_blank(value):
        raise ValueError(f"has no page; write the name of its file, or {step_types.NAMES}")
    found = as_text(value, f"the name of a file, or {step_types.NAMES}")
    stem = step_file(found)
    if stem in step_types.RESERVED and found != stem:
        raise ValueError(f"a page cannot be called {stem}.html; write {stem} for the {stem} step, or rename the page")
    return stem


def steps_by_number(value: Mapping[str, object], path: KeyPath) -> tuple[dict[str, str], list[SectionProblem]]:
    """Check the map `steps`. Returns the page by the key of the step, and the problems. An empty finalStep is none."""
    there = {key: name for key, name in value.items() if key != FINAL or not is_blank(name)}
    return keyed.map_of(step_key, page)(there, path)


def who_with_whom(value: object) -> str | dict[str, str]:
    """Check `matching`: one of `MATCHINGS`, or a map such as {same: language}, which names a field of an earlier page.

    Raises ValueError with what to write instead.
    """
    if not isinstance(value, dict):
        if isinstance(value, str) and value.strip() in MATCHINGS:
            return value.strip()
        choices = [*MATCHINGS, *(f"{{{how}: field}}" for how in MATCHED_BY)]
        raise ValueError(f"must be {' or '.join(choices)}, not {values.show(value)}")
    if len(value) != 1 or next(iter(value)) not in MATCHED_BY:
        raise ValueError("must name one field, such as {same: language} or {different: role}")
    how, field = next(iter(value.items()))
    return {str(how): str(values.text("the name of a field of an earlier page", 64)(field))}


def text_name(value: object) -> str:
    """Check the name of one of Hippodrome's texts (`hippodrome/control/model/texts.py`). Raises ValueError."""
    if isinstance(value, str) and value in ENGLISH:
        return value
    raise ValueError(f"unknown text{did_you_mean(str(value), ENGLISH) or '; docs/texts.md lists all'}")


def own_text(value: object) -> str:
    """Check a study's own words for a text; "" stands for Hippodrome's English ones."""
    return "" if values.is_blank(value) else str(_OWN_TEXT(value))


_OWN_TEXT = values.text('text, in quotes: "…"', MAX_TEXT)
_MATCHING: dict[str, object] = {
    "anyOf": [
        {"enum": list(MATCHINGS)},
        *({"properties": {how: {"type": "string"}}, "required": [how], "type": "object"} for how in MATCHED_BY),
    ]
}


def _step(meaning: str) -> Any:
    return keyed.key(step_name, None, meaning, {"anyOf": [{"minimum": 1, "type": "integer"}, {"const": FINAL}]})


def _apart(_value: object) -> dict[str, Any]:
    """Leave a key to `config/design.py`, which reads it."""
    return {}


_LEVELS: dict[str, Any] = {"anyOf": [{"type": "array"}, {"type": "integer", "minimum": 2}, {"type": "object"}]}
_FACTORS: dict[str, Any] = {"type": "object", "additionalProperties": _LEVELS}
_NUMBERED: dict[str, Any] = {
    "additionalProperties": False,
    "patternProperties": {"^[1-9][0-9]{0,2}$": {"type": ["string", "integer"]}},
    "properties": {FINAL: {"type": ["string", "null"]}},
    "type": "object",
}
_BLOCK: dict[str, Any] = {
    "type": "object",
    "required": ["each", "steps"],
    "properties": {
        "each": _FACTORS,
        "order": {"enum": ["latin", "random", "fixed"]},
        "take": {"type": "integer", "minimum": 1},
        "steps": {"type": "array", "items": {"type": ["string", "object"]}},
    },
    "additionalProperties": False,
}
_NAMED_STEP: dict[str, Any] = {"type": "object", "minProperties": 1, "maxProperties": 1}
_NAMED: dict[str, Any] = {"type": "array", "items": {"anyOf": [{"type": "string"}, _NAMED_STEP, _BLOCK]}}


@dataclass(frozen=True, slots=True)
class AwsSetupKeys(Section):
    """The project's place on AWS, and the size of its servers."""

    bucket: str | None = keyed.text(
        None, "HIPPO's name of the S3 bucket. No effect: pages and data lie in the installation's."
    )
    region: str | None = keyed.text(None, "AWS region, such as ca-central-1. Default: the installation's.", region)
    root_domain: str | None = keyed.text(
        None,
        "Domain below which each server gets its name; without https://. Default: the installation's.",
        domain,
    )
    cpu: float | None = keyed.key(
        fargate.cpu,
        None,
        "vCPUs of each participant's server. Needed for AWS.",
        {"enum": [int(n) if n >= 1 else n for n in fargate.SIZES]},
    )
    memory: float | None = keyed.key(
        fargate.memory,
        None,
        "Memory of each participant's server in GB; must fit cpu. Needed for AWS.",
        {"type": "number", "minimum": 0.5, "maximum": 120},
    )


@dataclass(frozen=True, slots=True)
class EventsKeys(Section):
    """The steps at which a participant's server starts and stops."""

    start_server_step: str | None = _step(
        "The server starts when the participant reaches this step. Default with a game step: 2, or 1 if it is step 1."
    )
    stop_server_step: str | None = _step(
        "The server stops when the participant reaches this step. Default: the step after the last game step."
    )


@dataclass(frozen=True, slots=True)
class SslKeys(Section):
    """HIPPO's section for the servers' certificate. It has no effect."""

    ssl_bucket: str | None = keyed.text(None, "No effect.")
    fullchain: str | None = keyed.text(None, "No effect.")
    privkey: str | None = keyed.text(None, "No effect.")


@dataclass(frozen=True, slots=True)
class ProjectKeys(Section):
    """The study: its researchers, its steps, and its servers."""

    id: str = keyed.key(
        project_id,
        "",
        "The project's id: letters, digits, dashes and underscores; unique in your organization.",
        {"type": ["string", "integer"], "pattern": "^(?!_)[A-Za-z0-9_-]{1,64}$"},
        needed=True,
    )
    name: str = keyed.text("", "The name of the study for people. Default: the id.", values.text("a name"))
    researcher: str = keyed.text("", "The person who is responsible for the study.")
    contact: str = keyed.text(
        "", "How participants reach the researchers if something does not work, such as an e-mail address."
    )
    team_members: tuple[str, ...] = keyed.items(
        "person", 200, values.text(), (), "The other members of the team: one name or a list.", single=True
    )
    live: bool = keyed.flag(True, "Whether participants can take part now.")
    max_runtime: int = keyed.whole(1, 1440, 60, "Minutes after which a server is stopped, whatever happens.")
    use_aws: bool = keyed.flag(
        False,
        "Whether the study runs on AWS; false keeps it on one machine. Default: on AWS as soon as it is deployed.",
        name="useAWS",
    )
    aws_setup: AwsSetupKeys = keyed.section(
        AwsSetupKeys, AwsSetupKeys(), "The size of the servers, and their place on AWS; needed for AWS."
    )
    events: EventsKeys = keyed.section(
        EventsKeys, EventsKeys(), "The steps at which the participant's server starts and stops."
    )
    ssl: SslKeys = keyed.section(
        SslKeys,
        SslKeys(),
        "No effect: servers get the installation's certificate. HIPPO's configurations have this section.",
    )
    steps: dict[str, str] = keyed.key(
        values.section("1: consent"),
        {},
        "The study's steps in order: a list of names with settings (docs/designs.md), or 1, 2, 3 … and finalStep. "
        "Each is a file of the steps folder, or game.",
        {"anyOf": [_NUMBERED, _NAMED]},
        needed=True,
        entries=steps_by_number,
    )
    conditions: dict[str, Any] = keyed.key(
        _apart,
        {},
        "Factors between people, each with its levels: everybody gets one cell of their product, in balance "
        "(docs/designs.md).",
        _FACTORS,
    )
    ends: dict[str, Any] = keyed.key(
        _apart,
        {},
        'Ends before the last step, each with its rule, such as declined: answers.consent.agree == "no" '
        "(docs/designs.md).",
        {"type": "object"},
    )
    cluster: str = keyed.choice(
        ("installation", "participant"),
        "One ECS cluster for the installation, or one for each participant as in HIPPO.",
    )
    subdomain: str = keyed.choice(
        ("hash", "userId"), "The name of a server: a hash, which keeps ids private, or the userId as in HIPPO."
    )
    plain_clients: bool = keyed.flag(
        False,
        "Whether HIPPO's front end plays without a token. Anybody who knows an id can then play as that participant.",
    )
    front_end: tuple[str, ...] = keyed.items(
        "https:// address",
        5,
        page_origin,
        (),
        "Origins of HIPPO's front end: https://, or http:// on this machine. Needed with plainClients.",
        single=True,
    )
    allowed_hosts: tuple[str, ...] = keyed.items(
        "https:// address",
        MAX_HOSTS,
        origin,
        (),
        "https:// origins from which step pages may load images, media, frames and scripts.",
    )
    record_headers: tuple[str, ...] = keyed.items(
        "name of a header",
        MAX_HEADERS,
        header,
        ("user-agent", "accept-language"),
        "Headers of a participant's first request that are kept. user-agent names browser and device.",
    )
    max_participants: int | None = keyed.whole(
        1,
        100_000,
        None,
        "The largest number of participants. Later ones are told that the study is full. Default: no limit.",
    )
    max_servers: int | None = keyed.whole(
        1, 10_000, None, "The largest number of servers that run at once. Default: no limit."
    )
    max_server_hours: int | None = keyed.whole(
        1, 1_000_000, None, "Hours that all servers together may run. Default: no limit."
    )
    warm_servers: int = keyed.whole(
        0,
        100,
        0,
        "Servers that are started ahead, so that participants need not wait. Each waiting server costs money.",
    )
    signed_links: bool = keyed.flag(False, "Whether participants need a link that `deploy links` has signed.")
    players: int = keyed.whole(
        1,
        MAX_PLAYERS,
        1,
        "The number of participants who play together in one environment. With 1 each plays alone, on their own "
        "server.",
    )
    matching: str | dict[str, str] = keyed.key(
        who_with_whom,
        "arrival",
        "Who plays with whom: arrival, group, mixed, {same: field}, {different: field}, or match of agent.py.",
        _MATCHING,
    )
    seats: str = keyed.choice(
        tuple(SEATS),
        "Who plays which player: by lot, in the order of the groups, or in the order in which match returns them.",
    )
    patience: float = keyed.seconds(
        3600, 300, "Seconds for which a participant waits in the lobby for others.", least=10
    )
    after_patience: str = keyed.choice(
        ("unmatched", "policies"),
        "What follows when patience is over: the next step, or a game with policies (trial.substitute) in empty "
        "places.",
    )
    texts: dict[str, str] = keyed.key(
        values.section('start: "Los"'),
        {},
        "The study's own words for Hippodrome's texts (docs/texts.md). Default: English.",
        {
            "additionalProperties": False,
            "properties": {
                name: {"type": ["string", "null"], "description": text, "maxLength": MAX_TEXT}
                for name, text in ENGLISH.items()
            },
            "type": "object",
        },
        entries=keyed.map_of(text_name, own_text),
    )

    @property
    def keeps_off_aws(self) -> bool:
        """Whether config.yml says `useAWS: false`. Without the key, `register` puts the study on AWS."""
        return self.given("useAWS") and not self.use_aws

    @property
    def may_run_on_aws(self) -> bool:
        """Whether the study may run on AWS: it has `useAWS: true`, or no useAWS, but a `cpu` in awsSetup."""
        return self.use_aws or (not self.given("useAWS") and self.aws_setup.given("cpu"))

    @property
    def has_sessions(self) -> bool:
        """Whether several participants share a server."""
        return self.players > 1

    @property
    def own_texts(self) -> dict[str, str]:
        """The texts for which the study has its own words."""
        return {name: text for name, text in self.texts.items() if text}


@dataclass(frozen=True, slots=True)
class ConfigFile(Section):
    """config.yml: a study, its servers and its game."""

    trial: TrialSection = keyed.section(TrialSection, TrialSection(), "")
    project: ProjectKeys = keyed.section(ProjectKeys, ProjectKeys(), "", needed=True)


SECTIONS = keyed.sections_in(ConfigFile)
"""The sections of the file, by path."""
NAMES = {path: keyed.names(section) for path, section in SECTIONS.items()}
"""The keys of each section, as they stand in the file."""
STEPS: KeyPath = ("project", "steps")
TEXTS: KeyPath = ("project", "texts")
