"""Input of an attacker, and checks whether it had an effect, for the tests of this folder."""

from __future__ import annotations

import base64
import gzip
import json
import re
from html.parser import HTMLParser
from typing import Any

from hippodrome.control.model import ids
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from testing import studies
from testing.fake_platform import FakePlatform

PROJECT = "maze"
SSTI = "{{ 'x'.join('ssti') }}{% for c in 'abc' %}ssti{% endfor %}"  # rendered: sxsxtxi, sstisstissti
RENDERED = ("sxsxtxi", "sstisstissti")

# Every text that could become markup, a header, a template or a log line of its own carries "xss".
TEXTS = [
    "<xss>",
    '"><xss>',
    "'><xss a='",
    '" xss="1" onxss="1',
    "' xss=1 onxss=1 '",
    "</script><xss>",
    "</textarea></title></form><xss>",
    "<!--<xss>-->",
    "<xss\0>",
    "\u2028<xss>\u2029",
    "javascript:xss()",
    "//xss.example/",
    "x\r\nxss: 1",
    "x\r\n\r\n<xss>",
    "x\nxss: 1",
    "\x00\x01\x1b[31mxss\x7f",
    "\u202exss\u2066",
    "\ufeff<xss>",
    "\uff1cxss\uff1e",
    SSTI,
    "${xss}",
    "$xss $$ %s %(xss)s {0}",
    "../../project_master_list.json",
    "..%2f..%2f_servers",
    "a/../../b",
    "a\\..\\b",
    ".xss",
    "_servers",
    "__proto__",
    "constructor",
    "NaN",
    "-1",
    "1e309",
    "1" * 5000,
    "xss" * 3000,
    "é" * 300,
    "\U0001f40e",
    "\ud800xss",
    "",
    " ",
    "\t",
    "null",
    "true",
    "[]",
]

VICTIM = "victim-whose-link-nobody-knows"
MINE = "alice"
NONCE = "a-nonce"


def study(**changes: object) -> Project:
    """Return a study like the example, whose pages show all that a participant has sent."""
    pages = ("mirror", "game", "mirror", "mirror")
    steps = [Step("1", "consent", 2), *map(Step, ("2", "3", "4", "finalStep"), pages)]
    return studies.study(steps=steps, **changes)


def token(user: str) -> str:
    """Return the token of this participant's first server, whose record has the nonce `NONCE`."""
    name = ids.server_name(ids.server_label(PROJECT, user), 1)
    return studies.INSTALLATION_SECRET.derive("token", name, NONCE)[:48]


MIRROR = """<h1>Mirror</h1><p title="{{ participant }}">{{ participant.note }} {{ participant }}</p>
<input name="q" value="{{ answers }}"><textarea>{{ answers['1'] }}</textarea>
<script>const all = {{ answers | tojson }}; const me = {{ participant | tojson }};</script>"""


def installed(**changes: object) -> FakePlatform:
    """Return a platform in memory with that study."""
    platform = studies.installed(study(**changes))
    platform.documents.put(f"{PROJECT}/steps/mirror.html", MIRROR.encode())
    platform.documents.put(f"{PROJECT}/steps/picture.svg", b"<svg xmlns='http://www.w3.org/2000/svg'><script/></svg>")
    return platform


class _Tags(HTMLParser):
    """Collects all tags, attributes and scripts of a page."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[dict[str, str | None], str]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag == "script":
            self.scripts.append((dict(attrs), ""))

    def handle_data(self, data: str) -> None:
        if self.cdata_elem == "script" and self.scripts:
            attributes, text = self.scripts.pop()
            self.scripts.append((attributes, text + data))


def check_html(text: str, *, whole: bool = True) -> None:
    """Check that no input of a participant became markup, script, an address or a template."""
    page = _Tags()
    page.feed(text)
    page.close()
    for tag, attributes in page.tags:
        assert "xss" not in tag, tag
        for name, value in attributes.items():
            assert "xss" not in name, (tag, name)
            if name in ("action", "href", "src") and tag != "link":  # the icon is a part of the page
                assert value, (tag, name)
                assert re.match(r"/(?![/\\])", value), (tag, name, value)
    for attributes, script in page.scripts:
        assert "<xss" not in script.lower(), script
        if attributes.get("type") == "application/json":
            json.loads(script)
        elif whole:
            assert attributes.get("nonce"), attributes
    for rendered in RENDERED:
        assert rendered not in text


def body_of(answer: dict[str, Any]) -> bytes:
    """Return the bytes that a browser would receive."""
    raw = answer["body"]
    data = base64.b64decode(raw, validate=True) if answer["isBase64Encoded"] else raw.encode()
    return gzip.decompress(data) if answer["headers"].get("Content-Encoding") == "gzip" else data


def check_headers(headers: dict[str, str]) -> None:
    """Check the headers: plain names and values, no second header in a value, and no redirect to another host."""
    for name, value in headers.items():
        assert re.fullmatch(r"[A-Za-z-]{1,40}", name), name
        assert "xss" not in name.lower()
        assert re.fullmatch(r"[\x20-\x7e]*", value), (name, value)
    location = headers.get("Location")
    if location is not None:
        assert re.match(r"/(?![/\\])", location), location


def check_answer(answer: dict[str, Any]) -> int:
    """Check all that must hold for any answer of an HTTP handler; returns its status."""
    status = answer["statusCode"]
    assert 200 <= status < 500, answer
    assert len(json.dumps(answer).encode()) < 6 * 1024 * 1024, "more than Lambda hands on"
    headers = answer["headers"]
    check_headers(headers)
    assert headers["X-Content-Type-Options"] == "nosniff"
    assert headers["Referrer-Policy"] == "no-referrer"
    body = body_of(answer)
    kind = headers.get("Content-Type", "")
    if body:
        assert kind
    if kind.startswith("text/html"):
        policy = headers["Content-Security-Policy"]
        assert "default-src 'none'" in policy
        assert "frame-ancestors 'none'" in policy
        check_html(body.decode())
    elif kind == "application/json":
        data = json.loads(body)
        if isinstance(data.get("page"), str):
            check_html(data["page"], whole=False)
    elif body:
        assert "sandbox" in headers["Content-Security-Policy"], kind
    return int(status)
