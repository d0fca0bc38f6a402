"""Prepares a researcher's step page for the frame, and fills values into it (`sandbox.py`).

The researcher's text stays unchanged, byte for byte, except for a few tags. Tags of a whole document (`<html>`,
`<body>`, `<form>` …) are dropped. Relative addresses, of pictures for example, become addresses of the project's
files. Scripts get the nonce without which no browser runs them. All of this happens before values are filled in, so a
tag in a value gets neither a nonce nor another address.
"""

from __future__ import annotations

import html
import re
import secrets
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

from hippodrome.participants import sandbox

_MARK = f"nonce-{secrets.token_hex(16)}"  # takes the nonce's place in prepared pages; known to this process only

_JINJA_START = re.compile(r"\{[{%#]|\ue000")
_JINJA_END = {"{{": "}}", "{%": "%}", "{#": "#}"}
_PLACEHOLDER = re.compile("\ue000([0-9]+)\ue001")
_TOKEN = re.compile(
    r"""
      <!--(?:>|->|(?P<comment>.*?)(?:--!?>|\Z))
    | <[!?](?P<declaration>[^>]*+)>?
    | </(?P<end>[a-zA-Z][^\s/>]*+)[^>]*+>?
    | <(?P<start>[a-zA-Z][^\s/>]*+)(?P<attributes>(?:=\s*+(?:"[^"]*+"|'[^']*+')|[^>])*+)(?P<closed>>?)
    """,
    re.VERBOSE | re.DOTALL,
)
_ATTRIBUTE = re.compile(
    r"""(?P<name>[^\s/>=][^\s/>=]*+)(?:\s*+=\s*+(?P<value>"[^"]*+"|'[^']*+'|[^\s>"'][^\s>]*+))?""", re.DOTALL
)
_ABSOLUTE = re.compile(r"/|#|\?|\ue000|[a-zA-Z][a-zA-Z0-9+.-]*:|\Z")
_SRCSET = re.compile(r"(\A\s*|,\s+)(\S+)")
_IGNORED = re.compile(r"\A[\0- ]+|[\t\r\n]")
_NAMES_HOST = re.compile(r"//|https?:", re.IGNORECASE)
_ORIGIN = re.compile(r"https?://[^/\s?#]+", re.IGNORECASE)

_RAW = frozenset({"script", "style", "textarea", "title", "iframe", "xmp", "noembed", "noframes"})  # hold no tags
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
"""The attributes that hold addresses, by tag."""


@dataclass(frozen=True)
class Fragment:
    """A prepared step page, and the facts about it that the frame needs."""

    text: str
    has_fields: bool  # whether it has inputs with names, whose values are sent
    has_submit: bool  # whether it has a submit button of its own
    has_heading: bool  # whether it has an <h1>
    title: str
    lang: str

    def render(self, values: Mapping[str, Any], nonce: str = "") -> str:
        """Return the page with these values, and with the nonce of the response in its scripts.

        Raises FragmentError.
        """
        text = sandbox.render(self.text, values) if sandbox.uses_jinja(self.text) else self.text
        mark = _MARK if nonce else f' nonce="{_MARK}"'
        return text.replace(mark, nonce)


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
        self._out: list[str] = []
        self._seen: set[str] = set()  # those of "field", "submit" and "h1" that the page has
        self._title = self._lang = ""
        self._drawings = 0  # open <svg> elements, whose <title> is their own

    def run(self) -> Fragment:
        at = 0
        while found := _TOKEN.search(self._source, at):
            self._out.append(self._source[at : found.start()])
            at = found.end()
            if found["start"] is not None:
                at = self._start(found)
            elif found["end"] is not None:
                self._end(found)
            elif found["declaration"] is not None:
                self._drop(found[0])
            else:
                self._out.append(found[0] if found[0].endswith(">") else found[0] + "-->")
        self._out.append(self._source[at:])
        return Fragment(
            text=self._restore("".join(self._out)),
            has_fields="field" in self._seen,
            has_submit="submit" in self._seen,
            has_heading="h1" in self._seen,
            title=self._title,
            lang=self._lang,
        )

    def _set_aside(self, source: str) -> str:
        """The source with a placeholder for each expression of Jinja, and for text that looks like a placeholder."""
        out: list[str] = []
        at = start = 0
        unclosed: set[str] = set()
        while found := _JINJA_START.search(source, at):
            at = found.end()
            if closer := _JINJA_END.get(found[0]):
                if closer in unclosed or (end := source.find(closer, at)) == -1:
                    unclosed.add(closer)
                    continue
                at = end + 2
            out += [source[start : found.start()], f"\ue000{len(self._aside)}\ue001"]
            self._aside.append(source[found.start() : at])
            start = at
        return "".join([*out, source[start:]])

    def _restore(self, text: str) -> str:
        return _PLACEHOLDER.sub(lambda held: self._aside[int(held[1])], text)

    def _drop(self, text: str) -> None:
        """Drop `text` but keep its line ends, so that Jinja counts lines as the researcher does."""
        self._out.append("\n" * self._restore(text).count("\n"))

    def _end(self, found: re.Match[str]) -> None:
        self._drawings -= found["end"].lower() == "svg"
        if found["end"].lower() in _DROPPED:
            self._drop(found[0])
        elif found[0].endswith(">"):
            self._out.append(found[0])
        else:
            self._out.append(found[0].replace("<", "&lt;"))

    def _start(self, found: re.Match[str]) -> int:
        """Copy a start tag; for a script and other elements in `_RAW`, all up to the end tag. Return where to go on."""
        name = found["start"].lower()
        if not found["closed"]:  # a tag that never ends would swallow what follows in the frame
            self._out.append(found[0].replace("<", "&lt;"))
            return found.end()
        given = _attributes(found["attributes"])
        self._note(name, given)
        self._drawings += name == "svg" and not found["attributes"].endswith("/")
        if name in _DROPPED:
            self._drop(found[0])
            return found.end()
        if name not in _RAW:
            self._out.append(self._tag(found, name))
            return found.end()
        inside, end = self._inside(name, found.end())
        if name == "title" and self._drawings <= 0:
            self._title = " ".join(html.unescape(_PLACEHOLDER.sub("", inside)).split())[:200]
            self._drop(found[0] + inside)
        else:
            self._out += [self._tag(found, name, given), inside, end or f"</{name}>"]
        return found.end() + len(inside) + len(end)

    def _inside(self, name: str, at: int) -> tuple[str, str]:
        """The content from `at` on of an element in `_RAW`, and its end tag, which is empty if the element never ends.

        Only the first end tag counts: if no ">" follows it, none follows a later one either.
        """
        end = re.compile(rf"</{name}(?=[\s/>])", re.IGNORECASE).search(self._source, at)
        if end is None or (close := self._source.find(">", end.end())) == -1:
            return self._source[at:], ""
        return self._source[at : end.start()], self._source[end.start() : close + 1]

    def _note(self, name: str, given: Mapping[str, str]) -> None:
        """Note the facts about this tag that the frame needs."""
        kind = given.get("type", "").strip().lower()
        if name in ("input", "select", "textarea", "button") and given.get("name", "").strip():
            self._seen.add("field")
        if name == "input" and kind in ("submit", "image"):
            self._seen.add("submit")
        if name == "button" and kind not in ("button", "reset"):
            self._seen.add("submit")
        if name == "h1":
            self._seen.add("h1")
        if name == "html" and not self._lang and re.fullmatch(r"[A-Za-z0-9-]{2,35}", given.get("lang", "")):
            self._lang = given["lang"]

    def _tag(self, found: re.Match[str], name: str, given: Mapping[str, str] | None = None) -> str:
        attributes = found["attributes"]
        if name in ADDRESSES and self._base:
            attributes = _ATTRIBUTE.sub(lambda each: self._address(name, each), attributes)
        if name == "script" and self._may_run((given or {}).get("src", "")):
            attributes = f' nonce="{_MARK}"{attributes}'
        return f"<{found['start']}{attributes}>"

    def _may_run(self, address: str) -> bool:
        """Whether a script is the researcher's: in the page, among the project's files, or on a host in `hosts`."""
        plain = _IGNORED.sub("", address).replace("\\", "/")  # the address as browsers read it
        if _NAMES_HOST.match(plain):
            origin = _ORIGIN.match(plain)
            return origin is not None and origin[0].lower() in self._hosts
        return "\ue000" not in address

    def _address(self, name: str, found: re.Match[str]) -> str:
        attribute, value = found["name"].lower(), found["value"]
        if value is None or attribute not in ADDRESSES[name]:
            return found[0]
        quote = value[0] if value[0] in "\"'" else ""
        inner = value[1:-1] if quote else value
        if attribute == "srcset":
            inner = _SRCSET.sub(lambda part: part[1] + self._relocate(part[2]), inner)
        else:
            inner = self._relocate(inner)
        return f"{found['name']}={quote}{inner}{quote}"

    def _relocate(self, address: str) -> str:
        bare = address.strip()
        return address if _ABSOLUTE.match(bare) else self._base + bare.removeprefix("./")


def _attributes(text: str) -> dict[str, str]:
    """The values of attributes by their names in lower case. Of two with one name, the first counts, as in browsers."""
    found: dict[str, str] = {}
    for each in _ATTRIBUTE.finditer(text):
        value = each["value"] or ""
        value = value[1:-1] if value[:1] in ('"', "'") else value
        found.setdefault(each["name"].lower(), html.unescape(value))
    return found
