"""Asks the model's API: no redirect is followed, and an answer is bounded in size and time."""

from __future__ import annotations

import contextlib
import functools
import http.client
import json
import socket
import ssl
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import urlsplit

MAX_ANSWER = 4 * 1024 * 1024
"""The most bytes of an answer."""
_PIECE = 64 * 1024  # bytes


class Failed(Exception):
    """The model's API has not answered, or not to the end. `code` is for programs, the message for people."""

    def __init__(self, status: int, code: str, words: str) -> None:
        super().__init__(words)
        self.status = status
        self.code = code


@dataclass(frozen=True, slots=True)
class Upstream:
    """The model's API. `url` is https or loopback; without a `key`, requests have no `Authorization`."""

    url: str
    key: str = field(repr=False)
    seconds: float

    @contextlib.contextmanager
    def ask(self, path: str, request: Mapping[str, Any]) -> Iterator[Answer]:
        """Send a request to a path below `url`, and yield the answer, of which nothing is read yet. Raises Failed."""
        parts = urlsplit(self.url)
        connection = _connection(parts.scheme, parts.hostname or "", parts.port, self.seconds)
        deadline = time.monotonic() + self.seconds
        timer = threading.Timer(self.seconds, lambda: _end(connected))  # for one who sends a byte now and then
        timer.daemon = True
        try:
            connection.connect()
            connected = connection.sock
            timer.start()
            headers = {"Content-Type": "application/json", "Accept-Encoding": "identity", "User-Agent": "hippodrome"}
            if self.key:
                headers["Authorization"] = f"Bearer {self.key}"
            connection.request("POST", parts.path + path, json.dumps(request).encode(), headers)
            response = connection.getresponse()
            if 300 <= response.status < 400:
                words = "the model's address leads elsewhere, and no redirect is followed; write the final address"
                raise Failed(502, "redirected", words)
            yield Answer(response, deadline)
        except (OSError, http.client.HTTPException, ValueError) as error:
            raise _failure(error, deadline, self.seconds) from None
        finally:
            timer.cancel()
            connection.close()


class Answer:
    """The answer of the model's API."""

    def __init__(self, response: http.client.HTTPResponse, deadline: float) -> None:
        self._response = response
        self._deadline = deadline
        self.status = response.status
        self.retry_after = response.getheader("Retry-After")
        self.is_stream = (response.getheader("Content-Type") or "").partition(";")[0].strip() == "text/event-stream"

    def pieces(self) -> Iterator[bytes]:
        """Yield the bytes of the answer as they come. Raises Failed if they are too many, and OSError."""
        size = 0
        while piece := self._response.read1(_PIECE):
            size += len(piece)
            if size > MAX_ANSWER:
                raise Failed(502, "too_large", f"the model's answer is larger than {MAX_ANSWER // 1024**2} MB")
            yield piece
        if time.monotonic() >= self._deadline:
            raise TimeoutError


def _connection(scheme: str, host: str, port: int | None, seconds: float) -> http.client.HTTPConnection:
    if scheme == "https":
        return http.client.HTTPSConnection(host, port, timeout=seconds, context=_authorities())
    return http.client.HTTPConnection(host, port, timeout=seconds)


@functools.cache
def _authorities() -> ssl.SSLContext:
    return ssl.create_default_context()  # takes some milliseconds each time


def _end(connected: socket.socket) -> None:
    """End a connection from another thread: whatever waits for it fails."""
    with contextlib.suppress(OSError):
        connected.shutdown(socket.SHUT_RDWR)


def _failure(error: Exception, deadline: float, seconds: float) -> Failed:
    if isinstance(error, TimeoutError) or time.monotonic() >= deadline:
        return Failed(504, "timeout", f"the model has not answered within {seconds:g} s")
    if isinstance(error, ssl.SSLError):
        return Failed(502, "unavailable", "the model's address has no valid certificate")
    return Failed(502, "unavailable", f"the model cannot be reached ({type(error).__name__})")
