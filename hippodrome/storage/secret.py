"""The installation's secret: all that proves something to us is derived from it, each with a purpose of its own.

It lies in one document that only functions may read. Servers' records and the master list hold none of what is derived,
so who reads those (researchers do) can neither play in a participant's place, nor store anything as a server, nor make
tickets and links.
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

from hippodrome.model.records import Record, from_json, to_json
from hippodrome.ports import Conflict, Documents

if TYPE_CHECKING:
    from hippodrome.model.project import Project
    from hippodrome.model.server import Server

KEY = "_secret.json"
CACHE_SECONDS = 3600.0  # seconds; one that an administrator has replaced is known everywhere after that time
TRIES = 20


class Secret(Record, frozen=True):
    """`_secret.json`. `projects` has the secrets that stood in the master list in earlier versions; they stay valid."""

    secret: Annotated[str, msgspec.Meta(min_length=32)]  # one that was emptied by hand is none: it would be known
    projects: Mapping[str, str] = msgspec.field(default_factory=dict)

    def __repr__(self) -> str:
        return "Secret(…)"

    def derive(self, purpose: str, *about: str) -> str:
        """64 hex digits that only functions can make, others for each purpose and for whatever they are about."""
        text = "\0".join((purpose, *about))
        return hmac.new(self.secret.encode(), text.encode(), hashlib.sha256).hexdigest()

    def credential(self, name: str, nonce: str) -> str:
        """What the server of this name shows to get presigned requests. The participant's browser never sees it."""
        return self.derive("credential", name, nonce)

    def token(self, server: Server) -> str:
        """What opens this server to its participant; empty if nothing does."""
        if server.token or not server.nonce:
            return server.token
        return self.derive("token", server.name, server.nonce)[:48]

    def project_secret(self, project: Project) -> str:
        """What signs the project's tickets, links and completion codes."""
        kept = "" if project.salt else project.secret or self.projects.get(project.id)
        return kept or self.derive("project", project.id, project.salt)


class Secrets:
    """The installation's secret, read once an hour by each running function. One call, then none."""

    def __init__(self, documents: Documents) -> None:
        self._documents = documents
        self._lock = threading.Lock()
        self._cached: Secret | None = None
        self._fresh_until = 0.0

    def find(self) -> Secret | None:
        """The secret; None if nothing was derived from it yet."""
        with self._lock:
            if self._cached is None or monotonic() > self._fresh_until:
                document = self._documents.get(KEY)
                self._cached = from_json(document.body, Secret) if document else None
                self._fresh_until = monotonic() + CACHE_SECONDS
            return self._cached

    def get_or_create(self) -> Secret:
        """The secret, which is made if there is none yet."""
        found = self.find()
        while found is None:
            with contextlib.suppress(Conflict):  # somebody else was faster
                self._documents.create(KEY, to_json(Secret(os.urandom(32).hex())))
            found = self.find()
        return found

    def token(self, server: Server) -> str:
        """What opens this server to its participant; empty if nothing does. No call if no secret is needed for that."""
        if server.token or not server.nonce:
            return server.token
        found = self.find()
        return found.token(server) if found else ""

    def with_secret(self, project: Project) -> Project:
        """The project with its secret, which its entry of the master list does not hold. Raises LookupError."""
        if project.secret and not project.salt:
            return project
        found = self.find()
        if found and not project.salt and project.id not in found.projects:
            self._invalidate()  # the project's own may have been taken over since
            found = self.find()
        if found is None:
            raise LookupError(f"{KEY} is gone; the bucket keeps older versions: put the last one in its place")
        return msgspec.structs.replace(project, secret=found.project_secret(project))

    def add_project_secrets(self, found: Mapping[str, str]) -> None:
        """Keep secrets of projects that stood in the master list. Raises `Conflict` if it never settles."""
        for _ in range(TRIES if found else 0):
            self.get_or_create()
            document = self._documents.get(KEY)
            before = from_json(document.body, Secret) if document else None
            if document is None or before is None:
                continue
            after = msgspec.structs.replace(before, projects={**before.projects, **found})
            with contextlib.suppress(Conflict):
                if after != before:
                    self._documents.replace(KEY, to_json(after), document.etag)
                with self._lock:
                    self._cached = after
                return
        if found:
            raise Conflict(KEY)

    def _invalidate(self) -> None:
        with self._lock:
            self._cached = None
