"""The certificate of an encrypted connection: fetched when the server starts, and again while it runs."""

from __future__ import annotations

import os
import ssl
import tempfile
from pathlib import Path

from trial.settings import Settings, SettingsError
from trial.store import Store, open_store

RELOAD_SECONDS = 3600.0


class Certificate:
    """A server's SSL context, and the place its files come from. Methods block; `context` stays the same object."""

    def __init__(self, settings: Settings, store: Store) -> None:
        self._chain_key = settings.ssl_fullchain
        self._private_key = settings.ssl_privkey
        self._store = store if not settings.ssl_bucket else open_store(_place(settings.ssl_bucket))
        self._loaded: tuple[bytes, bytes] | None = None
        self.context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
        self.context.minimum_version = ssl.TLSVersion.TLSv1_2

    def load(self) -> bool:
        """Fetch the files and use them for connections from now on; False if they are the ones in use.

        The key's file may hold its chain as well, as the ones that Hippodrome orders do. That chain is used when the
        other file does not fit or is not there: then they were read while a new certificate took its place.

        Raises SettingsError if one is missing, ssl.SSLError if they do not fit, and the store's own errors; whatever
        it raises, the certificate in use stays in use.
        """
        chain, key = self._store.get(self._chain_key), self._store.get(self._private_key)
        alone = key is not None and b"-----BEGIN CERTIFICATE" in key
        chain = key if chain is None and alone else chain
        if chain is None or key is None:
            raise SettingsError("the certificate's files are not where SSL_FULLCHAIN and SSL_PRIVKEY say")
        if (chain, key) == self._loaded:
            return False
        # load_cert_chain reads files only; these are the owner's alone (0700, 0600) and gone at once.
        with tempfile.TemporaryDirectory() as folder:
            paths = [Path(folder, name) for name in ("chain.pem", "key.pem")]
            for path, data in zip(paths, (chain, key), strict=True):
                with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "wb") as out:
                    out.write(data)
            fitting = _fitting(paths[0], paths[1], alone)
            self.context.load_cert_chain(*fitting)
        self._loaded = (chain, key)
        return True


def _fitting(chain: Path, key: Path, alone: bool) -> tuple[str, ...]:
    """The files that fit: chain and key, or the key's file alone. Raises ssl.SSLError.

    Tried on a context of its own: OpenSSL forgets its key when it is given a chain that does not fit, and a server's
    context would then refuse every connection.
    """
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(str(chain), str(key))
    except ssl.SSLError:
        if not alone:
            raise
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(str(key))
        return (str(key),)
    return str(chain), str(key)


def _place(bucket: str) -> str:
    return bucket if bucket.startswith(("s3://", "/", ".")) else f"s3://{bucket}"
