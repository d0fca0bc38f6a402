"""Requests of servers: how functions read and answer them, and the credential that proves which server asks."""

from __future__ import annotations

import json
from typing import Any, TypeVar

from hippodrome.control.http import Refusal, Request, Response
from hippodrome.control.model import ids, server
from hippodrome.control.model.records import from_json
from hippodrome.control.model.server import Server
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache

T = TypeVar("T")


def read_request(request: Request, kind: type[T], most: int, fields: str) -> T:
    """Parse the body of a POST, which may be hostile. Raises `Refusal`.

    `most` is the longest body in bytes; `fields` names what it must have.
    """
    if request.method != "POST":
        raise Refusal(405, "Use POST.")
    if request.body is None or len(request.body) > most:
        raise Refusal(413, f"The body must be JSON of {most} bytes at most.")
    try:
        return from_json(request.body, kind)
    except ValueError:
        raise Refusal(400, f"The body must be JSON with {fields}.") from None


def answer_of(status: int, data: Any) -> Response:
    """Return a JSON response, without CORS headers: no page of another origin needs it."""
    return Response(status, json.dumps(data), {"Content-Type": "application/json"})


def credential_nonce(record: Server, attempt: int) -> str | None:
    """Return the nonce that the credential of this attempt is derived from; None if the record has none."""
    runs = (server.past_attempt(record), *record.earlier)
    return next((run.nonce for run in runs if run.attempt == attempt and run.nonce), None)


def record_of(name: str, credential: str, repository: Repository, secrets: SecretCache) -> Server:
    """Return the record under the label in this server's name. AWS calls: one; once more, the installation's secret.

    Raises `Refusal` unless the credential is the server's. The server may have ended.
    """
    label, attempt = ids.parse_server_name(name) or ("", 0)
    secret = secrets.find() if label else None
    stored = repository.server(label) if secret else None
    nonce = credential_nonce(stored.server, attempt) if stored else None
    if secret is None or stored is None or nonce is None:
        raise refused()
    if not ids.secrets_equal(credential, secret.credential(name, nonce)):
        raise refused()
    return stored.server


def refused() -> Refusal:
    """Return the same refusal for any mistake, so that nobody learns which servers there are."""
    return Refusal(403, "That is not the credential of a server that may store anything now.")
