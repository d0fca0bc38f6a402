"""What a single value of config.yml may be: a check returns the value, or raises ValueError with what to write instead.

A check takes anything: text, `Plain` values from YAML, or whatever JSON can hold.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import dataclass

from hippodrome import ids
from hippodrome.config.problems import printable

FINAL = "finalStep"
MAX_STEPS = 500

Check = Callable[[object], object]

_LABEL = r"[a-z0-9]([a-z0-9-]{0,61}[a-z0-9])?"
_DOMAIN = re.compile(rf"({_LABEL}\.)+(?![0-9]+$){_LABEL}", re.IGNORECASE)
_ORIGIN = re.compile(rf"https://(?P<host>(({_LABEL}\.)+(?![0-9]+(:|$)){_LABEL}|localhost))(:[0-9]{{1,5}})?")
_REGION = re.compile(r"[a-z]{2,4}(-[a-z]+){1,2}-[0-9]{1,2}")
_BUCKET = re.compile(r"[a-z0-9][a-z0-9.-]{1,61}[a-z0-9]")
_BUCKET_STARTS = ("xn--", "sthree-", "amzn-s3-demo-")
_BUCKET_ENDS = ("-s3alias", "--ol-s3", ".mrap", "--x-s3", "--table-s3")
_PAGE = re.compile(r"[A-Za-z0-9_]([A-Za-z0-9_ .-]{0,98}[A-Za-z0-9_-])?")
_STEP_NUMBER = re.compile(r"[1-9][0-9]{0,2}")
_WHOLE = re.compile(r"[-+]?[0-9]{1,18}")
_DECIMAL = re.compile(r"[-+]?([0-9]{1,18}(\.[0-9]{0,18})?|\.[0-9]{1,18})")
_CONTROL = re.compile("[\x00-\x1f\x7f-\x9f\u2028\u2029\ud800-\udfff]")
_WORDS = {"true": True, "yes": True, "on": True, "false": False, "no": False, "off": False}
_SURROGATE = re.compile("[\ud800-\udfff]")
_CERTIFICATES = "SSL"  # where servers may write nothing (infra/template.yml): a study there would keep no answer
_OPTIONS_LENGTH, _OPTIONS_DEPTH = 4096, 8  # a server is told all it needs in 8192 characters
_DNS_ROOM = 253 - 64  # a server's own label, and its dot, stand in front


@dataclass(frozen=True, slots=True)
class Plain:
    """A number or true/false as YAML understood it, and the text that was written."""

    value: int | float | bool
    text: str


def show(value: object) -> str:
    """The value as it may stand in a message: short, in quotes if it is text, without anything invisible."""
    if isinstance(value, Plain):
        return printable(value.text)
    if isinstance(value, str) and value:
        return f'"{printable(value)}"'
    if value is None or value == "":
        return "empty"
    if isinstance(value, bool | float) or (isinstance(value, int) and abs(value) < 10**18):
        return json.dumps(value)
    return "a map" if isinstance(value, dict) else "a list" if isinstance(value, list | tuple) else "that"


def _as_text(value: object, what: str) -> str:
    if isinstance(value, Plain) and isinstance(value.value, bool):
        raise ValueError(f'must be {what}; YAML reads {value.text} as true or false, so write "{value.text}" in quotes')
    if isinstance(value, Plain):
        return value.text
    if not isinstance(value, str) or not value.strip():
        raise ValueError(f"must be {what}, not {show(value)}")
    if _CONTROL.search(value.strip()):
        raise ValueError(f"must be {what}; without tabs, line ends and invisible characters")
    return value.strip()


def text(what: str = "text", limit: int = 500) -> Check:
    """A check for any text of up to `limit` characters."""

    def check(value: object) -> str:
        found = _as_text(value, what)
        if len(found) > limit:
            raise ValueError(f"must be at most {limit} characters long, not {len(found)}")
        return found

    return check


def number_in(value: object) -> int | float | None:
    """The finite number in a YAML or JSON number or in text such as "30"; None if there is none."""
    if isinstance(value, Plain):
        value = value.value
    if isinstance(value, str) and _WHOLE.fullmatch(value.strip()):
        return int(value)
    if isinstance(value, str) and _DECIMAL.fullmatch(value.strip()):
        return float(value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    return value if isinstance(value, int) or math.isfinite(value) else None


def whole(low: int, high: int | None = None) -> Check:
    """A check for a whole number from `low` to `high` (a billion, which needs no mention), also as text."""
    span = f"of at least {low}" if high is None else f"from {low} to {high}"
    most = high or 10**9

    def check(value: object) -> int:
        found = number_in(value)
        if found is None or found != int(found) or not low <= found <= most:
            raise ValueError(f"must be a whole number {span}, not {show(value)}")
        return int(found)

    return check


def number(low: int, high: int) -> Check:
    """A check for a number from `low` to `high`, also as text; a whole one is returned as an int."""

    def check(value: object) -> float:
        found = number_in(value)
        if found is None or not low <= found <= high:
            raise ValueError(f"must be a number from {low} to {high}, not {show(value)}")
        return int(found) if found == int(found) else found

    return check


def flag(value: object) -> bool:
    """true or false, also as yes/no, on/off."""
    if isinstance(value, Plain):
        value = value.value if isinstance(value.value, bool) else value
    if isinstance(value, bool):
        return value
    if isinstance(value, str) and value.strip().lower() in _WORDS:
        return _WORDS[value.strip().lower()]
    raise ValueError(f"must be true or false, not {show(value)}")


def one_of(*choices: str) -> Check:
    """A check for one of a few words."""

    def check(value: object) -> str:
        if isinstance(value, str) and value.strip() in choices:
            return value.strip()
        raise ValueError(f"must be {' or '.join(choices)}, not {show(value)}")

    return check


def project_id(value: object) -> str:
    """Letters, digits and dashes, 1 to 64."""
    found = _as_text(value, "letters, digits and dashes")
    if found == _CERTIFICATES:
        raise ValueError(f"must not be {found}: that is the folder of the servers' certificate in the bucket")
    if ids.is_project_id(found):
        return found
    if len(found) > 64:
        raise ValueError(f"must be at most 64 characters long, not {len(found)}")
    better = re.sub(r"[^A-Za-z0-9]+", "-", found).strip("-")
    hint = f'; write for example "{better}"' if better else ""
    raise ValueError(f"may hold only letters, digits and dashes, not {show(found)}{hint}")


def bucket(value: object) -> str:
    """The name of an S3 bucket."""
    found = _as_text(value, "the name of an S3 bucket")
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
    found = _as_text(value, "an AWS region such as ca-central-1")
    if _REGION.fullmatch(found):
        return found
    if _REGION.fullmatch(found[:-1]) and found[-1:].isalpha():
        raise ValueError(f"{found} is an availability zone; the region is {found[:-1]}")
    raise ValueError(f"must be an AWS region such as ca-central-1, not {show(found)}")


def domain(value: object) -> str:
    """A DNS name of at least two labels, in small letters."""
    found = _as_text(value, "a domain name such as example.org")
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
    found = _as_text(value, "an address such as https://example.org")
    whole_match = _ORIGIN.fullmatch(found.lower())
    if whole_match and len(whole_match["host"]) <= 253:
        return found.lower()
    if _ORIGIN.fullmatch("https://" + found.lower()):
        raise ValueError(f"must begin with https://; write https://{found.lower()}")
    start = _ORIGIN.match(found.lower())
    if start and found[start.end() : start.end() + 1] in {"/", "?", "#"}:
        raise ValueError(f"must be the host only, without a path; write {start[0]}")
    raise ValueError(f"must be an address such as https://example.org, without path and without *, not {show(found)}")


def object_key(value: object) -> str:
    """The path of a file within a bucket."""
    found = _as_text(value, "the path of a file in the bucket, such as SSL/fullchain.pem")
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
        raise ValueError("has no page; write the name of its file, or game")
    found = _as_text(value, "the name of a file, or game")
    stem = found.removesuffix(".html")
    if "/" in found or "\\" in found:
        raise ValueError(f"must be the name of a file in the steps folder, without folders, not {show(found)}")
    if stem == "game" and found != stem:
        raise ValueError("a page cannot be called game.html; write game for the game step, or rename the page")
    if not _PAGE.fullmatch(stem) or ".." in stem:
        raise ValueError(
            f"file names may hold letters (a to z), digits, spaces, dots, dashes and underscores; rename {show(found)}"
        )
    return stem


def options(value: object) -> dict[str, object]:
    """A map of whatever JSON can hold, not too large."""
    if not isinstance(value, dict):
        raise ValueError(f'must be a map: indented lines such as "difficulty: 3" below it, not {show(value)}')
    found = _json_map(value, _OPTIONS_DEPTH)
    length = len(json.dumps(found, separators=(",", ":")))
    if length > _OPTIONS_LENGTH:
        raise ValueError(f"must be at most {_OPTIONS_LENGTH} characters long when written as JSON, not {length}")
    return found


def _json_map(value: dict[object, object], depth: int) -> dict[str, object]:
    return {str(_json(key, 0)): _json(item, depth - 1) for key, item in value.items()}


def _json(value: object, depth: int) -> object:
    """The value as JSON has it, with at most `depth` lists and maps within each other."""
    if isinstance(value, Plain):
        value = value.value
    if isinstance(value, dict | list):
        if not depth:
            raise ValueError(f"must be nested no more than {_OPTIONS_DEPTH} deep")
        return _json_map(value, depth) if isinstance(value, dict) else [_json(item, depth - 1) for item in value]
    if (
        value is None
        or (isinstance(value, str) and not _SURROGATE.search(value))
        or (isinstance(value, int) and abs(value) < 2**63)
        or (isinstance(value, float) and math.isfinite(value))
    ):
        return value
    raise ValueError("must be text, numbers, true or false, lists and maps; one of the values is none of these")
