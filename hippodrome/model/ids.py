"""Ids and what is derived from them: names of servers, groups, tickets, link signatures, completion codes. Pure."""

from __future__ import annotations

import base64
import functools
import hashlib
import hmac
import re
import secrets
from datetime import datetime

PROJECT_ID = re.compile(r"(?!_)[A-Za-z0-9_-]{1,64}")
"""What an id may be that stands in S3 keys, in the family of a task definition, in an image's tag and in links.

ECS takes letters, digits, `-` and `_` in a family (API_RegisterTaskDefinition); ECR these and `.` in a tag. No DNS name
holds a project's id. Folders of ours begin with `_` in the bucket, so no id does.
"""
USER_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_HOST = re.compile(r"(?!xn--)[a-z0-9](?:[a-z0-9_-]{0,61}[a-z0-9])?")
_WARM_ID = re.compile(r"~[0-9a-f]{20}")
_SERVER_NAME = re.compile(r"(s[a-z2-7]{20})-([1-9][0-9]{0,2})")
_DELAYED = "-delay"


def is_project_id(text: object) -> bool:
    """Whether `text` is 1 to 64 letters, digits, dashes and underscores, and does not begin with an underscore."""
    return isinstance(text, str) and PROJECT_ID.fullmatch(text) is not None


def is_user_id(text: object) -> bool:
    """Whether `text` is 1 to 64 letters, digits, dashes and underscores."""
    return isinstance(text, str) and USER_ID.fullmatch(text) is not None


def warm_id(project_id: str, asked: datetime, number: int) -> str:
    """The user id of a warm server until it is assigned. It is no valid participant's id, so no link can name it."""
    return "~" + hashlib.sha256(f"spare\0{project_id}\0{asked.isoformat()}\0{number}".encode()).hexdigest()[:20]


def is_warm_id(text: object) -> bool:
    """Whether this user id is that of a warm server."""
    return isinstance(text, str) and _WARM_ID.fullmatch(text) is not None


def new_session_id() -> str:
    """The id of a new session: random. It is no valid participant's id, so no link can name it."""
    return f"s.{secrets.token_hex(10)}"


@functools.lru_cache(maxsize=1024)  # a request asks several times, and base32 is encoded in Python
def server_label(project_id: str, user_id: str) -> str:
    """The label of a participant's servers: a hash, because ids are personal data and DNS ignores case.

    21 characters of `[a-z2-7]`, the first a letter. 100 bits, so that the labels of a million participants differ.
    """
    digest = hashlib.sha256(f"server\0{project_id}\0{user_id}".encode()).digest()
    return "s" + base64.b32encode(digest).decode().lower()[:20]


def server_name(label: str, attempt: int) -> str:
    """The name of one attempt: its DNS label, its task's `startedBy`, its timer's name."""
    return f"{label}-{attempt}"


def parse_server_name(name: str) -> tuple[str, int] | None:
    """The label and the attempt in a server's name; None if it is not the name of a server."""
    found = _SERVER_NAME.fullmatch(name)
    return (found[1], int(found[2])) if found else None


def delayed_timer(name: str) -> str:
    """The name of a server's second timer, which stops it after a delay (the stop relay)."""
    return name + _DELAYED


def timer_server(timer: str) -> str:
    """The name of the server that a timer stops, either of its two."""
    return timer.removesuffix(_DELAYED)


def host_server(domain_name: str) -> str:
    """The name of the server that a DNS name leads to: its first label."""
    return domain_name.partition(".")[0]


def is_host_label(text: str) -> bool:
    """Whether a server's DNS name may begin with this label: it is valid, and not the default name of any server.

    A label has at most 63 bytes (RFC 1035, 2.3.4), and Route 53 refuses a whole batch of changes for one that is longer
    (DomainLabelTooLong). It takes any printable character and stores letters in lower case (Route 53 Developer Guide,
    "DNS domain name format"); browsers are stricter: a label that begins or ends with a dash is no host (RFC 952), and
    one that begins with `xn--` has to be Punycode (RFC 5890).
    """
    return _HOST.fullmatch(text) is not None and parse_server_name(text) is None


def group(project_id: str, user_id: str, variants: int) -> int:
    """The participant's group, 0 to `variants` - 1: always the same one, and each equally likely.

    A participant has the same group at all steps with the same number of variants, and independent ones otherwise.
    """
    digest = hashlib.sha256(f"group\0{variants}\0{project_id}\0{user_id}".encode()).digest()
    return int.from_bytes(digest[:16], "big") % variants


def ticket(secret: str, user_id: str, step: str) -> str:
    """Proof, in a page's form, that this participant was shown this step. 32 hex digits of an HMAC."""
    return hmac.new(secret.encode(), f"ticket\0{user_id}\0{step}".encode(), hashlib.sha256).hexdigest()[:32]


def link_signature(secret: str, project_id: str, user_id: str) -> str:
    """Proof, in a link, that this participant is invited: it takes the project's secret. 32 hex digits of an HMAC."""
    return hmac.new(secret.encode(), f"link\0{project_id}\0{user_id}".encode(), hashlib.sha256).hexdigest()[:32]


def completion_code(secret: str, user_id: str, outcome: str = "") -> str:
    """The code that a participant gives to the recruiter: 10 characters, which only the project's secret makes.

    With an `outcome`, such as `unmatched`, it is another code.
    """
    about = f"completion\0{user_id}" + (f"\0{outcome}" if outcome else "")
    digest = hmac.new(secret.encode(), about.encode(), hashlib.sha256).digest()
    return base64.b32encode(digest).decode()[:10]


def secrets_equal(given: str, expected: str) -> bool:
    """Compare a secret from outside, which may hold any characters, with the expected one in constant time."""
    return hmac.compare_digest(given.encode("utf-8", "replace"), expected.encode())
