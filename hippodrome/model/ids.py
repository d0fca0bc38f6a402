"""Names: which ids are well formed, what a server is called, which group a participant falls into."""

from __future__ import annotations

import base64
import hashlib
import hmac
import re
from datetime import datetime

PROJECT_ID = re.compile(r"[A-Za-z0-9-]{1,64}")
USER_ID = re.compile(r"[A-Za-z0-9_-]{1,64}")
_HOST = re.compile(r"(?!xn--)[a-z0-9](?:[a-z0-9_-]{0,61}[a-z0-9])?")
_WARM_ID = re.compile(r"~[0-9a-f]{20}")
_SERVER_NAME = re.compile(r"(s[a-z2-7]{20})-([1-9][0-9]{0,2})")
_DELAYED = "-delay"


def is_project_id(text: object) -> bool:
    """Letters, digits and dashes, 1 to 64."""
    return isinstance(text, str) and PROJECT_ID.fullmatch(text) is not None


def is_user_id(text: object) -> bool:
    """Letters, digits, dashes and underscores, 1 to 64."""
    return isinstance(text, str) and USER_ID.fullmatch(text) is not None


def warm_id(project_id: str, asked: datetime, number: int) -> str:
    """The id of a server that is started ahead of its participant. No link can name one: it is no `is_user_id`."""
    return "~" + hashlib.sha256(f"spare\0{project_id}\0{asked.isoformat()}\0{number}".encode()).hexdigest()[:20]


def is_warm_id(text: object) -> bool:
    """Whether this stands where a participant's id does, for a server that has no participant yet."""
    return isinstance(text, str) and _WARM_ID.fullmatch(text) is not None


def server_label(project_id: str, user_id: str) -> str:
    """What a participant's servers are called: a hash, because ids are personal data and DNS ignores case.

    21 characters of `[a-z2-7]`, the first a letter: 100 bits, so that a million participants do not meet.
    """
    digest = hashlib.sha256(f"server\0{project_id}\0{user_id}".encode()).digest()
    return "s" + base64.b32encode(digest).decode().lower()[:20]


def server_name(label: str, attempt: int) -> str:
    """The name of one attempt: its DNS label, its `startedBy`, its timer."""
    return f"{label}-{attempt}"


def parse_server_name(name: str) -> tuple[str, int] | None:
    """The label and attempt in a server's name; None for a name that is not of our making."""
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
    """Whether a server may be called so below the root domain: a fit first label that is no other server's own name.

    A label has at most 63 bytes (RFC 1035, 2.3.4), and Route 53 refuses a whole batch of changes for one that is longer
    (DomainLabelTooLong). It takes any printable character and stores letters in lower case (Route 53 Developer Guide,
    "DNS domain name format"); browsers are stricter: a label that begins or ends with a dash is no host (RFC 952), and
    one that begins with `xn--` has to be Punycode (RFC 5890).
    """
    return _HOST.fullmatch(text) is not None and parse_server_name(text) is None


def group(project_id: str, user_id: str, variants: int) -> int:
    """Which of `variants` groups a participant belongs to: always the same one, all equally likely, for any id.

    Steps with the same number of variants share the draw; steps with another number draw independently.
    """
    digest = hashlib.sha256(f"group\0{variants}\0{project_id}\0{user_id}".encode()).digest()
    return int.from_bytes(digest[:16], "big") % variants


def ticket(secret: str, user_id: str, step: str) -> str:
    """Proof, in a page's form, that we showed this participant this step. 32 hex digits of an HMAC."""
    return hmac.new(secret.encode(), f"ticket\0{user_id}\0{step}".encode(), hashlib.sha256).hexdigest()[:32]


def link_signature(secret: str, project_id: str, user_id: str) -> str:
    """Proof, in a link, that whoever holds the project's secret invited this participant. 32 hex digits of an HMAC."""
    return hmac.new(secret.encode(), f"link\0{project_id}\0{user_id}".encode(), hashlib.sha256).hexdigest()[:32]


def completion_code(secret: str, user_id: str) -> str:
    """The code a participant hands to the recruiter: 10 characters nobody can guess without the project's secret."""
    digest = hmac.new(secret.encode(), f"completion\0{user_id}".encode(), hashlib.sha256).digest()
    return base64.b32encode(digest).decode()[:10]


def secrets_equal(given: str, expected: str) -> bool:
    """Whether two secrets are equal, in constant time, whatever bytes the first one holds."""
    return hmac.compare_digest(given.encode("utf-8", "replace"), expected.encode())
