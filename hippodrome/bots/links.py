"""Links of studies and participants."""

from __future__ import annotations

from collections.abc import Mapping
from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit


def with_project(link: str, project_id: str) -> str:
    """Return the study's link.

    It is the link itself, or `/next?projectId=…` below it if it names only a host and a port.
    """
    parts = urlsplit(link)
    if parts.path not in ("", "/"):
        return link
    return urlunsplit(parts._replace(path="/next", query=urlencode({"projectId": project_id})))


def with_fields(link: str, fields: Mapping[str, str]) -> str:
    """Return the link with more fields."""
    parts = urlsplit(link)
    return urlunsplit(parts._replace(query=urlencode([*parse_qsl(parts.query), *fields.items()])))


def with_user(link: str, user_id: str) -> str:
    """Return the study's link for one participant: with this `userId`, whether the link had one or not."""
    parts = urlsplit(link)
    others = [(name, value) for name, value in parse_qsl(parts.query) if name != "userId"]
    return urlunsplit(parts._replace(query=urlencode([*others, ("userId", user_id)])))
