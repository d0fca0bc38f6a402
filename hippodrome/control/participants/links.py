"""Reads a study link: its fields in whatever spelling, and whether the request is a preview. Pure.

A preview is the request of a program or a browser that fetches a link before a person opens it. It creates no
participant and starts no server. Sources: Fetch and HTML Standards (`Sec-Purpose: prefetch`, and `prefetch;prerender`),
Chrome's and Safari's older `Purpose` and `X-Purpose`, Firefox's older `X-Moz`; MTurk's API reference,
"ExternalQuestion" (assignmentId of a HIT that is previewed before it is accepted). Mail scanners that pretend to be
browsers cannot be distinguished from participants.
"""

from __future__ import annotations

import re
from dataclasses import replace
from enum import Enum

from hippodrome.control.http import Request

OUR_FIELDS = {"projectId", "userId", "poll", "signature"}
"""The fields of a link that are not kept in the participant's record as the recruiter's."""
RECRUITER_IDS = ("PROLIFIC_PID", "workerId", "survey_code", "participantId")
"""The fields of recruiters' links (Prolific, MTurk, SONA, CloudResearch) that take the place of `userId`."""
IDS = ("userId", *RECRUITER_IDS)


def _plain(name: str) -> str:
    return name.lower().replace("_", "").replace("-", "")


_SPELLING = {_plain(name): name for name in ("projectId", "signature", *IDS)}


def respelled(request: Request) -> Request:
    """Return the request with the right spelling of each field that we read: `prolific_pid` becomes `PROLIFIC_PID`.

    A link that names its project, or its participant, in the right spelling keeps every other field as it is: such a
    field may be the recruiter's own.
    """
    query = request.query or ()
    names = {name for name, _ in query}
    spelling = {
        name: right
        for name in names
        if (right := _SPELLING.get(_plain(name))) and names.isdisjoint(IDS if right in IDS else (right,))
    }
    return (
        replace(request, query=tuple((spelling.get(name, name), value) for name, value in query))
        if spelling
        else request
    )


# Previews

NOT_ACCEPTED = "ASSIGNMENT_ID_NOT_AVAILABLE"
"""The `assignmentId` in MTurk's preview of a task that the worker has not accepted."""
_PURPOSE = ("sec-purpose", "purpose", "x-purpose", "x-moz")  # headers that say for what a browser fetches a page

# User agents of programs that show a card for a link in a chat, or index pages. "Cubot" is none: it makes phones.
_PROGRAMS = re.compile(
    r"(?<!cu)bot\b|crawler|spider\b|facebookexternalhit|facebookcatalog|meta-external|whatsapp/"
    r"|slack-imgproxy|skypeuripreview|bingpreview|google-pagerenderer|googleother|google-inspectiontool"
    r"|mastodon/|pleroma|embedly|iframely|vkshare|linkpreview|link preview|snap url preview",
    re.IGNORECASE,
)


class PreviewKind(Enum):
    """The kind of a preview."""

    HIT = "an MTurk task that is not accepted yet"
    PREFETCH = "a browser that fetches a link ahead"
    CARD = "a program that shows a card for a link"


def preview_kind(request: Request) -> PreviewKind | None:
    """Return the kind of preview that the request is; None if it is a participant's."""
    if request.method == "POST":
        return None
    if any(value == NOT_ACCEPTED for _, value in request.query or ()):
        return PreviewKind.HIT
    purposes = [request.headers.get(name, "").strip().lower() for name in _PURPOSE]
    if any(purpose.startswith(("prefetch", "prerender", "preview")) for purpose in purposes):
        return PreviewKind.PREFETCH
    return PreviewKind.CARD if _PROGRAMS.search(request.headers.get("user-agent", "")) else None
