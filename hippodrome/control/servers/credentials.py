"""A server's credential: it proves to a function that a request comes from this server's task."""

from __future__ import annotations

from hippodrome.control.http import Refusal
from hippodrome.control.model import ids, server
from hippodrome.control.model.server import Server
from hippodrome.control.storage.repository import Repository
from hippodrome.control.storage.secret import SecretCache


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
