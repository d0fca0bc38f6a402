"""`sign_requests`: a server shows its credential and gets presigned requests for its own documents, and no others.

Servers run researchers' code and have no rights on AWS. With presigned requests a server may read the certificate, its
handover document if it is a warm server, and the recordings of its participant's earlier servers. It may create its
own recordings and the pieces of its tapes, create and read the answers of its game steps, and read those of the steps
that `answers` names. The credential is derived from the installation's secret (`secret.py`). It is not the token, which
the participant's browser knows.

A session's server may also read the session's document. Its answers are the answers of the members whom that document
names, and its recordings are the session's. With `matching: match`, as long as it has no members, it may read the
question to the function `match` of agent.py, and create the document of the answer.

A server's rights follow from its record. For some minutes after the record is closed, the server may still store data,
so that an answer given before the stop message is not lost.

    {"server": "s…-1", "credential": "…", "requests": [{"method": "PUT", "key": "…", "size": 9}, …]}
    {"seconds": 60, "requests": [{"method": "PUT", "url": "…", "headers": {…}}, …]}
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from enum import Enum
from typing import NamedTuple, Protocol

import msgspec

from hippodrome.control.certificates.rules import location
from hippodrome.control.http import Refusal, Request, Response
from hippodrome.control.log import logger
from hippodrome.control.model import ids, server
from hippodrome.control.model.server import Server, ServerState
from hippodrome.control.ports import Documents, Settings
from hippodrome.control.servers.credentials import answer_of, read_request, record_of, refused
from hippodrome.control.servers.sessions import members_of
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache
from hippodrome.protocol.keys import (
    QUESTION_ID,
    answer_key,
    groups_folder,
    groups_key,
    handover_key,
    recordings_folder,
    session_key,
    session_recordings_folder,
    waiting_key,
)
from hippodrome.protocol.session import assignment_key, is_session_id

VALID_SECONDS = 60  # a presigned request's life; S3 checks it when the request begins, and servers send it at once
STORE_AFTER_CLOSE = timedelta(minutes=5)  # a task has two minutes to end after SIGTERM
MAX_REQUESTS = 20  # the most requests that one call signs
MAX_BODY = 32 * 1024  # bytes
MAX_ANSWER = 64 * 1024  # bytes
MAX_RECORDING = 5 * 1024**3  # bytes; S3 takes no more in one PUT
MAX_RECORDED = 20 * 1024**3  # bytes of all recordings of one server: the size of a Fargate task's disk
MAX_RECORDINGS = 6_000  # the most recordings of one server, with the pieces of its tapes: one for 2 s of talk at most

_RECORDING = re.compile(
    r"([A-Za-z0-9_-]{1,64})-(?:(?:trial|episode-[0-9]{4,6})(?:-[1-9][0-9]?)?\.jsonl\.gz|talk-[0-9]{4,5}\.json)"
)


class Presigned(NamedTuple):
    """One HTTP request that its holder may send any number of times until it expires.

    The headers must be sent unchanged. It is a secret: neither it nor its parts belong in a log.
    """

    method: str
    url: str
    headers: Mapping[str, str]


class Signer(Protocol):
    """Makes presigned requests for single documents, without an AWS call. They have no more rights than the signer.

    S3 answers a presigned request with 200; a GET with 404 if the document does not exist; a PUT with 412 if it exists
    already, and 409 while another write of it is under way; both with 403 if the request has expired or was changed.
    """

    def presign_get(self, key: str, seconds: int) -> Presigned:
        """Return a GET of the document, valid for `seconds`."""

    def presign_put(self, key: str, size: int, seconds: int) -> Presigned:
        """Return a PUT that creates the document with exactly `size` bytes, valid for `seconds`."""


class SigningPlatform(Protocol):
    """The part of the platform that signing needs. On one machine nothing is signed: servers write into its folder."""

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


class DocumentRequest(msgspec.Struct, frozen=True):
    """One request that a server wants to send. A PUT has a size in bytes."""

    method: Method
    key: str
    size: int | None = None


class SigningRequest(msgspec.Struct, frozen=True):
    """What a server sends to `sign_requests`."""

    server: str
    credential: str
    requests: list[DocumentRequest]


@dataclass(frozen=True)
class ServerAccess:
    """The facts about a server that decide which documents it may read and create. Pure.

    `name` is the name under which ECS runs the server, and for which its credential is made. `label` and `attempt` are
    its owner's; the name of an assigned warm server has others. Until a warm server is assigned, only `name`,
    `project_id` and `certificate` are set. `user_id` may be a session's id; then `members` are the ids of the session's
    members, once it is formed.
    """

    name: str
    project_id: str
    user_id: str = ""
    label: str = ""
    attempt: int = 0
    game_steps: Sequence[str] = ()
    read_steps: Sequence[str] = ()  # whose answers its agent may read
    closed: datetime | None = None
    certificate: Sequence[str] = ()  # the keys of the certificate's two documents
    members: Sequence[str] = ()
    may_match: bool = False  # whether it may answer questions to `match` as long as it has no members

    @property
    def is_of_session(self) -> bool:
        """Whether it is the server of a session."""
        return is_session_id(self.user_id)

    @property
    def is_unassigned(self) -> bool:
        """Whether it is a warm server that is not assigned yet."""
        return not self.user_id

    @property
    def folder(self) -> str:
        """The prefix of its recordings."""
        return f"{self._recordings}{ids.server_name(self.label, self.attempt)}/"

    @property
    def _recordings(self) -> str:
        folder = session_recordings_folder if self.is_of_session else recordings_folder
        return folder(self.project_id, self.user_id)

    def is_open(self, now: datetime) -> bool:
        """Return whether presigned requests are still made for the server at this time."""
        return self.closed is None or (not self.is_unassigned and now < self.closed + STORE_AFTER_CLOSE)

    def allows(self, document_request: DocumentRequest) -> bool:
        """Return whether the server may send this request."""
        if document_request.method is Method.GET:
            return self.closed is None and self._allows_reading(document_request.key)
        if self.is_unassigned or document_request.size is None or document_request.size < 0:
            return False
        if self._is_answer(document_request.key, self.game_steps) or self._is_groups(document_request.key):
            return document_request.size <= MAX_ANSWER
        return self.is_recording(document_request.key) and document_request.size <= MAX_RECORDING

    def is_recording(self, key: str) -> bool:
        """Return whether this is the key of one of the server's own recordings."""
        return (
            not self.is_unassigned
            and key.startswith(self.folder)
            and self._names_recording(key.removeprefix(self.folder))
        )

    @property
    def _is_asked_to_match(self) -> bool:
        return self.may_match and self.is_of_session and not self.members and self.closed is None

    def _is_groups(self, key: str) -> bool:
        """Whether this is the key of an answer of the function `match`, and this server may write such an answer."""
        question = key.removeprefix(groups_folder(self.project_id)).removesuffix(".json")
        is_key = QUESTION_ID.fullmatch(question) is not None and key == groups_key(self.project_id, question)
        return self._is_asked_to_match and is_key

    def _allows_reading(self, key: str) -> bool:
        if self._is_asked_to_match and key == waiting_key(self.project_id):
            return True
        if key in self.certificate or key == handover_key(self.project_id, self.name):
            return True
        if self.is_of_session and key == session_key(self.project_id, self.user_id):
            return True
        if self.is_unassigned:
            return False
        is_answer = self._is_answer(key, (*self.game_steps, *self.read_steps))
        return is_answer or self._is_earlier(key) or key == self._assignment_key

    @property
    def _assignment_key(self) -> str:
        return assignment_key(self.project_id, self.user_id)

    def _is_answer(self, key: str, steps: Sequence[str]) -> bool:
        """Whether this is the key of an answer of its participant, or of a member of its session, to such a step."""
        players = self.members if self.is_of_session else (self.user_id,)
        return any(key == answer_key(self.project_id, user, step) for user in players for step in steps)

    def _is_earlier(self, key: str) -> bool:
        """Whether this is the key of a recording of an earlier server of the same participant or session."""
        if not key.startswith(self._recordings):
            return False
        name, _, file = key.removeprefix(self._recordings).partition("/")
        label, attempt = ids.parse_server_name(name) or ("", 0)
        return label == self.label and attempt < self.attempt and self._names_recording(file)

    def _names_recording(self, file: str) -> bool:
        match = _RECORDING.fullmatch(file)
        return match is not None and match[1] in self.game_steps


def access_of(record: Server, name: str, certificate: Sequence[str]) -> ServerAccess | None:
    """Return what the server of this name may read and create, according to its owner's record.

    The result is None if the record has no server of this name.
    """
    for run in (server.past_attempt(record), *record.earlier):
        if (run.warm_server_name or ids.server_name(record.label, run.attempt)) == name:
            return ServerAccess(
                name,
                record.project_id,
                record.user_id,
                record.label,
                attempt=run.attempt,
                game_steps=run.game_steps,
                read_steps=run.read_steps,
                closed=run.closed,
                certificate=certificate,
                may_match=record.may_match,
            )
    return None


class Signing:
    """Answers the requests of servers. Each running function has one `Signing`."""

    def __init__(self, platform: SigningPlatform) -> None:
        self._platform = platform
        self._repository = Repository(platform.documents)
        self._secrets = SecretCache(platform.documents)

    def respond(self, request: Request) -> Response:
        """Respond to one HTTP request with presigned requests, or with a status and a sentence.

        AWS calls: one read of the server's record, two for an assigned warm server; one of the session's document, if
        it is a session's server; one listing, if the server wants to create a recording.
        """
        try:
            asked = _read(request)
            access = self._authenticate(asked)
            signed = self._sign(access, asked.requests)
        except Refusal as refusal:
            return answer_of(refusal.status, {"message": refusal.text})
        requests = [
            {"method": presigned.method, "url": presigned.url, "headers": dict(presigned.headers)}
            for presigned in signed
        ]
        return answer_of(200, {"seconds": VALID_SECONDS, "requests": requests})

    def _authenticate(self, signing_request: SigningRequest) -> ServerAccess:
        """The access of the server with this credential. Raises the same `Refusal` for any mistake."""
        record = record_of(signing_request.server, signing_request.credential, self._repository, self._secrets)
        authenticate = self._access(record, signing_request.server)
        if authenticate is not None and authenticate.is_of_session:
            authenticate = replace(
                authenticate, members=members_of(self._repository, authenticate.project_id, authenticate.user_id)
            )
        if authenticate is None or not authenticate.is_open(self._platform.now()):
            logger.info("a server that has ended asked for requests", extra={"server": signing_request.server})
            raise refused()
        return authenticate

    def _access(self, record: Server, name: str) -> ServerAccess | None:
        keys = location(record.domain)
        certificate = (keys.fullchain, keys.privkey) if record.dns else ()
        if not record.is_warm_server:
            return access_of(record, name, certificate)
        if record.assigned_to is not None:
            owner = self._repository.server(record.assigned_to)
            return access_of(owner.server, name, certificate) if owner else None
        if record.is_closed or record.state is ServerState.DRAINING:
            return None
        return ServerAccess(name, record.project_id, certificate=certificate)

    def _sign(self, access: ServerAccess, document_requests: Sequence[DocumentRequest]) -> list[Presigned]:
        """Sign all requests. Raises `Refusal` and signs none if one of them is not allowed."""
        if not all(access.allows(document_request) for document_request in document_requests):
            logger.warning("a server asked for a document that is not its own", extra={"server": access.name})
            raise Refusal(403, "That is none of this server's documents.")
        announced = [
            document_request.size or 0
            for document_request in document_requests
            if document_request.method is Method.PUT and access.is_recording(document_request.key)
        ]
        if announced:
            stored = [entry.size for entry in self._platform.documents.list(access.folder)]
            if len(stored) + len(announced) > MAX_RECORDINGS or sum(stored) + sum(announced) > MAX_RECORDED:
                logger.error("a server has stored too much", extra={"server": access.name})
                raise Refusal(
                    403, f"A server may store {MAX_RECORDINGS} recordings and {MAX_RECORDED // 1024**3} GB, no more."
                )
        signer = self._platform.signer
        return [
            signer.presign_get(document_request.key, VALID_SECONDS)
            if document_request.method is Method.GET
            else signer.presign_put(document_request.key, document_request.size or 0, VALID_SECONDS)
            for document_request in document_requests
        ]


def _read(request: Request) -> SigningRequest:
    """Parse the body, which may be hostile. Raises `Refusal`."""
    asked = read_request(request, SigningRequest, MAX_BODY, "server, credential and requests")
    if not 0 < len(asked.requests) <= MAX_REQUESTS:
        raise Refusal(400, f"Ask for 1 to {MAX_REQUESTS} requests.")
    return asked
