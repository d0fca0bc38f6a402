"""`sign_requests`: a server shows its credential, and gets presigned requests for its own documents and no others.

Servers run researchers' code and have no rights of their own on AWS. What one needs of the bucket it asks for here:
the certificate; whose it has become, if it waited for a participant; what its participant's earlier servers recorded;
and the creation of the answers of its game steps and of its own recordings. The credential is derived from the
installation's secret (`secret.py`) and is not the token, which the participant's browser knows.

What a server may do follows from its record. When that is closed the server may still store what it has, for as long as
a task has to end: an answer that was earned before the stop message is not lost.

    {"server": "s…-1", "credential": "…", "requests": [{"method": "PUT", "key": "…", "size": 9}, …]}
    {"seconds": 60, "requests": [{"method": "PUT", "url": "…", "headers": {…}}, …]}
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from enum import Enum
from typing import Any, NamedTuple, Protocol

import msgspec

from hippodrome.certificates.rules import place
from hippodrome.http import Request, Response
from hippodrome.log import logger
from hippodrome.model import ids, participant, server, warm_pool
from hippodrome.model.server import Server, State
from hippodrome.ports import Documents, Settings
from hippodrome.storage.repository import Repository
from hippodrome.storage.secret import Secrets

SECONDS = 60  # how long a request is good for; S3 asks only when it begins, and who gets one uses it at once
STORING = timedelta(minutes=5)  # after the end: a task has two minutes to end, once it has heard of it
MOST_REQUESTS = 20
MOST_BODY = 32 * 1024  # bytes
LARGEST_ANSWER = 64 * 1024  # bytes
LARGEST_RECORDING = 5 * 1024**3  # bytes; S3 takes no more in one PUT
MOST_RECORDED = 20 * 1024**3  # bytes of all recordings of one server: what the disk of a Fargate task holds
MOST_RECORDINGS = 2_000  # of one server

_RECORDING = re.compile(r"([A-Za-z0-9_-]{1,64})-(?:trial|episode-[0-9]{4,6})(?:-[1-9][0-9]?)?\.jsonl\.gz")


class Presigned(NamedTuple):
    """One HTTP request that whoever holds it may make, as often as they like until it expires, and no other.

    The headers must be sent exactly as they are. It is a secret: neither it nor its parts belong in a log.
    """

    method: str
    url: str
    headers: Mapping[str, str]


class Signer(Protocol):
    """Presigned requests for single documents. They can do no more than who signs them; making one is no call.

    Answers are S3's: 200; 404 for a document that is not there, 412 for one that is there already, 409 while another
    write of it is under way; 403 if the request has expired, or is another one than was signed.
    """

    def reading(self, key: str, seconds: int) -> Presigned:
        """A GET of the document, good for so many seconds."""

    def creating(self, key: str, size: int, seconds: int) -> Presigned:
        """A PUT of a document of so many bytes that does not exist yet, good for so many seconds."""


class SigningPlatform(Protocol):
    """What this needs of the platform. On one machine servers write into the data folder, and nothing is signed."""

    @property
    def documents(self) -> Documents: ...
    @property
    def signer(self) -> Signer: ...
    @property
    def settings(self) -> Settings: ...
    def now(self) -> datetime: ...


class Method(Enum):
    GET = "GET"
    PUT = "PUT"


class Wish(msgspec.Struct, frozen=True):
    """One request that a server wants to make. A PUT has the number of its bytes."""

    method: Method
    key: str
    size: int | None = None


class Wishes(msgspec.Struct, frozen=True):
    """What a server sends."""

    server: str
    credential: str
    requests: list[Wish]


class Refusal(Exception):
    """An HTTP status and a sentence, which holds nothing of what was asked."""

    def __init__(self, status: int, text: str) -> None:
        super().__init__(text)
        self.status = status
        self.text = text


@dataclass(frozen=True)
class Seat:
    """Whose the server is: what it may read and create follows from this alone. Pure.

    `name` is its own: in ECS, and in its credential. `server` is what its recordings lie under; of a warm server
    for a participant it is empty.
    """

    name: str
    project_id: str
    user_id: str = ""
    label: str = ""
    attempt: int = 0
    game_steps: Sequence[str] = ()
    closed: datetime | None = None
    certificate: Sequence[str] = ()  # the keys of its two files

    @property
    def waits(self) -> bool:
        """Whether it has no participant."""
        return not self.user_id

    @property
    def folder(self) -> str:
        """Where its recordings lie."""
        return f"{self._recordings}{ids.server_name(self.label, self.attempt)}/"

    @property
    def _recordings(self) -> str:
        return f"{participant.folder(self.project_id, self.user_id)}trials/"

    def is_open(self, now: datetime) -> bool:
        """Whether it may still ask for anything."""
        return self.closed is None or (not self.waits and now < self.closed + STORING)

    def may(self, wish: Wish) -> bool:
        """Whether the wish is for one of its own documents."""
        if wish.method is Method.GET:
            return self.closed is None and self._may_read(wish.key)
        if self.waits or wish.size is None or wish.size < 0:
            return False
        if self._is_answer(wish.key):
            return wish.size <= LARGEST_ANSWER
        return self.is_recording(wish.key) and wish.size <= LARGEST_RECORDING

    def is_recording(self, key: str) -> bool:
        """Whether the key is one of its own recordings'."""
        return not self.waits and key.startswith(self.folder) and self._names_recording(key.removeprefix(self.folder))

    def _may_read(self, key: str) -> bool:
        if key in self.certificate or key == warm_pool.handover_key(self.project_id, self.name):
            return True
        return not self.waits and (self._is_answer(key) or self._is_earlier(key))

    def _is_answer(self, key: str) -> bool:
        return any(key == participant.answer_key(self.project_id, self.user_id, step) for step in self.game_steps)

    def _is_earlier(self, key: str) -> bool:
        """Whether it is a recording of one of the participant's servers before this one."""
        if not key.startswith(self._recordings):
            return False
        name, _, file = key.removeprefix(self._recordings).partition("/")
        label, attempt = ids.parse_server_name(name) or ("", 0)
        return label == self.label and attempt < self.attempt and self._names_recording(file)

    def _names_recording(self, file: str) -> bool:
        found = _RECORDING.fullmatch(file)
        return found is not None and found[1] in self.game_steps


def seat(record: Server, name: str, certificate: Sequence[str]) -> Seat | None:
    """What this participant's record says of the server of that name; None if it never had it."""
    common = {"project_id": record.project_id, "user_id": record.user_id, "label": record.label}
    for run in (server.run(record), *record.earlier):
        if (run.warm_server or ids.server_name(record.label, run.attempt)) == name:
            return Seat(
                name,
                **common,
                attempt=run.attempt,
                game_steps=run.game_steps,
                closed=run.closed,
                certificate=certificate,
            )
    return None


def nonce(record: Server, attempt: int) -> str | None:
    """What the credential of that attempt was made with; None if the record knows of none."""
    runs = (server.run(record), *record.earlier)
    return next((run.nonce for run in runs if run.attempt == attempt and run.nonce), None)


class Signing:
    """Answers servers. One per running function."""

    def __init__(self, platform: SigningPlatform) -> None:
        self._platform = platform
        self._repository = Repository(platform.documents)
        self._secrets = Secrets(platform.documents)

    def respond(self, request: Request) -> Response:
        """A read of the record; two for a server that has waited, and a listing for who announces a recording."""
        try:
            wishes = _read(request)
            asking = self._who(wishes)
            signed = self._sign(asking, wishes.requests)
        except Refusal as refusal:
            return _json(refusal.status, {"message": refusal.text})
        requests = [{"method": one.method, "url": one.url, "headers": dict(one.headers)} for one in signed]
        return _json(200, {"seconds": SECONDS, "requests": requests})

    def _who(self, wishes: Wishes) -> Seat:
        """Whose the server is that shows this credential. Raises `Refusal`, the same for all that is wrong with it."""
        stranger = Refusal(403, "That is not the credential of a server that may store anything now.")
        label, attempt = ids.parse_server_name(wishes.server) or ("", 0)
        secret = self._secrets.find() if label else None
        stored = self._repository.server(label) if secret else None
        made_with = nonce(stored.server, attempt) if stored else None
        if secret is None or stored is None or made_with is None:
            raise stranger
        if not ids.same(wishes.credential, secret.credential(wishes.server, made_with)):
            raise stranger
        found = self._seat(stored.server, wishes.server)
        if found is None or not found.is_open(self._platform.now()):
            logger.info("a server that is over asks for requests", extra={"server": wishes.server})
            raise stranger
        return found

    def _seat(self, record: Server, name: str) -> Seat | None:
        lies = place(record.domain, self._platform.settings.root_domain)
        certificate = (lies.fullchain, lies.privkey)
        if not record.is_warm_server:
            return seat(record, name, certificate)
        if record.taken_by is not None:
            heir = self._repository.server(record.taken_by)
            return seat(heir.server, name, certificate) if heir else None
        if record.is_closed or record.state is State.DRAINING:
            return None
        return Seat(name, record.project_id, certificate=certificate)

    def _sign(self, asking: Seat, wishes: Sequence[Wish]) -> list[Presigned]:
        """Raises `Refusal`, and signs nothing, if one of the wishes is not for this server."""
        if not all(asking.may(wish) for wish in wishes):
            logger.warning("a server asks for what is not its own", extra={"server": asking.name})
            raise Refusal(403, "That is none of this server's documents.")
        announced = [wish.size or 0 for wish in wishes if wish.method is Method.PUT and asking.is_recording(wish.key)]
        if announced:
            stored = [entry.size for entry in self._platform.documents.list(asking.folder)]
            if len(stored) + len(announced) > MOST_RECORDINGS or sum(stored) + sum(announced) > MOST_RECORDED:
                logger.error("a server has stored too much", extra={"server": asking.name})
                raise Refusal(403, "This server has stored as much as one may.")
        signer = self._platform.signer
        return [
            signer.reading(wish.key, SECONDS)
            if wish.method is Method.GET
            else signer.creating(wish.key, wish.size or 0, SECONDS)
            for wish in wishes
        ]


def _json(status: int, data: Any) -> Response:
    """Data for a server; no page of another origin has any business here."""
    return Response(status, json.dumps(data), {"Content-Type": "application/json"})


def _read(request: Request) -> Wishes:
    """What a server sends, out of hostile bytes. Raises `Refusal`."""
    if request.method != "POST":
        raise Refusal(405, "Use POST.")
    if request.body is None or len(request.body) > MOST_BODY:
        raise Refusal(413, f"The body must be JSON of {MOST_BODY} bytes at most.")
    try:
        wishes = msgspec.json.decode(request.body, type=Wishes)
    except (ValueError, RecursionError):
        raise Refusal(400, "The body must be JSON with server, credential and requests.") from None
    if not 0 < len(wishes.requests) <= MOST_REQUESTS:
        raise Refusal(400, f"Ask for 1 to {MOST_REQUESTS} requests.")
    return wishes
