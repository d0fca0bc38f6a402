"""A store of presigned requests: the server has no rights of its own, and asks for each request that it makes.

It shows its credential to `sign_requests` (docs/functions.md) and gets one HTTP request for one document, to be sent
to S3: a GET of a document of its own, or a PUT that creates one and overwrites nothing. A request is used at once;
one that has expired nevertheless, on a machine that stood still, is asked for again. No clock of this machine is
compared with another's.
"""

from __future__ import annotations

import contextlib
import http.client
import json
import ssl
import time
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, BinaryIO
from urllib.parse import urlsplit

TIMEOUT = 20.0  # seconds without a byte
PAUSES = (0.3, 1.0, 2.0, 4.0)  # seconds between attempts after a transient error
LARGEST_REPLY = 64 * 1024  # bytes, of `sign_requests`
_TRANSIENT = (400, 403, 408, 409, 429)
"""And 500 and above. 403 is S3's word for a request that has expired; 400 for one whose signer's own credentials have
(`ExpiredToken`), and for a connection on which nothing came for a while (`RequestTimeout`): S3 API Reference, "Error
responses"."""

Reply = tuple[int, bytes]


class StoreError(OSError):
    """The store does not answer, or refuses. The message holds no key, address or credential."""

    def __init__(self, words: str) -> None:
        super().__init__(0, words)


class PresignedStore:
    """Implements `trial.recordings.store.Store`.

    `server` and `credential` are those that this process was started with.
    """

    def __init__(self, url: str, server: str, credential: str, pause: Callable[[float], object] = time.sleep) -> None:
        self._url = url
        self._server = server
        self._credential = credential
        self._pause = pause
        self._kept: dict[str, Mapping[str, Any]] = {}  # presigned GETs that may still be valid, by key

    def get(self, key: str) -> bytes | None:
        """Retries transient errors for some seconds. Raises StoreError."""
        return self._with_retries(lambda: self._get(key))

    def look(self, key: str) -> bytes | None:
        """As `get`, of a document that is read again and again: its presigned request is used until S3 refuses it.

        Tries once. Raises StoreError.
        """
        kept = self._kept.pop(key, None)
        for request in (kept, None) if kept else (None,):
            signed = request or self._signed({"method": "GET", "key": key})
            status, body = _send(signed, None)
            if status in (200, 404):
                self._kept[key] = signed
                return body if status == 200 else None
            if request is None:
                raise _UnexpectedStatus(status)
        raise AssertionError

    def create(self, key: str, data: bytes | Path) -> bool:
        """Tries once: its callers try again (`spool.retry_forever`). Raises OSError."""
        size = data.stat().st_size if isinstance(data, Path) else len(data)
        request = self._signed({"method": "PUT", "key": key, "size": size})
        if isinstance(data, Path):
            with data.open("rb") as body:
                status, _ = _send(request, body)
        else:
            status, _ = _send(request, data)
        if status == 412:
            return False
        if status != 200:
            raise _UnexpectedStatus(status)
        return True

    def _get(self, key: str) -> bytes | None:
        status, body = _send(self._signed({"method": "GET", "key": key}), None)
        if status == 404:
            return None
        if status != 200:
            raise _UnexpectedStatus(status)
        return body

    def _signed(self, wish: Mapping[str, Any]) -> dict[str, Any]:
        """The request that the wish becomes. Raises StoreError."""
        asked = {"server": self._server, "credential": self._credential, "requests": [wish]}
        ask = {"method": "POST", "url": self._url, "headers": {"Content-Type": "application/json"}}
        status, body = _send(ask, json.dumps(asked).encode(), LARGEST_REPLY)
        if status != 200:
            raise _UnexpectedStatus(status)
        try:
            (request,) = json.loads(body)["requests"]
            return {"method": wish["method"], "url": str(request["url"]), "headers": dict(request["headers"])}
        except (ValueError, KeyError, TypeError):
            raise StoreError("who signs requests gave an answer that cannot be read") from None

    def _with_retries(self, act: Callable[[], bytes | None]) -> bytes | None:
        for pause in PAUSES:
            try:
                return act()
            except StoreError as error:
                if not getattr(error, "passing", True):
                    raise
            self._pause(pause)
        return act()


class _UnexpectedStatus(StoreError):
    """The answer has an unexpected status."""

    def __init__(self, status: int) -> None:
        super().__init__(f"the answer was HTTP {status}")
        self.passing = status in _TRANSIENT or status >= 500


def _send(request: Mapping[str, Any], body: bytes | BinaryIO | None, most: int | None = None) -> Reply:
    """One HTTP request on a connection of its own; redirections are not followed. Raises StoreError."""
    parts = urlsplit(request["url"])
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise StoreError("the address of the store is none")
    connection: http.client.HTTPConnection
    if parts.scheme == "https":
        connection = http.client.HTTPSConnection(parts.hostname, parts.port, timeout=TIMEOUT, context=_trust())
    else:
        connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=TIMEOUT)
    path = f"{parts.path or '/'}{'?' if parts.query else ''}{parts.query}"
    try:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            # A server that refuses may answer and hang up before it has the whole body. An answer counts.
            connection.request(request["method"], path, body=body, headers=dict(request["headers"]))
        answer = connection.getresponse()
        found = answer.read() if most is None else answer.read(most)
    except (OSError, http.client.HTTPException) as error:
        raise StoreError(f"no answer: {type(error).__name__}") from None  # its own words may hold the address
    finally:
        connection.close()
    return answer.status, found


@cache
def _trust() -> ssl.SSLContext:
    """Trusts the authorities of this system, which the image has from Debian's ca-certificates."""
    return ssl.create_default_context()
