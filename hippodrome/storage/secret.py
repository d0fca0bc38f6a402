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
from collections.abc import Mapping
from time import monotonic
from typing import TYPE_CHECKING, Annotated

import msgspec

from hippodrome.model import hippo_entry
from hippodrome.model.records import Record, from_json, to_json
from hippodrome.ports import Conflict, Documents

if TYPE_CHECKING:
    from hippodrome.model.project import Project
    from hippodrome.model.server import Server

KEY = "_secret.json"
CACHE_SECONDS = 3600.0  # if an administrator replaces the secret, all functions use the new one after this time
TRIES = 20  # for one change of the document


class Secret(Record, frozen=True):
    """`_secret.json`. `projects` holds the secrets that earlier versions kept in the master list; they stay valid."""

    secret: Annotated[str, msgspec.Meta(min_length=32)]  # everyone knows the empty text
    projects: Mapping[str, str] = msgspec.field(default_factory=dict)

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
        """Return the token with which the participant plays on this server; empty if there is none."""
        if server.token or not server.nonce:
            return server.token
        return self.derive("token", server.name, server.nonce)[:48]

    def project_secret(self, project: Project) -> str:
        """Return the key that signs the project's tickets, links and completion codes."""
        is_older = project.salt in ("", hippo_entry.SALT)  # it may have a secret that an earlier version stored
        stored = (project.secret or self.projects.get(project.id)) if is_older else ""
        return stored or self.derive("project", project.id, project.salt)


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
        found = self.find()
        while found is None:
            with contextlib.suppress(Conflict):  # another function has created it
                self._documents.create(KEY, to_json(Secret(os.urandom(32).hex())))
            found = self.find()
        return found

    def token(self, server: Server) -> str:
        """Return the token with which the participant plays on this server; "" if the server has none.

        AWS calls: at most one an hour; none for a record without a nonce.
        """
        if server.token or not server.nonce:
            return server.token
        found = self.find()
        return found.token(server) if found else ""

    def with_secret(self, project: Project) -> Project:
        """Return the project with its secret, which the master list does not hold.

        Raises LookupError if the document `_secret.json` is gone.
        """
        if project.secret and not project.salt:
            return project
        found = self.find()
        if found and not project.salt and project.id not in found.projects:
            self._invalidate()  # the project's secret may have been added since the document was read
            found = self.find()
        if found is None:
            raise LookupError(f"{KEY} is gone; the bucket keeps older versions: put the last one in its place")
        return msgspec.structs.replace(project, secret=found.project_secret(project))

    def add_project_secrets(self, found: Mapping[str, str]) -> None:
        """Store projects' secrets that were found in the master list, by project id.

        Raises `Conflict` after `TRIES` conflicts.
        """
        if not found:
            return
        for _ in range(TRIES):
            self.get_or_create()
            document = self._documents.get(KEY)
            if document is None:
                continue
            before = from_json(document.body, Secret)
            after = msgspec.structs.replace(before, projects={**before.projects, **found})
            with contextlib.suppress(Conflict):
                if after != before:
                    self._documents.replace(KEY, to_json(after), document.etag)
                with self._lock:
                    self._cached = after
                return
        raise Conflict(KEY)

    def _invalidate(self) -> None:
        with self._lock:
            self._cached = None
