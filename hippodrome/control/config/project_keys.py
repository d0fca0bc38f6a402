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
    text = as_text(value, "letters, digits, dashes and underscores")
    if text == _CERTIFICATES:
        raise ValueError(f"must not be {text}: that is the folder of the servers' certificate in the bucket")
    if ids.is_project_id(text):
        return text
    if len(text) > 64:
        raise ValueError(f"must be at most 64 characters long, not {len(text)}")
    better = re.sub(r"[^A-Za-z0-9_]+", "-", text).strip("-_")
    hint = f'; write for example "{better}"' if better else ""
    if text.startswith("_"):
        raise ValueError(f"must not begin with an underscore{hint}")
    raise ValueError(f"may hold only letters, digits, dashes and underscores, not {show(text)}{hint}")


def region(value: object) -> str:
    """Check the code of an AWS region."""
    text = as_text(value, "an AWS region such as ca-central-1")
    if _REGION.fullmatch(text):
        return text
    if _REGION.fullmatch(text[:-1]) and text[-1:].isalpha():
        raise ValueError(f"{text} is an availability zone; the region is {text[:-1]}")
    raise ValueError(f"must be an AWS region such as ca-central-1, not {show(text)}")


def domain(value: object) -> str:
    """Check a DNS name of at least two labels, and return it in small letters."""
    text = as_text(value, "a domain name such as example.org")
    name = text.lower().rstrip(".")
    if _DOMAIN.fullmatch(name) and len(name) <= _DNS_ROOM and name == text.lower():
        return name
    bare = re.sub(r"^[a-z]+://", "", name).split("/")[0].split(":")[0].rstrip(".")
    if bare != text and _DOMAIN.fullmatch(bare):
        raise ValueError(f"must be the domain name only, without https:// or a path; write {bare}")
    if len(name) > _DNS_ROOM:
        raise ValueError(f"must be at most {_DNS_ROOM} characters, so that the servers' names fit in front")
    raise ValueError(f"must be a domain name such as example.org, not {show(text)}")


def origin(value: object) -> str:
    """Check an https origin: https://name, perhaps with a port, without a path and without a wildcard."""
    text = as_text(value, "an address such as https://example.org")
    whole_match = _ORIGIN.fullmatch(text.lower())
    if whole_match and len(whole_match["host"]) <= 253:
        return text.lower()
    if _ORIGIN.fullmatch("https://" + text.lower()):
        raise ValueError(f"must begin with https://; write https://{text.lower()}")
    start = _ORIGIN.match(text.lower())
    if start and text[start.end() : start.end() + 1] in {"/", "?", "#"}:
        raise ValueError(f"must be the host only, without a path; write {start[0]}")
    raise ValueError(f"must be an address such as https://example.org, without path and without *, not {show(text)}")


def page_origin(value: object) -> str:
    """Check the origin of a front end's pages, and return it as browsers write it.

    It is an https origin, or an http origin of this machine (localhost, a name below it, 127.0.0.1).
    """
    text = as_text(value, "an address such as https://play.example.org").lower()
    if _HERE.fullmatch(text):
        return text.removesuffix(":80")
    return origin(value).removesuffix(":443")


def step_key(value: object) -> str:
    """Check a key of `steps`: a number from 1, or finalStep."""
    text = value.text if isinstance(value, Plain) else value
    if isinstance(text, str) and (text == FINAL or (_STEP_NUMBER.fullmatch(text) and int(text) <= MAX_STEPS)):
        return text
    if isinstance(text, str) and text.lower().replace("_", "") == FINAL.lower():
        raise ValueError(f"write {FINAL}")
    if isinstance(text, str) and text.isdecimal() and len(text) < 18 and int(text) > MAX_STEPS:
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
    number = number_in(value)
    if number is None or number != int(number) or not 0 < number <= MAX_STEPS + 1:
        raise ValueError(f"must be the number of a step or {FINAL}, not {show(value)}")
    return str(int(number))


def page(value: object) -> str:
    """Check the page of a step, and return its file without `.html`, or the type of a step such as `game`."""
    if values.is_blank(value):
        raise ValueError(f"has no page; write the name of its file, or {step_types.NAMES}")
    text = as_text(value, f"the name of a file, or {step_types.NAMES}")
    stem = step_file(text)
    if stem in step_types.RESERVED and text != stem:
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


def _step(meaning: str, **more: Any) -> Any:
    schema = {"anyOf": [{"minimum": 1, "type": "integer"}, {"const": FINAL}]}
    return keyed.key(step_name, None, meaning, schema, kind=f"number of a step, or `{FINAL}`", **more)


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
        None,
        "No effect: HIPPO's key for the S3 bucket. Pages and data lie in the installation's.",
        otherwise="the installation's",
    )
    region: str | None = keyed.text(
        None, "The AWS region.", region, kind="code of a region", otherwise="the installation's", example="eu-north-1"
    )
    root_domain: str | None = keyed.text(
        None,
        "The installation's domain, below which servers get their names.",
        domain,
        kind="domain name, without `https://`",
        otherwise="the installation's",
        example="play.paddle.example",
    )
    cpu: float | None = keyed.key(
        fargate.cpu,
        None,
        "vCPUs of each participant's server.",
        {"enum": [int(n) if n >= 1 else n for n in fargate.SIZES]},
        kind="one of the table below",
        otherwise="needed on AWS",
        example="1",
    )
    memory: float | None = keyed.key(
        fargate.memory,
        None,
        "Memory of each server in GB; must fit `cpu`.",
        {"type": "number", "minimum": 0.5, "maximum": 120},
        kind="see below",
        otherwise="needed on AWS",
        example="4",
    )


@dataclass(frozen=True, slots=True)
class EventsKeys(Section):
    """The steps at which a participant's server starts and stops."""

    start_server_step: str | None = _step(
        "The server starts when the participant reaches this step. It must not come after the first game step.",
        otherwise="`2` if there is a game step (`1` if the game is step 1), else none",
        example="3",
    )
    stop_server_step: str | None = _step(
        "The server stops when the participant reaches this step. It must come after the last game step.",
        otherwise="the step after the last game step, else none",
        example="4",
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
        "The project's name in addresses and folders. Unique in your organization.",
        {"type": ["string", "integer"], "pattern": "^(?!_)[A-Za-z0-9_-]{1,64}$"},
        needed=True,
        kind=(
            "letters, digits, dashes, underscores (not the first); 1 to 64; not `SSL`, the folder of the "
            "servers' certificate"
        ),
        example="paddle-feedback",
    )
    name: str = keyed.text(
        "",
        "The title that participants see.",
        values.text("a name"),
        otherwise="the `id`",
        example="Paddle with feedback",
    )
    researcher: str = keyed.text(
        "", "The responsible researcher; participants see the name at the bottom of each page.", example="Mio Sørensen"
    )
    contact: str = keyed.text(
        "",
        "How participants reach you if something does not work, such as an e-mail address. They see "
        "it on pages that report an error, and when no server could run their game.",
        example="study@example.edu",
    )
    team_members: tuple[str, ...] = keyed.items(
        "person",
        200,
        values.text(),
        (),
        "The other researchers.",
        single=True,
        kind="text, or a list",
        example="[Ada, Bo]",
    )
    live: bool = keyed.flag(
        True,
        "Whether participants can take part now. If not, the link answers as if there were no such "
        "project, also for participants in the middle of it; see [closing](#closing).",
        example="false",
    )
    max_runtime: int = keyed.whole(
        1,
        1440,
        60,
        "Minutes after which a participant's server is stopped, whatever happens. If your "
        "administrator has set a lower limit, that counts.",
        example="45",
    )
    use_aws: bool = keyed.flag(
        False,
        "Whether the study is for AWS; see [useAWS](#useaws).",
        name="useAWS",
        otherwise="on AWS once it is deployed",
        example="true",
    )
    aws_setup: AwsSetupKeys = keyed.section(
        AwsSetupKeys,
        AwsSetupKeys(),
        "How large the servers are, and where on AWS; see [awsSetup](#awssetup).",
        otherwise="needed on AWS",
    )
    events: EventsKeys = keyed.section(
        EventsKeys,
        EventsKeys(),
        "When the server starts and stops; see [events](#events).",
        otherwise="around the game",
    )
    ssl: SslKeys = keyed.section(
        SslKeys, SslKeys(), "Has no effect; see [ssl](#ssl).", otherwise="the installation's own"
    )
    steps: dict[str, str] = keyed.key(
        values.section("1: consent"),
        {},
        "The pages in order: a list of names with settings ([designs](designs.md)), or 1, 2, 3 … and `finalStep`; see "
        "[steps](#steps).",
        {"anyOf": [_NUMBERED, _NAMED]},
        needed=True,
        entries=steps_by_number,
        kind="list or section",
        example="[consent, game, thanks]",
    )
    conditions: dict[str, Any] = keyed.key(
        _apart,
        {},
        "Factors between people, each with its levels; everybody gets one cell of their product, in balance; see "
        "[designs](designs.md#conditions-between-people).",
        _FACTORS,
        kind="section",
        otherwise="none",
        example="{partner: [helpful, lazy]}",
    )
    ends: dict[str, Any] = keyed.key(
        _apart,
        {},
        "Ends before the last step, for those who decline, fail a check, or run out of time; see "
        "[designs](designs.md#ends).",
        {"type": "object"},
        kind="section",
        otherwise="none",
        example="{declined: 'answers.consent.agree == \"no\"'}",
    )
    cluster: str = keyed.choice(
        ("installation", "participant"),
        "`installation`: all servers share one ECS cluster. `participant`: each participant has a "
        "cluster, as in HIPPO.",
    )
    subdomain: str = keyed.choice(
        ("hash", "userId"),
        "The first part of a server's DNS name. `hash`: a short hash, so that DNS holds no ids of "
        "recruiters. `userId`: the id in lower case, as in HIPPO, if your administrator allows it; an"
        " id that DNS does not accept (64 characters, a dash or an underscore at its beginning or "
        "end) gets a hash.",
    )
    plain_clients: bool = keyed.flag(
        False,
        "Whether HIPPO's own front end may open the game. It has no token, so the participant's id "
        "and the front end's address open a server. A person who knows an id can then play in that "
        "participant's place ([security](security.md#identity)). Needs `subdomain: userId` and your "
        "administrator's consent; see [coming from "
        "HIPPO](hippo.md#the-plain-websocket-protocol-and-the-react-front-end).",
        example="true",
    )
    front_end: tuple[str, ...] = keyed.items(
        "https:// address",
        5,
        page_origin,
        (),
        "Where that front end is.",
        single=True,
        kind=(
            "an `https://` address without path, or a list of at most 5; on one machine also `http://localhost:3000`"
        ),
        otherwise="needed with `plainClients`",
        example="https://play.example.org",
    )
    allowed_hosts: tuple[str, ...] = keyed.items(
        "https:// address",
        MAX_HOSTS,
        origin,
        (),
        "Other sites from which your pages may load images, videos, frames and scripts.",
        kind="list of `https://` addresses without path; at most 50",
        example="[https://media.example.org]",
    )
    record_headers: tuple[str, ...] = keyed.items(
        "name of a header",
        MAX_HEADERS,
        header,
        ("user-agent", "accept-language"),
        "Headers of a participant's first request that are kept in `participant.json`: by default "
        "those that name browser, device and languages. `[]` keeps none. The IP address is "
        "`x-forwarded-for`: it is kept only if you name it, and is personal data, so say it in your "
        "consent form.",
        kind="list of names; at most 20",
        example="[user-agent]",
    )
    max_participants: int | None = keyed.whole(
        1,
        100_000,
        None,
        "How many participants may take part. For others the study is full; see [limits](#limits).",
        otherwise="no limit",
        example="200",
    )
    max_servers: int | None = keyed.whole(
        1, 10_000, None, "How many servers may run at once; see [limits](#limits).", otherwise="no limit", example="20"
    )
    max_server_hours: int | None = keyed.whole(
        1,
        1_000_000,
        None,
        "Hours that all servers together may run; see [limits](#limits).",
        kind="1 to 1000000, and enough for `maxRuntime`",
        otherwise="no limit",
        example="300",
    )
    warm_servers: int = keyed.whole(
        0,
        100,
        0,
        "How many servers start ahead and wait for participants; see [warm servers](#warm-servers).",
        kind="0 to 100, at most `maxServers`",
        example="4",
    )
    signed_links: bool = keyed.flag(
        False, "Whether a link must be signed; see [Inviting participants](recruiting.md#signed-links).", example="true"
    )
    players: int = keyed.whole(
        1, MAX_PLAYERS, 1, "How many participants play together in one environment. 1: each plays alone.", example="2"
    )
    matching: str | dict[str, str] = keyed.key(
        who_with_whom,
        "arrival",
        "Who plays with whom: `arrival` (who came first), `group` (people of one group), `mixed` (of "
        "different groups), `{same: field}` or `{different: field}` (by what they answered in that "
        "field of an earlier page). `match`: the function "
        "[`match`](sessions.md#a-function-that-matches) of `agent.py` decides.",
        _MATCHING,
        kind="one of these",
        example="{same: language}",
    )
    seats: str = keyed.choice(
        tuple(SEATS),
        "Who plays which player. `lot`: drawn by lot. `group`: in the order of the groups, so that a "
        "participant of group 0 is the first human player; needs `matching: mixed` or `match`. "
        "`match`: in the order in which the function [`match`](sessions.md#a-function-that-matches) "
        "names the members of a session.",
        example="group",
    )
    patience: float = keyed.seconds(
        3600, 300, "Seconds after which a participant no longer waits for others.", least=10, example="120"
    )
    after_patience: str = keyed.choice(
        ("unmatched", "policies"),
        "What happens then. `unmatched`: the next step. `policies`: a game with those who are there; "
        "`trial.substitute` plays in the empty places.",
        example="policies",
    )
    texts: dict[str, str] = keyed.key(
        values.section('start: "Los"'),
        {},
        "Your own words for what Hippodrome says to participants, such as buttons and errors, for a "
        "study in another language; see [texts](texts.md).",
        {
            "additionalProperties": False,
            "properties": {
                name: {"type": ["string", "null"], "description": text, "maxLength": MAX_TEXT}
                for name, text in ENGLISH.items()
            },
            "type": "object",
        },
        entries=keyed.map_of(text_name, own_text),
        kind="section: names and texts",
        otherwise="English",
        example='{continue: "Weiter"}',
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
