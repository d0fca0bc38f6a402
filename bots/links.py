"""Links of studies and participants."""

from __future__ import annotations

from urllib.parse import parse_qsl, urlencode, urlsplit, urlunsplit


def with_project(link: str, project_id: str) -> str:
    """The link of the study, if the address names only the machine."""
    parts = urlsplit(link)
    if parts.path not in ("", "/"):
        return link
    return urlunsplit(parts._replace(path="/next", query=urlencode({"projectId": project_id})))


def with_user(link: str, user_id: str) -> str:
    """A study's link for one participant."""
    parts = urlsplit(link)
    kept = [(name, value) for name, value in parse_qsl(parts.query) if name != "userId"]
    return urlunsplit(parts._replace(query=urlencode([*kept, ("userId", user_id)])))
