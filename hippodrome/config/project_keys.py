"""The section `project` of config.yml: what a value of each key may be by itself, its default, its meaning.

First the checks of single values, then the keys that they check. A check returns the value, or raises ValueError with
what to write instead; it takes anything: text, `Plain` values from YAML, or whatever JSON can hold. Checks that any
section can use are in `protocol/values.py`; the keys of `trial` are in `protocol/trial.py`, because the servers check
them too.
"""

from __future__ import annotations

import re
from typing import Annotated

from pydantic import Field

from hippodrome.config import fargate
from hippodrome.config.diagnostics import Keys
from hippodrome.config.key_types import Model, Rule, items, one_of, whole
from hippodrome.model import ids, step_types
from hippodrome.model.matching import MATCHED_BY, MATCHINGS, SEATS
from hippodrome.model.step_order import FINAL
from hippodrome.model.texts import ENGLISH
from protocol import values
from protocol.session import MAX_PLAYERS
from protocol.similar import did_you_mean
from protocol.trial import TrialSection
from protocol.trial_keys import names
from protocol.trial_sections import SceneSection, Ui
from protocol.values import Plain, as_text, number_in, show, step_file

MAX_STEPS = 500
LONGEST_TEXT = 500  # characters

_LABEL = r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?"
_DOMAIN = re.compile(rf"({_LABEL}\.)+(?![0-9]+$){_LABEL}", re.IGNORECASE)
_ORIGIN = re.compile(rf"https://(?P<host>(({_LABEL}\.)+(?![0-9]+(:|$)){_LABEL}|localhost))(:[0-9]{{1,5}})?")
_HERE = re.compile(rf"http://(({_LABEL}\.)*localhost|127\.0\.0\.1)(:[0-9]{{1,5}})?")
_REGION = re.compile(r"[a-z]{2,4}(-[a-z]+){1,2}-[0-9]{1,2}")
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_BUCKET_STARTS = ("xn--", "sthree-", "amzn-s3-demo-")
_BUCKET_ENDS = ("-s3alias", "--ol-s3", ".mrap", "--x-s3", "--table-s3")
_STEP_NUMBER = re.compile(r"[1-9][0-9]{0,2}")
_CERTIFICATES = "SSL"  # where servers may write nothing (infra/template.yml): a study there would keep no answer
_DNS_ROOM = 253 - 64  # a server's own label, and its dot, stand in front


def project_id(value: object) -> str:
    """Letters, digits, dashes and underscores, 1 to 64; no underscore at the beginning."""
    found = as_text(value, "letters, digits, dashes and underscores")
    if found == _CERTIFICATES:
        raise ValueError(f"must not be {found}: that is the folder of the servers' certificate in the bucket")
    if ids.is_project_id(found):
        return found
    if len(found) > 64:
        raise ValueError(f"must be at most 64 characters long, not {len(found)}")
    better = re.sub(r"[^A-Za-z0-9_]+", "-", found).strip("-_")
    hint = f'; write for example "{better}"' if better else ""
    what = "must not begin with an underscore" if found.startswith("_") else ""
    what = what or f"may hold only letters, digits, dashes and underscores, not {show(found)}"
    raise ValueError(f"{what}{hint}")


def bucket(value: object) -> str:
    """Check the name of an S3 bucket. Raises ValueError."""
    found = as_text(value, "the name of an S3 bucket")
    if found.startswith(("s3://", "arn:", "http")) or "/" in found:
        raise ValueError(f"must be the bucket's name alone, without s3:// or folders, not {show(found)}")
    if found != found.lower() and _BUCKET.fullmatch(found.lower()):
        raise ValueError(f"bucket names have small letters only; is it {show(found.lower())}?")
    numeric = all(part.isdigit() for part in found.split(".")) and found.count(".") == 3
    reserved = found.startswith(_BUCKET_STARTS) or found.endswith(_BUCKET_ENDS)
    if not _BUCKET.fullmatch(found) or ".." in found or numeric or reserved:
        raise ValueError(
            "must be the name of an S3 bucket: 3 to 63 small letters, digits, dots and dashes, "
            f"with a letter or digit at both ends, not {show(found)}"
        )
    return found


def region(value: object) -> str:
    """An AWS region's code."""
    found = as_text(value, "an AWS region such as ca-central-1")
    if _REGION.fullmatch(found):
        return found
    if _REGION.fullmatch(found[:-1]) and found[-1:].isalpha():
        raise ValueError(f"{found} is an availability zone; the region is {found[:-1]}")
    raise ValueError(f"must be an AWS region such as ca-central-1, not {show(found)}")


def domain(value: object) -> str:
    """A DNS name of at least two labels, in small letters."""
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
    """An https origin: https://name, perhaps with a port; no path, no wildcard."""
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
    """An origin as browsers write it: https, or on this machine http (localhost, a name below it, 127.0.0.1)."""
    found = as_text(value, "an address such as https://play.example.org").lower()
    if _HERE.fullmatch(found):
        return found.removesuffix(":80")
    return origin(value).removesuffix(":443")


def object_key(value: object) -> str:
    """The path of a file within a bucket."""
    found = as_text(value, "the path of a file in the bucket, such as SSL/fullchain.pem")
    if "://" in found or found.startswith("/"):
        raise ValueError(f"must be the path within the bucket, such as SSL/fullchain.pem, not {show(found)}")
    if len(found.encode()) > 1024 or ".." in found.split("/"):
        raise ValueError("must be the path of a file in the bucket, such as SSL/fullchain.pem")
    return found


def step_key(value: object) -> str:
    """A key of `steps`: a number from 1, or finalStep."""
    found = value.text if isinstance(value, Plain) else value
    if isinstance(found, str) and (found == FINAL or (_STEP_NUMBER.fullmatch(found) and int(found) <= MAX_STEPS)):
        return found
    if isinstance(found, str) and found.lower().replace("_", "") == FINAL.lower():
        raise ValueError(f"write {FINAL}")
    if isinstance(found, str) and found.isdecimal() and len(found) < 18 and int(found) > MAX_STEPS:
        raise ValueError(f"a project has at most {MAX_STEPS} steps")
    raise ValueError(f"a step's key is 1, 2, 3 … or {FINAL}")


def step_name(value: object) -> str:
    """The step that an event names: a number, or finalStep."""
    if isinstance(value, str) and value.strip() == FINAL:
        return FINAL
    found = number_in(value)
    if found is None or found != int(found) or not 0 < found <= MAX_STEPS + 1:
        raise ValueError(f"must be the number of a step or {FINAL}, not {show(value)}")
    return str(int(found))


def page(value: object) -> str:
    """A step's file without `.html`, or `game`."""
    if value is None or value == "":
        raise ValueError(f"has no page; write the name of its file, or {step_types.NAMES}")
    found = as_text(value, f"the name of a file, or {step_types.NAMES}")
    stem = step_file(found)
    if stem in step_types.RESERVED and found != stem:
        raise ValueError(f"a page cannot be called {stem}.html; write {stem} for the {stem} step, or rename the page")
    return stem


def who_with_whom(value: object) -> str | dict[str, str]:
    """Who plays with whom: one of `MATCHINGS`, or a field of an earlier page whose answers are the same or different.

    Raises ValueError with what to write instead.
    """
    if not isinstance(value, dict):
        if isinstance(value, str) and value.strip() in MATCHINGS:
            return value.strip()
        choices = [*MATCHINGS, *(f"{{{how}: field}}" for how in MATCHED_BY)]
        raise ValueError(f"must be {' or '.join(choices)}, not {values.show(value)}")
    if len(value) != 1 or next(iter(value)) not in MATCHED_BY:
        raise ValueError("must name one field, such as {same: language} or {different: role}")
    how, given = next(iter(value.items()))
    return {str(how): str(values.text("the name of a field of an earlier page", 64)(given))}


def text_name(value: object) -> str:
    """Check the name of one of our texts (`hippodrome/model/texts.py`). Raises ValueError."""
    if isinstance(value, str) and value in ENGLISH:
        return value
    raise ValueError(f"unknown text{did_you_mean(str(value), ENGLISH) or '; docs/texts.md lists all'}")


def own_text(value: object) -> str:
    """A study's own words for a text. Empty: the English ones."""
    return "" if value in (None, "") else str(_OWN_TEXT(value))


_OWN_TEXT = values.text('text, in quotes: "…"', LONGEST_TEXT)
_MATCHING: dict[str, object] = {
    "anyOf": [
        {"enum": list(MATCHINGS)},
        *({"type": "object", "properties": {how: {"type": "string"}}, "required": [how]} for how in MATCHED_BY),
    ]
}
_Flag = Annotated[bool, Rule(values.flag, {"type": "boolean"})]
_Text = Annotated[str, Rule(values.text())]
_Bucket = Annotated[str, Rule(bucket, {"type": "string", "pattern": "^[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]$"})]
_Region = Annotated[str, Rule(region)]
_ObjectKey = Annotated[str, Rule(object_key)]
_StepName = Annotated[str, Rule(step_name, {"anyOf": [{"type": "integer", "minimum": 1}, {"const": FINAL}]})]


class AwsSetupKeys(Model):
    """Where a project lies in AWS, and how large its servers are."""

    bucket: _Bucket | None = None
    """S3 bucket that holds the project's pages and data. Default: the installation's."""
    region: _Region | None = None
    """AWS region, such as ca-central-1. Default: the installation's."""
    root_domain: Annotated[str, Rule(domain)] | None = None
    """Domain below which each server gets its name; without https://. Default: the installation's."""
    cpu: Annotated[float, Rule(fargate.cpu, {"enum": [int(n) if n >= 1 else n for n in fargate.SIZES]})] | None = None
    """vCPUs of each participant's server. Needed for AWS."""
    memory: Annotated[float, Rule(fargate.memory, {"type": "number", "minimum": 0.5, "maximum": 120})] | None = None
    """Memory of each participant's server in GB; must fit cpu. Needed for AWS."""


class EventsKeys(Model):
    """At which steps a participant's server starts and stops."""

    start_server_step: _StepName | None = None
    """The step whose reaching starts the server. Default with a game step: 2, or 1 if the game is step 1."""
    stop_server_step: _StepName | None = None
    """The step whose reaching stops the server. Default: the step after the last game step."""


class SslKeys(Model):
    """Where the servers fetch their certificate: three keys or none."""

    ssl_bucket: _Bucket | None = None
    """S3 bucket that holds the certificate."""
    fullchain: _ObjectKey | None = None
    """Path of fullchain.pem within sslBucket."""
    privkey: _ObjectKey | None = None
    """Path of privkey.pem within sslBucket."""


class ProjectKeys(Model):
    """Who runs the study, its steps, and where its servers run."""

    id: Annotated[str, Rule(project_id, {"type": ["string", "integer"], "pattern": "^(?!_)[A-Za-z0-9_-]{1,64}$"})] = ""
    """The project's id: letters, digits, dashes and underscores; unique in your organization."""
    name: Annotated[str, Rule(values.text("a name"))] = ""
    """A label for people. Default: the id."""
    researcher: _Text = ""
    """Who is responsible for the study."""
    team_members: Annotated[
        tuple[_Text, ...], items("person", 200, single=True), Field(json_schema_extra={"type": ["array", "string"]})
    ] = ()
    """Others in the team: one name or a list."""
    live: _Flag = True
    """Whether participants can take part now."""
    max_runtime: Annotated[int, whole(1, 1440)] = 60
    """Minutes after which a server is stopped, whatever happens."""
    use_aws: _Flag = False
    """Whether the study is for AWS. false keeps it on one machine; left out, deploying it puts it on AWS."""
    aws_setup: AwsSetupKeys = AwsSetupKeys()
    """How large the servers are, and where on AWS; needed for AWS."""
    events: EventsKeys = EventsKeys()
    """When the participant's server starts and stops."""
    ssl: SslKeys = SslKeys()
    """Has no effect: servers get the installation's certificate. HIPPO's configurations have it."""
    steps: dict[Annotated[str, Rule(step_key)], Annotated[str, Rule(page)]] = Field(
        default={},
        json_schema_extra={
            "patternProperties": {"^[1-9][0-9]{0,2}$": {"type": ["string", "integer"]}},
            "properties": {FINAL: {"type": ["string", "null"]}},
            "additionalProperties": False,
        },
    )
    """The study's steps in order: 1, 2, 3 … and finalStep, each a file of the steps folder or game."""
    cluster: Annotated[str, one_of("installation", "participant")] = "installation"
    """One ECS cluster for the installation, or one for each participant as HIPPO has it."""
    subdomain: Annotated[str, one_of("hash", "userId")] = "hash"
    """What a server is called: a hash (keeps ids private), or the userId as in HIPPO."""
    plain_clients: _Flag = False
    """Whether HIPPO's front end plays without a token: then who knows an id can play in that participant's place."""
    front_end: Annotated[
        tuple[Annotated[str, Rule(page_origin)], ...],
        items("https:// address", 5, single=True),
        Field(json_schema_extra={"type": ["array", "string"]}),
    ] = ()
    """Where that front end is: https:// origins, or http:// ones of this machine. Needed with plainClients."""
    allowed_hosts: Annotated[tuple[Annotated[str, Rule(origin)], ...], items("https:// address", 50)] = ()
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
    players: Annotated[int, whole(1, MAX_PLAYERS)] = 1
    """Participants who play together in one environment. 1: each plays alone, on a server of their own."""
    matching: Annotated[str | dict[str, str], Rule(who_with_whom, _MATCHING)] = "arrival"
    """Who plays with whom: arrival, group, mixed, {same: field}, {different: field}, or match of agent.py."""
    seats: Annotated[str, one_of(*SEATS)] = "lot"
    """Who plays which player: by lot, in the order of the groups, or in the order in which match named them."""
    patience: Annotated[float, Rule(values.number(10, 3600), {"type": "number", "minimum": 10, "maximum": 3600})] = 300
    """Seconds after which a participant no longer waits in the lobby for others."""
    after_patience: Annotated[str, one_of("unmatched", "policies")] = "unmatched"
    """Then: on to the next step as unmatched, or a game with policies in the empty places (trial.substitute)."""

    texts: dict[Annotated[str, Rule(text_name)], Annotated[str, Rule(own_text)]] = Field(
        default={},
        json_schema_extra={
            "properties": {
                name: {"type": ["string", "null"], "description": text, "maxLength": LONGEST_TEXT}
                for name, text in ENGLISH.items()
            },
            "additionalProperties": False,
        },
    )
    """The study's own words for what Hippodrome says to participants (docs/texts.md). Default: English."""

    @property
    def has_sessions(self) -> bool:
        """Whether several participants share a server."""
        return self.players > 1

    @property
    def own_texts(self) -> dict[str, str]:
        """The texts for which the study has words of its own."""
        return {name: text for name, text in self.texts.items() if text}


class Root(Model):
    project: ProjectKeys = ProjectKeys()


SECTIONS: dict[Keys, type[Model]] = {
    ("project",): ProjectKeys,
    ("project", "awsSetup"): AwsSetupKeys,
    ("project", "events"): EventsKeys,
    ("project", "ssl"): SslKeys,
}
TRIAL_SECTIONS: dict[Keys, type[TrialSection | Ui | SceneSection]] = {
    ("trial",): TrialSection,
    ("trial", "ui"): Ui,
    ("trial", "scene"): SceneSection,
}
NAMES: dict[Keys, frozenset[str]] = {
    **{path: names(section) for path, section in TRIAL_SECTIONS.items()},
    **{path: model.names() for path, model in SECTIONS.items()},
    (): frozenset({"project", "trial"}),
}
"""The keys of each section, as they stand in the file."""
STEPS: Keys = ("project", "steps")
TEXTS: Keys = ("project", "texts")
