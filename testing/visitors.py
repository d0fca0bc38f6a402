"""Clients of `next_step` for tests, in the same process: they send a participant's requests and read the answers.

`Browser` reads HTML and sends the form of a page, as `hippodrome/web/` makes it. `Program` reads and posts JSON, as a front end
does that a researcher has written. A real Chromium is in `testing/browser.py`.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any
from urllib.parse import urlencode

from hippodrome.control.http import Request
from hippodrome.control.model.project import Project
from hippodrome.control.participants.visit import Visit
from hippodrome.functions import installed, next_step
from testing.aws_events import FORM, JSON, http_event
from testing.fake_platform import FakePlatform


def sent(answer: Mapping[str, Any]) -> bytes:
    """Return the bytes of a function's answer as they go over the network, compressed if the function compresses them."""
    body = str(answer["body"]).encode()
    return base64.b64decode(body) if answer["isBase64Encoded"] else body


def body_of(answer: Mapping[str, Any]) -> bytes:
    """Return the body of a function's answer, decompressed."""
    body = sent(answer)
    return gzip.decompress(body) if answer["headers"].get("Content-Encoding") == "gzip" else body


def hidden(page: str) -> dict[str, str]:
    """Return the names and values of the hidden fields of a page's form."""
    return {
        name: html.unescape(value)
        for name, value in re.findall(r'<input type="hidden" name="([^"]+)" value="([^"]*)"', page)
    }


def visit_of(project: Project, now: datetime = datetime(2026, 11, 21, 12, tzinfo=UTC)) -> Visit:
    """Return a visit of alice's, for tests of what `next_step` calls."""
    return Visit(Request("GET", "/next", (), {}), project, "alice", now)


class Browser:
    """A browser that opens the link with this query on this platform, and sends forms. The test follows redirects."""

    def __init__(self, platform: FakePlatform, query: str = "projectId=maze&userId=alice") -> None:
        self.platform, self.query = platform, query
        if installed._platform is not platform:
            installed.use(platform)

    def send(self, method: str = "GET", body: str | bytes | None = None, **headers: str) -> dict[str, Any]:
        """Send a request and return the function's answer. Names of headers have `_` instead of `-`."""
        named = {"accept": "text/html", **{name.replace("_", "-"): value for name, value in headers.items()}}
        return next_step.handler(http_event(method, self.query, body, headers=named), None)

    def get(self, **headers: str) -> str:
        """Open the link and return the page. Raises AssertionError unless the status is 200."""
        response = self.send(**headers)
        assert response["statusCode"] == 200, response
        return str(response["body"])

    def answer(self, page: str, **fields: object) -> dict[str, Any]:
        """Submit the page's form with its hidden fields and these fields; return the function's answer."""
        return self.post(**hidden(page), **fields)

    def post(self, **fields: object) -> dict[str, Any]:
        """Submit a form with these fields alone; return the function's answer."""
        return self.send("POST", urlencode(fields, doseq=True), content_type=FORM)


class Program:
    """A front end that a researcher has written: it reads JSON, and posts a JSON object."""

    def __init__(self, platform: FakePlatform) -> None:
        self.platform = platform
        installed.use(platform)

    def ask(self, method: str = "GET", body: str | None = None, content_type: str = JSON) -> Any:
        """Send a request and return its answer, parsed. Raises AssertionError unless the status is 200."""
        query = "projectId=maze&userId=alice"
        headers = {"accept": JSON, "content-type": content_type}
        response = next_step.handler(http_event(method, query, body, headers=headers), None)
        assert response["statusCode"] == 200, response
        return json.loads(response["body"])

    def post(self, answers: object) -> Any:
        """Post these answers as JSON; return the function's answer, parsed."""
        return self.ask("POST", json.dumps(answers))
