"""Knows the fields of a study link, in whatever spelling a recruiting site or a person wrote them. Pure."""

from __future__ import annotations

from dataclasses import replace

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
