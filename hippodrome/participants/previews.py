"""Requests that are no participant: what shows or fetches a link before a person has followed it.

They make no participant and start no server. Sources: Fetch and HTML Standards (`Sec-Purpose: prefetch`, and
`prefetch;prerender`), Chrome's and Safari's older `Purpose` and `X-Purpose`, Firefox's older `X-Moz`; MTurk's API
reference, "ExternalQuestion" (assignmentId of a HIT that is looked at before it is accepted). Mail scanners that pass
for browsers cannot be told from people.
"""

from __future__ import annotations

import re
from enum import Enum

from hippodrome.http import Request

NOT_ACCEPTED = "ASSIGNMENT_ID_NOT_AVAILABLE"
_PURPOSE = ("sec-purpose", "purpose", "x-purpose", "x-moz")  # headers

# Programs that draw a card for a link in a chat or index pages. Names, not pieces of names: Cubot makes phones.
_PROGRAMS = re.compile(
    r"(?<!cu)bot\b|crawler|spider\b|facebookexternalhit|facebookcatalog|meta-external|whatsapp/"
    r"|slack-imgproxy|skypeuripreview|bingpreview|google-pagerenderer|googleother|google-inspectiontool"
    r"|mastodon/|pleroma|embedly|iframely|vkshare|linkpreview|link preview|snap url preview",
    re.IGNORECASE,
)


class PreviewKind(Enum):
    """Which kind of preview a request is."""

    HIT = "a task that was not accepted yet"
    PREFETCH = "a browser that fetches what somebody might open"
    CARD = "a program that draws a card for a link"


def preview_kind(request: Request) -> PreviewKind | None:
    """Which kind of preview this is; None for a participant."""
    if request.method == "POST":
        return None
    if any(value == NOT_ACCEPTED for _, value in request.query or ()):
        return PreviewKind.HIT
    purposes = [request.headers.get(name, "").strip().lower() for name in _PURPOSE]
    if any(purpose.startswith(("prefetch", "prerender", "preview")) for purpose in purposes):
        return PreviewKind.PREFETCH
    return PreviewKind.CARD if _PROGRAMS.search(request.headers.get("user-agent", "")) else None
