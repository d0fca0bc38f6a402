"""Prepares a researcher's step page for the frame, and fills values into it (`sandbox.py`).

The researcher's text stays unchanged, byte for byte, except for a few tags. Before values are filled in, relative
addresses, of pictures for example, become addresses of the project's files (a link to one opens a tab), and scripts get
the nonce without which no browser runs them: so a tag in a value gets neither. All else depends on which branches of a
template are shown, and happens afterwards: tags of a whole document (`<html>`, `<body>`, `<form>` …) are dropped, what
is left open and would swallow the frame's button is closed, and the page's own button and heading are noted.
"""

from __future__ import annotations

import html
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

from hippodrome.control.participants import markup, sandbox
from hippodrome.control.participants.files import is_served

_MARK = f"nonce-{secrets.token_hex(16)}"  # takes the nonce's place in prepared pages; known to this process only

_PLACEHOLDER = re.compile("\ue000([0-9]+)\ue001")
_ABSOLUTE = re.compile(r"/|#|\?|\ue000|[a-zA-Z][a-zA-Z0-9+.-]*:|\Z")
_SRCSET = re.compile(r"(\A\s*|,\s+)(\S+)")
_IGNORED = re.compile(r"\A[\0- ]+|[\t\r\n]")
_NAMES_HOST = re.compile(r"//|https?:", re.IGNORECASE)
_ORIGIN = re.compile(r"https?://[^/\s?#]+", re.IGNORECASE)

_UNSEEN = frozenset({"template", "noscript"})  # browsers that run scripts show nothing in them
_NO_SUBMIT = ("button", "reset")  # types of <button> that send no form
_DROPPED = frozenset({"html", "head", "body", "form", "meta", "base"})
ADDRESSES = {
    "img": ("src", "srcset"),
    "source": ("src", "srcset"),
    "video": ("src", "poster"),
    "audio": ("src",),
    "track": ("src",),
    "script": ("src",),
    "link": ("href",),
    "input": ("src",),
}
"""The attributes that hold the addresses of what a page loads, by tag."""
LINKS = ("a", "area")
"""The tags that lead to the address in their `href`."""


class Content(NamedTuple):
    """A step page with its values filled in, and the facts about it that the frame needs."""

    html: str
    has_fields: bool  # whether it has inputs with names, whose values are sent
    has_submit: bool  # whether it has a submit button of its own, even one that is hidden or disabled
    has_heading: bool  # whether it has an <h1>
    title: str
    lang: str


@dataclass(frozen=True)
class Fragment:
    """A prepared step page."""

    text: str

    def fill(self, values: Mapping[str, Any], nonce: str = "") -> Content:
        """Return the page with these values, and with the nonce of the response in its scripts.

        Raises FragmentError.
        """
        text = sandbox.render(self.text, values) if sandbox.uses_jinja(self.text) else self.text
        mark = _MARK if nonce else f' nonce="{_MARK}"'
        return _Filled().read(text.replace(mark, nonce))

    def render(self, values: Mapping[str, Any], nonce: str = "") -> str:
        """Return the HTML of `fill`. Raises FragmentError."""
        return self.fill(values, nonce).html


@lru_cache(maxsize=64)
def prepare(source: str, base: str = "", hosts: tuple[str, ...] = ()) -> Fragment:
    """Prepare a step page for the frame. No text makes this raise.

    `base` is the address of the project's files; it ends with a slash. Scripts of `hosts` (origins) may run, too.
    """
    return _Preparation(source, base, hosts).run()


class _Preparation:
    """One pass over a page's tags. Jinja's expressions are set aside first, so that `a < b` in them is no tag."""

    def __init__(self, source: str, base: str, hosts: tuple[str, ...]) -> None:
        self._aside: list[str] = []  # Jinja's expressions, in the order of their placeholders
        self._source = self._set_aside(source.replace("\0", "\ufffd"))
        self._base = base
        self._hosts = frozenset(host.lower() for host in hosts)

    def run(self) -> Fragment:
        out: list[str] = []
        for token in markup.tokens(self._source):
            written = self._tag(token) if token.start and token.is_closed else token.source
            out += [token.before, written, token.content, token.end_tag]
        return Fragment(self._restore("".join(out)))

    def _set_aside(self, source: str) -> str:
        """The source with a placeholder for each expression of Jinja, and for text that looks like a placeholder."""
        out: list[str] = []
        at = 0
        for start, end in markup.expressions(source):
            out += [source[at:start], f"\ue000{len(self._aside)}\ue001"]
            self._aside.append(source[start:end])
            at = end
        return "".join([*out, source[at:]])

    def _restore(self, text: str) -> str:
        return _PLACEHOLDER.sub(lambda held: self._aside[int(held[1])], text)

    def _tag(self, token: markup.Token) -> str:
        name, attributes = token.start, token.attributes
        address = markup.attributes(attributes).get("src", "") if name == "script" else ""
        if name in LINKS and self._base:
            attributes = self._link(attributes)
        if name in ADDRESSES and self._base:
            attributes = markup.ATTRIBUTE.sub(lambda found: self._relocated(found, *ADDRESSES[name]), attributes)
        if name == "script" and self._may_run(address):
            attributes = f' nonce="{_MARK}"{attributes}'
        return f"{token.source[: 1 + len(name)]}{attributes}>"

    def _may_run(self, address: str) -> bool:
        """Whether a script is the researcher's: in the page, among the project's files, or on a host in `hosts`."""
        plain = _IGNORED.sub("", address).replace("\\", "/")  # the address as browsers read it
        if _NAMES_HOST.match(plain):
            origin = _ORIGIN.match(plain)
            return origin is not None and origin[0].lower() in self._hosts
        return "\ue000" not in address

    def _link(self, attributes: str) -> str:
        """The attributes of a link. Only a link to a file is changed: `next?…`, for one, is an address of ours."""
        values = markup.attributes(attributes)
        relocated = self._relocate(values.get("href", ""))
        if not relocated.startswith(self._base) or not is_served(re.split(r"[?#]", relocated, maxsplit=1)[0]):
            return attributes
        attributes = markup.ATTRIBUTE.sub(lambda found: self._relocated(found, "href"), attributes)
        return (
            attributes if "target" in values or "download" in values else f' target="_blank" rel="noopener"{attributes}'
        )

    def _relocated(self, match: re.Match[str], *names: str) -> str:
        """This attribute with an address of the project's files, if it is one of `names`."""
        attribute, value = match["name"].lower(), match["value"]
        if value is None or attribute not in names:
            return match[0]
        quote = value[0] if value[0] in "\"'" else ""
        inner = value[1:-1] if quote else value
        if attribute == "srcset":
            inner = _SRCSET.sub(lambda part: part[1] + self._relocate(part[2]), inner)
        else:
            inner = self._relocate(inner)
        return f"{match['name']}={quote}{inner}{quote}"

    def _relocate(self, address: str) -> str:
        bare = address.strip()
        return address if _ABSOLUTE.match(bare) else self._base + bare.removeprefix("./")


class _Filled:
    """One pass over a page with its values: so each fact is about what this participant sees."""

    def __init__(self) -> None:
        self._out: list[str] = []
        self._seen: set[str] = set()  # those of "field", "submit" and "h1" that the page has
        self._title = self._lang = ""
        self._drawings = 0  # open <svg> elements, whose <title> is their own
        self._unseen = ""  # the open element whose content browsers do not show
        self._in_select = False

    def read(self, page: str) -> Content:
        for token in markup.tokens(page):
            self._out.append(token.before)
            if token.start:
                self._start(token)
            elif token.end:
                self._end(token)
            elif token.is_comment:
                self._out.append(token.source if token.is_closed else token.source + "-->")
        if self._in_select:  # in an open one, browsers leave out the frame's button
            self._out.append("</select>")
        return Content(
            html="".join(self._out),
            has_fields="field" in self._seen,
            has_submit="submit" in self._seen,
            has_heading="h1" in self._seen,
            title=self._title,
            lang=self._lang,
        )

    def _start(self, token: markup.Token) -> None:
        """Copy a start tag; for a script and other elements whose content is text, all up to the end tag."""
        name = token.start
        if not token.is_closed:  # a tag that never ends would swallow what follows in the frame
            self._out.append(token.source.replace("<", "&lt;"))
            return
        self._note(name, markup.attributes(token.attributes))
        self._drawings += name == "svg" and not token.attributes.endswith("/")
        self._in_select |= name == "select"
        if name in _UNSEEN and not self._unseen:
            self._unseen = name
        if name == "title" and self._drawings <= 0:
            self._title = " ".join(html.unescape(token.content).split())[:200]
        elif name in markup.RAW:
            self._out += [token.source, token.content, token.end_tag or f"</{name}>"]
        elif name not in _DROPPED:
            self._out.append(token.source)

    def _end(self, token: markup.Token) -> None:
        self._drawings -= token.end == "svg"
        self._in_select &= token.end != "select"
        if token.end == self._unseen:
            self._unseen = ""
        if token.end not in _DROPPED:
            self._out.append(token.source if token.is_closed else token.source.replace("<", "&lt;"))

    def _note(self, name: str, attributes: Mapping[str, str]) -> None:
        """Note the facts about this tag that the frame needs."""
        kind = attributes.get("type", "").strip().lower()
        if name in ("input", "select", "textarea", "button") and attributes.get("name", "").strip():
            self._seen.add("field")
        submits = kind in ("submit", "image") if name == "input" else name == "button" and kind not in _NO_SUBMIT
        if submits and "form" not in attributes and not self._unseen:  # the page's form has no id to name it by
            self._seen.add("submit")
        if name == "h1":
            self._seen.add("h1")
        if name == "html" and not self._lang and re.fullmatch(r"[A-Za-z0-9-]{2,35}", attributes.get("lang", "")):
            self._lang = attributes["lang"]
