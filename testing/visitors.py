"""The browser and the program of a participant, without a screen: they send requests to `next_step` and read its pages.

`Browser` reads HTML and sends the form of a page, as `web/` makes it. `Program` reads JSON and posts JSON, as a front end that a
researcher has written. A real Chromium is in `testing/browser.py`.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import re
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlencode

from lambdas import installed, next_step
from testing.aws_events import FORM, JSON, http_event
from testing.fake_platform import FakePlatform


def sent(answer: Mapping[str, Any]) -> bytes:
    """The bytes that go over the line for a function's answer."""
    body = str(answer["body"]).encode()
    return base64.b64decode(body) if answer["isBase64Encoded"] else body


def body_of(answer: Mapping[str, Any]) -> bytes:
    """An answer's body as the browser sees it."""
    body = sent(answer)
    return gzip.decompress(body) if answer["headers"].get("Content-Encoding") == "gzip" else body


def hidden(page: str) -> dict[str, str]:
    """The hidden fields of a page's form."""
    return {
        name: html.unescape(value)
        for name, value in re.findall(r'<input type="hidden" name="([^"]+)" value="([^"]*)"', page)
    }


class Browser:
    """Opens the link `query` on this platform and sends forms. Redirects are left to the test."""

    def __init__(self, platform: FakePlatform, query: str = "projectId=maze&userId=alice") -> None:
        self.platform, self.query = platform, query
        if installed._platform is not platform:
            installed.use(platform)

    def send(self, method: str = "GET", body: str | bytes | None = None, **headers: str) -> dict[str, Any]:
        """What the function answers; names of headers are written with `_`."""
        named = {"accept": "text/html", **{name.replace("_", "-"): value for name, value in headers.items()}}
        return next_step.handler(http_event(method, self.query, body, headers=named), None)

    def get(self, **headers: str) -> str:
        """The page. AssertionError if there is none."""
        response = self.send(**headers)
        assert response["statusCode"] == 200, response
        return str(response["body"])

    def answer(self, page: str, **fields: object) -> dict[str, Any]:
        """Submit the page's form with these fields."""
        return self.post(**hidden(page), **fields)

    def post(self, **fields: object) -> dict[str, Any]:
        return self.send("POST", urlencode(fields, doseq=True), content_type=FORM)


class Program:
    """A front end of its own: it reads JSON, and posts a JSON object."""

    def __init__(self, platform: FakePlatform) -> None:
        self.platform = platform
        installed.use(platform)

    def ask(self, method: str = "GET", body: str | None = None, kind: str = JSON) -> Any:
        """What the JSON of the answer says. AssertionError unless it is 200."""
        query = "projectId=maze&userId=alice"
        headers = {"accept": JSON, "content-type": kind}
        response = next_step.handler(http_event(method, query, body, headers=headers), None)
        assert response["statusCode"] == 200, response
        return json.loads(response["body"])

    def post(self, answers: object) -> Any:
        return self.ask("POST", json.dumps(answers))
