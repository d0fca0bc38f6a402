"""The store of documents: a bucket, by presigned requests, or a folder. The keys are the same in both."""

from __future__ import annotations

import asyncio
import contextlib
import filecmp
import http.client
import json
import logging
import ssl
import time
from collections.abc import Awaitable, Callable, Mapping
from functools import cache, partial
from itertools import count
from pathlib import Path
from typing import Any, BinaryIO, Protocol, TypeVar
from urllib.parse import urlsplit

from hippodrome.protocol import disk
from hippodrome.protocol.keys import with_number

T = TypeVar("T")
log = logging.getLogger("trial")

_MAX_PAUSE = 20.0  # the longest pause between two attempts, in seconds

TIMEOUT = 20.0  # seconds for which a connection may be silent
PAUSES = (0.3, 1.0, 2.0, 4.0)  # seconds between attempts after a transient error
MAX_REPLY = 64 * 1024  # the most bytes that are read of an answer of `sign_requests`
_TRANSIENT = (400, 403, 408, 409, 429)
"""Statuses after which a request is tried again, as after 500 and above. S3 answers 403 if a presigned request has
expired, and 400 if the credentials of its signer have (`ExpiredToken`) or if no data came on a connection for a while
(`RequestTimeout`): S3 API Reference, "Error responses"."""
_UNCERTAIN = (500, 502, 504)
"""Statuses of a PUT that may have created the document."""

Reply = tuple[int, bytes]
"""The status and the body of an HTTP answer."""


class Store(Protocol):
    """Reads and creates documents. The methods block: do not call them on the event loop. They raise OSError."""

    def get(self, key: str) -> bytes | None:
        """Return the document; None if there is none."""
        ...

    def look(self, key: str) -> bytes | None:
        """Return the document as `get` does, without retries: for documents that are read every few seconds."""
        ...

    def create(self, key: str, data: bytes | Path) -> bool:
        """Create a document of bytes or of a file's content. If the key exists, return False and change nothing.

        A call that raised may have created the document. Then the next call for it returns True.
        """
        ...


def open_store(place: str, server: str = "", credential: str = "") -> Store:
    """Open the store that the variable STORE names: a bucket, by the address that signs requests, or a folder.

    `server` and `credential` are shown to that address.
    """
    if place.startswith(("https://", "http://")):
        return PresignedStore(place, server, credential)
    return FolderStore(Path(place).resolve())


def short_error(error: BaseException) -> str:
    """Describe a store's error for the log, without names of files and keys: these contain participants' ids."""
    kind = type(error).__name__
    return f"{kind}: {error.strerror}" if isinstance(error, OSError) else kind


async def store_file(store: Store, key: str, path: Path) -> None:
    """Store a closed recording under its key, or under the key with a number if that exists; then delete the file.

    After an error it tries again, without a limit.
    """
    for number in count(1):
        attempt = partial(asyncio.to_thread, store.create, with_number(key, number), path)
        if await retry_forever("store a recording", attempt):
            break
    path.unlink(missing_ok=True)


async def retry_forever(action: str, attempt: Callable[[], Awaitable[T]]) -> T:
    """Call `attempt` until it succeeds, with growing pauses, and return its result. The log says "cannot `action`"."""
    pause = 0.5
    while True:
        try:
            return await attempt()
        except Exception as error:  # noqa: BLE001 - whatever the store raises, the data must not be lost
            log.warning("cannot %s (%s); trying again in %g s", action, short_error(error), pause)
        await asyncio.sleep(pause)
        pause = min(2 * pause, _MAX_PAUSE)


class FolderStore:
    """A store of files in a folder. A file is created whole or not at all, and survives a power cut afterwards."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def get(self, key: str) -> bytes | None:
        try:
            return (self.folder / key).read_bytes()
        except FileNotFoundError:
            return None

    def look(self, key: str) -> bytes | None:
        return self.get(key)

    def create(self, key: str, data: bytes | Path) -> bool:
        path = self.folder / key
        disk.make_folder(path.parent)
        try:
            disk.create(path, data)
        except FileExistsError:  # the file may be of an earlier call, which then could not sync the folder
            return filecmp.cmp(path, data, shallow=False) if isinstance(data, Path) else path.read_bytes() == data
        return True


class StoreError(OSError):
    """The store does not answer, or refuses a request. The message contains no key, address or credential."""

    transient = True
    """Whether the same request may succeed later."""

    def __init__(self, words: str) -> None:
        super().__init__(0, words)


class PresignedStore:
    """A bucket, by presigned requests: the server has no rights in AWS, and gets a request for each access to S3.

    The server shows its credential to the function `sign_requests` (docs/functions.md), and gets one HTTP request for
    one document, which it sends to S3: a GET of a document of its own, or a PUT that creates one and overwrites
    nothing. It sends the request at once. If S3 says that the request has expired, for instance after the machine was
    suspended, the server gets a new one. The clock of this machine is never compared with another clock.

    `url` is the address of `sign_requests`. `server` and `credential` are the variables SERVER and CREDENTIAL of this
    process.
    """

    def __init__(self, url: str, server: str, credential: str, pause: Callable[[float], object] = time.sleep) -> None:
        self._url = url
        self._server = server
        self._credential = credential
        self._pause = pause
        self._gets: dict[str, Mapping[str, Any]] = {}  # presigned GETs that may still be valid, by key
        self._unconfirmed: set[str] = set()  # keys of documents that a PUT without a result may have created

    def get(self, key: str) -> bytes | None:
        """Return the document; None if there is none. Retries transient errors for some seconds. Raises StoreError."""
        for pause in PAUSES:
            try:
                return self._get(key)
            except StoreError as error:
                if not error.transient:
                    raise
            self._pause(pause)
        return self._get(key)

    def look(self, key: str) -> bytes | None:
        """Return a document that is read again and again; None if there is none. Raises StoreError.

        Its presigned request is used until S3 refuses it. Errors are not retried.
        """
        signed = self._gets.pop(key, None)
        reply = None if signed is None else _send(signed, None)
        if signed is None or reply is None or reply[0] not in (200, 404):
            signed = self._signed({"method": "GET", "key": key})
            reply = _send(signed, None)
        document = _document(reply)
        self._gets[key] = signed
        return document

    def create(self, key: str, data: bytes | Path) -> bool:
        """Create a document; return False if it exists. Raises OSError.

        Errors are not retried here: the callers do so (`retry_forever`). S3 may create a document although its
        answer is lost, and then refuses the next request for the same key. This call returns True then: a task on
        Fargate runs one process, so no other process creates this server's recordings. A request that is refused (403,
        503) has created nothing: a document that exists all the same is another one.
        """
        size = data.stat().st_size if isinstance(data, Path) else len(data)
        request = self._signed({"method": "PUT", "key": key, "size": size})
        try:
            status = _put(request, data)
        except StoreError:
            self._unconfirmed.add(key)
            raise
        if status in _UNCERTAIN:
            self._unconfirmed.add(key)
        if status not in (200, 412):
            raise _UnexpectedStatus(status)
        sent_before = key in self._unconfirmed
        self._unconfirmed.discard(key)
        return status == 200 or sent_before

    def _get(self, key: str) -> bytes | None:
        return _document(_send(self._signed({"method": "GET", "key": key}), None))

    def _signed(self, wish: Mapping[str, Any]) -> dict[str, Any]:
        """Return the presigned request for a method and a key; for a PUT also of a size in bytes. Raises StoreError."""
        payload = {"server": self._server, "credential": self._credential, "requests": [wish]}
        post = {"method": "POST", "url": self._url, "headers": {"Content-Type": "application/json"}}
        status, body = _send(post, json.dumps(payload).encode(), MAX_REPLY)
        if status != 200:
            raise _UnexpectedStatus(status)
        try:
            (request,) = json.loads(body)["requests"]
            return {"method": wish["method"], "url": str(request["url"]), "headers": dict(request["headers"])}
        except (ValueError, KeyError, TypeError):
            raise StoreError("sign_requests gave an answer that cannot be read") from None


class _UnexpectedStatus(StoreError):
    """The answer has an unexpected status."""

    def __init__(self, status: int) -> None:
        super().__init__(f"the answer was HTTP {status}")
        self.transient = status in _TRANSIENT or status >= 500


def _document(reply: Reply) -> bytes | None:
    """Return the document in the answer to a GET; None if there is none. Raises StoreError."""
    status, body = reply
    if status == 404:
        return None
    if status != 200:
        raise _UnexpectedStatus(status)
    return body


def _put(request: Mapping[str, Any], data: bytes | Path) -> int:
    """Send a PUT with these bytes or a file's content, and return the answer's status. Raises OSError."""
    if isinstance(data, bytes):
        return _send(request, data)[0]
    with data.open("rb") as body:
        return _send(request, body)[0]


def _send(request: Mapping[str, Any], body: bytes | BinaryIO | None, most: int | None = None) -> Reply:
    """Send one HTTP request on a connection of its own, and return the answer, `most` bytes of its body at most.

    Redirections are not followed. Raises StoreError.
    """
    parts = urlsplit(request["url"])
    if parts.scheme not in ("http", "https") or not parts.hostname:
        raise StoreError("the address of the store is not an http or https address")
    connection: http.client.HTTPConnection
    if parts.scheme == "https":
        connection = http.client.HTTPSConnection(parts.hostname, parts.port, timeout=TIMEOUT, context=_trust())
    else:
        connection = http.client.HTTPConnection(parts.hostname, parts.port, timeout=TIMEOUT)
    path = f"{parts.path or '/'}{'?' if parts.query else ''}{parts.query}"
    try:
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            # A server that refuses may answer and close before it has read the whole body. Then its answer counts.
            connection.request(request["method"], path, body=body, headers=dict(request["headers"]))
        answer = connection.getresponse()
        content = answer.read() if most is None else answer.read(most)
    except (OSError, http.client.HTTPException) as error:
        raise StoreError(f"no answer: {type(error).__name__}") from None  # its message may name the presigned address
    finally:
        connection.close()
    return answer.status, content


@cache
def _trust() -> ssl.SSLContext:
    """Return a context that trusts the system's authorities; in the image, Debian's ca-certificates brings them."""
    return ssl.create_default_context()
