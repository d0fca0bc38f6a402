"""The certificate of the server's TLS: fetched when the server starts, and again while it runs."""

from __future__ import annotations

import os
import ssl
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from hippodrome.trial.recordings.store import Store
from hippodrome.trial.settings import SettingsError, TrialSettings

RELOAD_SECONDS = 3600.0


class CertificatePair(NamedTuple):
    """A certificate chain and a key (PEM) that fit each other, and the contents of the two files that held them."""

    chain: bytes
    key: bytes
    files: tuple[bytes | None, bytes]


class Certificate:
    """A server's certificate, and the SSL context with it. `context` stays the same object.

    The key's file may hold the chain, too, as in the certificates that Hippodrome orders. This chain is used if the
    chain's own file is missing or does not fit, because the files were read while a new certificate replaced them.
    """

    def __init__(self, settings: TrialSettings, store: Store) -> None:
        self._chain_key = settings.ssl_fullchain
        self._private_key = settings.ssl_privkey
        self._store = store
        self._files: tuple[bytes | None, bytes] | None = None
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_2

    def load(self) -> bool:
        """Fetch the certificate and use it, before there are connections. Return False if it is in use already.

        It blocks, and raises as `fetch` does.
        """
        fetched = self.fetch()
        if fetched is not None:
            self.use(fetched)
        return fetched is not None

    def fetch(self) -> CertificatePair | None:
        """Fetch the files, and return the chain and key to use; None if they are in use already. It blocks.

        Raises SettingsError if a file is missing, ssl.SSLError if the files do not fit, and the store's errors.
        """
        with ThreadPoolExecutor(2) as pool:  # both files at once: each takes two round trips, and participants wait
            chain, key = pool.map(self._store.get, (self._chain_key, self._private_key))
        key_has_chain = key is not None and b"-----BEGIN CERTIFICATE" in key
        if key is None or (chain is None and not key_has_chain):
            raise SettingsError("the certificate's files are not where SSL_FULLCHAIN and SSL_PRIVKEY say")
        if (chain, key) == self._files:
            return None
        # Tried on another context: if OpenSSL is given a chain that does not fit, the context loses its key, and the
        # server would refuse every connection.
        probe = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        try:
            _load(probe, chain or key, key)
        except ssl.SSLError:
            if not key_has_chain:
                raise
            _load(probe, key, key)
            return CertificatePair(key, key, (chain, key))
        return CertificatePair(chain or key, key, (chain, key))

    def use(self, pair: CertificatePair) -> None:
        """Use the pair for connections from now on. Once the server listens, call it on the event loop only.

        It takes about a millisecond, in which the context has a chain without its key: no client may connect then.
        """
        _load(self.context, pair.chain, pair.key)
        self._files = pair.files


def _load(context: ssl.SSLContext, chain: bytes, key: bytes) -> None:
    # load_cert_chain reads files only. These can be read by this user alone (0700, 0600), and are deleted at once.
    with tempfile.TemporaryDirectory() as folder:
        paths = [Path(folder, name) for name in ("chain.pem", "key.pem")]
        for path, data in zip(paths, (chain, key), strict=True):
            with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
                out.write(data)
        context.load_cert_chain(*map(str, paths))
