"""Checks ids, and derives from them: servers' names, groups, tickets, link signatures, completion codes. Pure."""

from __future__ import annotations

import base64
import functools
import hashlib
import hmac
import re
import secrets
from datetime import datetime

from hippodrome.protocol.keys import NAME

PROJECT_ID = re.compile(r"(?!_)[A-Za-z0-9_-]{1,64}")
"""A valid project id. It stands in S3 keys, in the family of a task definition, in an image's tag and in links.

ECS takes letters, digits, `-` and `_` in a family (API_RegisterTaskDefinition); ECR takes these and `.` in a tag. No
DNS name holds a project's id. Our own folders in the bucket begin with `_`, so no id does; a registration also refuses
`SSL`, the folder of the certificates.
"""
_HOST = re.compile(r"(?!xn--)[a-z0-9](?:[a-z0-9_-]{0,61}[a-z0-9])?")
_WARM_ID = re.compile(r"~[0-9a-f]{20}")
_SERVER_NAME = re.compile(r"(s[a-z2-7]{20})-([1-9][0-9]{0,2})")
_DELAYED = "-delay"


def is_project_id(text: object) -> bool:
    """Return whether `text` can be a project's id: 1 to 64 letters, digits, dashes and underscores, with no underscore
    at the beginning.
    """
    return isinstance(text, str) and PROJECT_ID.fullmatch(text) is not None


def is_user_id(text: object) -> bool:
    """Return whether `text` can be a participant's id: 1 to 64 letters, digits, dashes and underscores."""
    return isinstance(text, str) and NAME.fullmatch(text) is not None


def warm_id(project_id: str, requested: datetime, number: int) -> str:
    """Return the user id in the record of this warm server. It is no valid participant's id, so no link can name it."""
    return "~" + hashlib.sha256(f"warm\0{project_id}\0{requested.isoformat()}\0{number}".encode()).hexdigest()[:20]


def is_warm_id(text: object) -> bool:
    """Return whether this user id is a warm server's."""
    return isinstance(text, str) and _WARM_ID.fullmatch(text) is not None


def new_session_id() -> str:
    """Return a new random id of a session or a proposal. It is no valid participant's id, so no link names it."""
    return f"s.{secrets.token_hex(10)}"


@functools.lru_cache(maxsize=1024)  # a request needs a label several times, and base32 is Python code
def server_label(project_id: str, user_id: str) -> str:
    """Return the label of a participant's servers: a hash, because ids are personal data and DNS ignores case.

    It has 21 characters of `[a-z2-7]`, the first a letter. Its 100 bits tell a million participants apart.
    """
    digest = hashlib.sha256(f"server\0{project_id}\0{user_id}".encode()).digest()
    return "s" + base64.b32encode(digest).decode().lower()[:20]


def server_name(label: str, attempt: int) -> str:
    """Return the name of one attempt of a server: its DNS label, its task's `startedBy`, and its timer's name."""
    return f"{label}-{attempt}"


def parse_server_name(name: str) -> tuple[str, int] | None:
    """Return the label and the attempt in a server's name; None if this is no server's name."""
    match = _SERVER_NAME.fullmatch(name)
    return (match[1], int(match[2])) if match else None


def delayed_timer(name: str) -> str:
    """Return the name of a server's second timer: it stops the server after the `delay` of a stop request."""
    return name + _DELAYED


def timer_server(timer: str) -> str:
    """Return the name of the server that this timer stops. A server may have two timers."""
    return timer.removesuffix(_DELAYED)


def first_label(domain_name: str) -> str:
    """Return the first label of a DNS name. In a server's DNS name this is the server's name by default."""
    return domain_name.partition(".")[0]


def is_host_label(text: str) -> bool:
    """Return whether a server's DNS name may begin with this label: it is valid, and no server's default name.

    A label has at most 63 bytes (RFC 1035, 2.3.4); for a longer one Route 53 refuses a whole batch of changes
    (DomainLabelTooLong). Route 53 takes any printable character and stores letters in lower case (Route 53 Developer
    Guide, "DNS domain name format"). Browsers are stricter: a label that begins or ends with a dash is no host (RFC
    952), and one that begins with `xn--` has to be Punycode (RFC 5890).
    """
    return _HOST.fullmatch(text) is not None and parse_server_name(text) is None


def group(project_id: str, user_id: str, variants: int) -> int:
    """Return the participant's group, 0 to `variants` - 1. It never changes, and all groups are equally likely.

    `variants` is the number of a page's versions. A participant has the same group at all steps with this number. The
    groups for different numbers are independent.
    """
    digest = hashlib.sha256(f"group\0{variants}\0{project_id}\0{user_id}".encode()).digest()
    return int.from_bytes(digest[:16], "big") % variants


def ticket(secret: str, user_id: str, step: str, shown: str = "") -> str:
    """Return the ticket in a page's form, which proves that this participant was shown this step.

    `shown` says more of the showing, if that matters: the number of the try and the time. The ticket is 32 hex digits
    of an HMAC with the project's `secret`.
    """
    text = "\0".join(("ticket", user_id, step, *filter(None, [shown])))
    return hmac.new(secret.encode(), text.encode(), hashlib.sha256).hexdigest()[:32]


def link_signature(secret: str, project_id: str, user_id: str) -> str:
    """Return the signature in a participant's link, which proves that the participant is invited.

    It is 32 hex digits of an HMAC with the project's `secret`.
    """
    return hmac.new(secret.encode(), f"link\0{project_id}\0{user_id}".encode(), hashlib.sha256).hexdigest()[:32]


def completion_code(secret: str, user_id: str, outcome: str = "") -> str:
    """Return the code that a participant gives to the recruiter: 10 characters of an HMAC with the project's `secret`.

    Each `outcome`, such as `unmatched`, gives another code.
    """
    about = f"completion\0{user_id}" + (f"\0{outcome}" if outcome else "")
    digest = hmac.new(secret.encode(), about.encode(), hashlib.sha256).digest()
    return base64.b32encode(digest).decode()[:10]


def secrets_equal(secret: str, expected: str) -> bool:
    """Return whether a given secret, which may hold any characters, is the expected one. Takes constant time."""
    return hmac.compare_digest(secret.encode("utf-8", "replace"), expected.encode())
