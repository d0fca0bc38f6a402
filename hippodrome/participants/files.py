"""Serves files of the steps folder that pages load by relative addresses, such as pictures."""

from __future__ import annotations

from hippodrome.http import Request, Response
from hippodrome.model import ids
from hippodrome.participants.page_error import PageError
from hippodrome.storage.project_cache import ProjectCache

MAX_NAME = 200  # characters of a file's name, at most 800 bytes: S3 refuses keys beyond 1,024 with an error
_HEADERS = {
    "Cache-Control": "public, max-age=300",
    "Content-Security-Policy": "default-src 'none'; style-src 'unsafe-inline'; sandbox",  # no script in an SVG runs
}
KINDS = {
    "png": "image/png", "jpg": "image/jpeg", "jpeg": "image/jpeg", "gif": "image/gif", "webp": "image/webp",
    "svg": "image/svg+xml", "mp4": "video/mp4", "webm": "video/webm", "mp3": "audio/mpeg", "ogg": "audio/ogg",
    "wav": "audio/wav", "css": "text/css", "js": "text/javascript", "vtt": "text/vtt", "woff2": "font/woff2",
}  # fmt: skip


class Files:
    """Serves files of live projects. Only files with a suffix in `KINDS` are served."""

    def __init__(self, project_cache: ProjectCache) -> None:
        self._project_cache = project_cache

    def respond(self, request: Request) -> Response:
        """Respond to a GET of `/steps/{projectId}/{file}`. Raises `PageError` (404) if there is no such file."""
        parts = request.path.split("/")
        project = (
            self._project_cache.live_project(parts[2]) if len(parts) == 4 and ids.is_project_id(parts[2]) else None
        )
        name = parts[-1]
        kind = KINDS.get(name.rsplit(".", 1)[-1].lower())
        is_valid = name.isprintable() and not name.startswith(".") and len(name) <= MAX_NAME
        found = self._project_cache.document(f"{project.id}/steps/{name}") if project and kind and is_valid else None
        if found is None or kind is None:
            raise PageError(404, "There is nothing here", "Please open your study link again.")
        return Response(200, found.body, {"Content-Type": kind, **_HEADERS})
