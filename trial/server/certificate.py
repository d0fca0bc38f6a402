"""The certificate of an encrypted connection: fetched when the server starts, and again while it runs."""

from __future__ import annotations

import os
import ssl
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from trial.recordings.store import Store
from trial.settings import SettingsError, TrialSettings

RELOAD_SECONDS = 3600.0


class Pair(NamedTuple):
    """A chain and its key (PEM) that fit, and the two files they come from."""

    chain: bytes
    key: bytes
    files: tuple[bytes | None, bytes]


class Certificate:
    """A server's SSL context, and where its files are. `context` stays the same object.

    The key's file may hold its chain as well; those that Hippodrome orders do. That chain is used if the other file
    does not fit or is missing, because the two were read while a new certificate replaced them.
    """

    def __init__(self, settings: TrialSettings, store: Store) -> None:
        self._chain_key = settings.ssl_fullchain
        self._private_key = settings.ssl_privkey
        self._store = store
        self._files: tuple[bytes | None, bytes] | None = None
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_2

    def load(self) -> bool:
        """`fetch` and `use`, before there are connections; False if they are the ones in use. Blocks."""
        found = self.fetch()
        if found is not None:
            self.use(found)
        return found is not None

    def fetch(self) -> Pair | None:
        """The pair to use from now on; None if it is in use already. Blocks: not on the event loop.

        Raises SettingsError if a file is missing, ssl.SSLError if they do not fit, and the store's own errors.
        """
        with ThreadPoolExecutor(2) as both:  # each takes two round trips, and participants wait for the server
            chain, key = both.map(self._store.get, (self._chain_key, self._private_key))
        alone = key is not None and b"-----BEGIN CERTIFICATE" in key
        if key is None or (chain is None and not alone):
            raise SettingsError("the certificate's files are not where SSL_FULLCHAIN and SSL_PRIVKEY say")
        if (chain, key) == self._files:
            return None
        # Tried on a context of its own: OpenSSL forgets its key when it is given a chain that does not fit, and the
        # server would refuse every connection.
        trial = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            _load(trial, chain or key, key)
        except ssl.SSLError:
            if not alone:
                raise
            _load(trial, key, key)
            return Pair(key, key, (chain, key))
        return Pair(chain or key, key, (chain, key))

    def use(self, found: Pair) -> None:
        """Use it for connections from now on. On the event loop, once there are connections.

        Takes about a millisecond. In between the context has a chain and no key, and no client may connect.
        """
        _load(self.context, found.chain, found.key)
        self._files = found.files


def _load(context: ssl.SSLContext, chain: bytes, key: bytes) -> None:
    # load_cert_chain reads files only; these are the owner's alone (0700, 0600) and gone at once.
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, name) for name in ("chain.pem", "key.pem")]
        for path, data in zip(paths, (chain, key), strict=True):
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
                out.write(data)
        context.load_cert_chain(*map(str, paths))
