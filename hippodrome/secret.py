"""The installation's secret: all that proves something to us is derived from it, each with a purpose of its own.

It lies in one document that only functions may read. Records and the master list hold none of what is derived, so who
reads those (researchers do) can neither play in a participant's place nor store anything as a server.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import secrets
import threading

from hippodrome.platform import Conflict, Documents
from hippodrome.records import Record, from_json, to_json

KEY = "_secret.json"


class Secret(Record, frozen=True):
    """`_secret.json`: created once, never changed."""

    secret: str

    def __repr__(self) -> str:
        return "Secret(…)"

    def derived(self, purpose: str, *about: str) -> str:
        """64 hex digits that only functions can make, others for each purpose and for whatever they are about."""
        text = "\0".join((purpose, *about))
        return hmac.new(self.secret.encode(), text.encode(), hashlib.sha256).hexdigest()

    def credential(self, name: str, nonce: str) -> str:
        """What the server of this name shows to get presigned requests. The participant's browser never sees it."""
        return self.derived("credential", name, nonce)


class Secrets:
    """The installation's secret, read once and kept for as long as the function lives. One call, then none."""

    def __init__(self, documents: Documents) -> None:
        self._documents = documents
        self._lock = threading.Lock()
        self._found: Secret | None = None

    def find(self) -> Secret | None:
        """The secret; None if nothing was derived from it yet."""
        with self._lock:
            if self._found is None:
                document = self._documents.get(KEY)
                self._found = from_json(document.body, Secret) if document else None
            return self._found

    def get(self) -> Secret:
        """The secret, which is made if there is none yet."""
        found = self.find()
        while found is None:
            with contextlib.suppress(Conflict):  # somebody else was faster
                self._documents.create(KEY, to_json(Secret(secrets.token_hex(32))))
            found = self.find()
        return found
