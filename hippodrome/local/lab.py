"""A lab's server: what `run --host` adds to a study on this machine, so that others of the network can take part.

Links are signed, so nobody can make up a participant. `/join/{id}` makes a new participant for each browser that opens
it, and leads to their signed link; `/lab` lists the studies. Both need a key, and nothing needs a cookie.
"""

from __future__ import annotations

import contextlib
import hmac
import secrets
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Any
from urllib.parse import urlencode

import psutil

from hippodrome.console.problem import Exit, Problem
from hippodrome.control import http
from hippodrome.control.http import Refusal, Request
from hippodrome.control.model import ids
from hippodrome.control.model.project import Project
from hippodrome.control.participants import forms, frame, links
from hippodrome.control.participants.frame import Html
from hippodrome.control.storage.secret import SecretCache
from hippodrome.local.backend.platform import LocalPlatform

EVERYWHERE = "0.0.0.0"  # noqa: S104 - a lab's server is there for other machines
_NOBODY = "/join"  # no participant's id, so that a key of `/join` signs nobody's link
RELAYS = ("/start", "/stop")  # paths whose forms may name the project
_OURS = ("key", "projectId", "userId", "signature")
Handler = Callable[[dict[str, Any], object], dict[str, Any]]


@dataclass(frozen=True)
class Host:
    """Where a lab's server listens (`bound`, an IPv4 address), and the name or address that browsers are told."""

    bound: str
    shown: str


def host_of(given: str) -> Host:
    """Find out where to listen for `--host`. Raises `Problem` if this machine has no such address."""
    if given == EVERYWHERE:
        return Host(EVERYWHERE, _own_address())
    try:
        address = socket.getaddrinfo(given, None, socket.AF_INET, socket.SOCK_STREAM)[0][4][0]
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.bind((address, 0))
    except OSError:
        raise Problem(
            f"This machine has no address {given}.",
            f"Its addresses are {', '.join(_addresses()) or 'none'}; --host {EVERYWHERE} listens on all of them.",
            exit_code=Exit.MISUSE,
        ) from None
    return Host(str(address), given)


def _own_address() -> str:
    """This machine's address in its network: the one from which it would reach others."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("198.51.100.1", 9))  # an address for documentation (RFC 5737); no packet is sent
            return str(probe.getsockname()[0])
        except OSError:  # no network leads there
            return next(iter(_addresses()), "127.0.0.1")


def _addresses() -> list[str]:
    """The IPv4 addresses of this machine that others may reach."""
    addresss = [
        one.address
        for net_if_addr in psutil.net_if_addrs().values()
        for one in net_if_addr
        if one.family == socket.AF_INET
    ]
    return [address for address in addresss if not address.startswith("127.")]


class Lab:
    """The links and pages of a lab's server. `url` is its address."""

    def __init__(self, platform: LocalPlatform, url: str, project_ids: Callable[[], Sequence[str]]) -> None:
        self._platform = platform
        self._url = url
        self._project_ids = project_ids

    @property
    def list_link(self) -> str:
        """The address of the list of studies."""
        return f"{self._url}/lab?{urlencode({'key': self._list_key})}"

    def link(self, project_id: str) -> str:
        """Return the address that makes a new participant of the study for each browser that opens it."""
        project = self._platform.project(project_id)
        return f"{self._url}/join/{project_id}?{urlencode({'key': _join_key(project) if project else ''})}"

    def functions(self, of_study: Mapping[str, Handler]) -> dict[str, Handler]:
        """Return the functions of the web server: those of a study, and the lab's own.

        They answer for the lab's studies alone, and not for others with data in the same folder.
        """
        ours = {name: self._only_ours(function) for name, function in of_study.items()}
        return {**ours, "join": self._join, "lab": self._show}

    def _only_ours(self, function: Handler) -> Handler:
        def only_ours(event: dict[str, Any], context: object) -> dict[str, Any]:
            if not _projects_of(event) <= {*self._project_ids()}:
                return _refused(404, "There is no such study here.")
            return function(event, context)

        return only_ours

    def _join(self, event: dict[str, Any], _context: object) -> dict[str, Any]:
        """Answer `/join/{projectId}`: lead to the signed link of a new participant, with the link's other fields."""
        request, named = Request.from_event(event), str(event["pathParameters"]["projectId"])
        project = self._platform.project(named) if named in self._project_ids() else None
        if project is None or not _same(request.query_value("key"), _join_key(project)):
            return _refused(403, "This link is not whole. Please ask for it again.")
        user_id = secrets.token_hex(12)
        signature = ids.link_signature(project.secret, project.id, user_id)
        own = {"projectId": project.id, "userId": user_id, "signature": signature}
        kept = [(name, value) for name, value in request.query or () if name not in _OURS]
        return http.see_other(f"/next?{urlencode([*own.items(), *kept])}").to_event()

    def _show(self, event: dict[str, Any], _context: object) -> dict[str, Any]:
        """Answer `/lab`: the list of the studies, for whoever holds its key."""
        if not _same(Request.from_event(event).query_value("key"), self._list_key):
            return _refused(403, "The list needs its key: open the link that the server has printed.")
        rows = [self._row(project) for name in self._project_ids() if (project := self._platform.project(name))]
        text = "Each browser that opens a study's link is a new participant. Scan the code, or copy the address."
        page = frame.message_page("Studies", text, more=Html("\n".join(rows)))
        return http.html(200, page.html, page.headers).to_event()

    def _row(self, project: Project) -> str:
        link = self.link(project.id)
        closed = "" if project.live else "<p>It is closed (<code>live: false</code>).</p>"
        shown = f'<p style="overflow-wrap: anywhere"><a href="{escape(link)}">{escape(link)}</a></p>'
        return (
            f"<h2>{escape(project.name or project.id)}</h2>{closed}{shown}{qr(link).svg_inline(scale=4, light='white')}"
        )

    @property
    def _list_key(self) -> str:
        return SecretCache(self._platform.documents).get_or_create().derive("lab")[:32]


def _projects_of(event: Mapping[str, Any]) -> set[str]:
    """The ids of projects that a request names, in whatever spelling: in its path, its query, or a relay's form."""
    request = links.respelled(Request.from_event(event))
    named: list[object] = [(event.get("pathParameters") or {}).get("projectId"), request.query_value("projectId")]
    if request.path in RELAYS and request.body:
        with contextlib.suppress(Refusal):  # the function refuses it itself
            named.append(forms.read(request).answers.get("projectId"))
    return {str(project_id) for project_id in named if project_id is not None}


def qr(link: str) -> Any:
    """Return the link as a QR code of segno."""
    import segno  # noqa: PLC0415 - a study for this machine alone needs no QR codes

    return segno.make(link, micro=False)


def _join_key(project: Project) -> str:
    return ids.link_signature(project.secret, project.id, _NOBODY)


def _same(given: str | None, right: str) -> bool:
    return hmac.compare_digest((given or "").encode(), right.encode())


def _refused(status: int, text: str) -> dict[str, Any]:
    page = frame.message_page("This does not open", text)
    return http.html(status, page.html, page.headers).to_event()
