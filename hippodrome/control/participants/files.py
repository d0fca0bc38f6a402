"""Serves files of the steps folder that pages load or link to by relative addresses: pictures, PDFs and the like."""

from __future__ import annotations

import re

from hippodrome.control.http import Request, Response
from hippodrome.control.model import ids
from hippodrome.control.participants.page_error import PageError
from hippodrome.control.storage.project_cache import ProjectCache
from hippodrome.protocol.file_names import composed

MAX_NAME = 200  # characters of a file's name, at most 800 bytes: S3 refuses keys beyond 1,024 with an error
MAX_BYTES = 4 * 1024**2  # a file's size on AWS: a function's answer has 6 MB at most, and the file is in base64 there
_CACHE = {"Cache-Control": "public, max-age=300", "Accept-Ranges": "bytes"}
_RANGE = re.compile(r"bytes=(\d{1,9})?-(\d{1,9})?", re.ASCII)
_SANDBOX = {"Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; sandbox"}  # for scripts in SVGs
KINDS = {
    "png": "image/png", "jpg": "image/jpeg", "jpeg": "image/jpeg", "gif": "image/gif", "webp": "image/webp",
    "svg": "image/svg+xml", "mp4": "video/mp4", "webm": "video/webm", "mp3": "audio/mpeg", "ogg": "audio/ogg",
    "wav": "audio/wav", "css": "text/css", "js": "text/javascript", "vtt": "text/vtt", "woff2": "font/woff2",
    "pdf": "application/pdf", "txt": "text/plain; charset=utf-8",
    "ics": "text/calendar; charset=utf-8", "odt": "application/vnd.oasis.opendocument.text",
    "docx": "application/vnd.openxmlformats-officedocument.wordprocessingml.document",
}  # fmt: skip
_SAVED = ("ics", "odt", "docx")
"""The endings of files that browsers save, since other programs open them."""


def is_served(name: str) -> bool:
    """Return whether files with this name's ending are served."""
    return ending(name) in KINDS


def ending(name: str) -> str:
    """Return the ending of a file's name, without its dot, in lower case; empty if it has none."""
    return name.rpartition(".")[2].lower() if "." in name else ""


def _headers(name: str) -> dict[str, str]:
    """The headers of a file. Browsers show no PDF in a sandbox, and run none of its scripts as this site's."""
    kind = ending(name)
    sandbox = {} if kind == "pdf" else _SANDBOX
    saved = {"Content-Disposition": "attachment"} if kind in _SAVED else {}
    return {"Content-Type": KINDS[kind], **_CACHE, **sandbox, **saved}


class Files:
    """Serves files of live projects. Only files with an ending in `KINDS` are served."""

    def __init__(self, project_cache: ProjectCache) -> None:
        self._project_cache = project_cache

    def respond(self, request: Request) -> Response:
        """Respond to a GET of `/steps/{projectId}/{file}`. Raises `PageError` (404) if there is no such file."""
        parts = request.path.split("/")
        project = (
            self._project_cache.live_project(parts[2]) if len(parts) == 4 and ids.is_project_id(parts[2]) else None
        )
        name = composed(parts[-1])
        is_valid = is_served(name) and name.isprintable() and not name.startswith(".") and len(name) <= MAX_NAME
        document = self._project_cache.document(f"{project.id}/steps/{name}") if project and is_valid else None
        if document is None:
            raise PageError(404, "Page not found", "Please open your study link again.")
        if "range" in request.headers and "if-range" not in request.headers:
            return _part(document.body, request.headers["range"], _headers(name))
        return Response(200, document.body, _headers(name))


def _part(body: bytes, requested_range: str, headers: dict[str, str]) -> Response:
    """Respond with the part of a file that `Range` asks for: Safari plays a film or a sound only if it gets parts.

    A value of another form than one range is ignored (RFC 9110, section 14.2).
    """
    match = _RANGE.fullmatch(requested_range.strip())
    if match is None or not any(match.groups()):
        return Response(200, body, headers)
    first, last = (None if text is None else int(text) for text in match.groups())
    size = len(body)
    if first is None:  # the last bytes of the file, as many as this
        first, last = max(0, size - (last or 0)), size - 1
    last = size - 1 if last is None else min(last, size - 1)
    if first > last:
        return Response(416, "", {**headers, "Content-Range": f"bytes */{size}"})
    return Response(206, body[first : last + 1], {**headers, "Content-Range": f"bytes {first}-{last}/{size}"})
