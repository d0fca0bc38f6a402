"""The installation's secret, from which tokens, credentials and the projects' secrets are derived.

It is stored in one document, which only functions may read. Servers' records and the master list hold nothing that is
derived from it. So researchers, who may read those, can neither play as a participant, nor store documents as a server,
nor make tickets and links.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import threading
from time import monotonic
from typing import TYPE_CHECKING, Annotated

import msgspec

from hippodrome.control.model.records import Record, from_json, to_json
from hippodrome.control.ports import Conflict, Documents

if TYPE_CHECKING:
    from hippodrome.control.model.project import Project
    from hippodrome.control.model.server import Server

KEY = "_secret.json"
CACHE_SECONDS = 3600.0  # if an administrator replaces the secret, all functions use the new one after this time


class Secret(Record, frozen=True):
    """`_secret.json`."""

    secret: Annotated[str, msgspec.Meta(min_length=32)]  # everyone knows the empty text

    def __repr__(self) -> str:
        return "Secret(…)"

    def derive(self, purpose: str, *about: str) -> str:
        """Return 64 hex digits of an HMAC with the secret, different for each purpose and each `about`."""
        text = "\0".join((purpose, *about))
        return hmac.new(self.secret.encode(), text.encode(), hashlib.sha256).hexdigest()

    def credential(self, name: str, nonce: str) -> str:
        """Return the credential with which the server of this name gets presigned requests. No browser ever gets it."""
        return self.derive("credential", name, nonce)

    def token(self, server: Server) -> str:
        """Return the token with which the participant plays on this server; empty if it was never started."""
        return self.derive("token", server.name, server.nonce)[:48] if server.nonce else ""

    def project_secret(self, project: Project) -> str:
        """Return the key that signs the project's tickets, links and completion codes."""
        return self.derive("project", project.id, project.salt)


class SecretCache:
    """Reads the installation's secret. Each running function has one cache, which reads the document once an hour."""

    def __init__(self, documents: Documents) -> None:
        self._documents = documents
        self._lock = threading.Lock()
        self._cached: Secret | None = None
        self._fresh_until = 0.0

    def find(self) -> Secret | None:
        """Return the secret; None if none was created yet."""
        with self._lock:
            if self._cached is None or monotonic() > self._fresh_until:
                document = self._documents.get(KEY)
                self._cached = from_json(document.body, Secret) if document else None
                self._fresh_until = monotonic() + CACHE_SECONDS
            return self._cached

    def get_or_create(self) -> Secret:
        """Return the secret; if there is none, create it."""
        secret = self.find()
        while secret is None:
            with contextlib.suppress(Conflict):  # another function has created it
                self._documents.create(KEY, to_json(Secret(os.urandom(32).hex())))
            secret = self.find()
        return secret

    def token(self, server: Server) -> str:
        """Return the token with which the participant plays on this server; "" if it was never started.

        AWS calls: at most one an hour; none for a record without a nonce.
        """
        secret = self.find() if server.nonce else None
        return secret.token(server) if secret else ""

    def with_secret(self, project: Project) -> Project:
        """Return the project with its secret, which the master list does not hold.

        Raises LookupError if the document `_secret.json` is gone.
        """
        secret = self.find()
        if secret is None:
            raise LookupError(f"{KEY} is gone; the bucket keeps older versions: put the last one in its place")
        return msgspec.structs.replace(project, secret=secret.project_secret(project))
