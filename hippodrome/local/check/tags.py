"""Checks single tags of a page: browsers, or the frame around pages, do not do all that a tag asks for."""

from __future__ import annotations

import re
from collections.abc import Iterable
from urllib.parse import unquote, urlsplit

from hippodrome.control.config import Config, Diagnostic
from hippodrome.control.participants import fragments, markup
from hippodrome.control.participants.files import KINDS, is_served
from hippodrome.control.participants.markup import MARK
from hippodrome.local.check.page_source import PageSource
from hippodrome.local.check.wording import short
from hippodrome.protocol.file_names import composed
from hippodrome.protocol.similar import SIMILAR_FILES, did_you_mean

_HANDLER = re.compile(r"on[a-z]{3,}")
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*:", re.IGNORECASE)
_IN_STYLE = re.compile(r"""url\(\s*["']?([^"')\s]+)""", re.IGNORECASE)
_IN_SRCSET = re.compile(r"(?:\A|,)\s*([^\s,]+)")
BUTTONS = ("button", "reset", "submit", "image")
"""The types of inputs that need no name."""
_HOST = re.compile(r"(?:[a-z][a-z0-9+.-]*:)?//[^/?#]*(?=[/?#]|\Z)", re.IGNORECASE)
_ON_DISK = re.compile(r"file:|[a-z]:[\\/]", re.IGNORECASE)
_SCRIPT = (
    "a script of the project whose address holds a value never runs; write its name, and pass the value in the page"
)
_LOADED = {**fragments.ADDRESSES, "iframe": ("src",), "embed": ("src",), "object": ("data",)}


class Tags:
    """Finds the tags of a page that do not work, in browsers or in the frame around pages."""

    def __init__(self, label: str, names: Iterable[str], config: Config | None) -> None:
        self._label = label
        self._folder = label.partition("/")[0]
        self._names = frozenset(map(composed, names))
        self._own = f"/steps/{config.project.id}/" if config else None
        self._hosts = frozenset(config.project.allowed_hosts) if config else None
        self._found: list[Diagnostic] = []
        self._unnamed: list[tuple[int, str]] = []  # line and tag of each field without a name
        self._line = 1

    def read(self, page: PageSource) -> list[Diagnostic]:
        """Return the problems of a page's tags. What a Jinja expression stands for is not checked."""
        for self._line, token in page.tokens():
            if token.start and token.is_closed:
                attributes = markup.attributes(token.attributes)
                self._start(token.start, {name: value.strip() for name, value in attributes.items()})
            if token.start == "style":
                self._style(token.content, token.source.count("\n"))
        return [*self._found, *self._without_a_name()]

    def _start(self, tag: str, attributes: dict[str, str]) -> None:
        self._field(tag, attributes)
        self._left_out(tag, attributes)
        for name, value in attributes.items():
            if _HANDLER.fullmatch(name) and value:
                self._remark(f"{name} never runs; use addEventListener in a <script> of the page")
            elif name in ("href", "src", "action") and value.lower().startswith("javascript:"):
                self._remark("javascript: never runs; use addEventListener in a <script> of the page")
            elif name == "style":
                self._style(value)
            elif name == "href" and tag in fragments.LINKS:
                self._link(value)
            elif name == "formaction" and self._is_elsewhere(value):
                self._mistake("a form is never sent to another site; take formaction out")
            elif name in _LOADED.get(tag, ()):
                for address in _IN_SRCSET.findall(value) if name == "srcset" else [value]:
                    self._address(tag, address, attributes)

    def _field(self, tag: str, attributes: dict[str, str]) -> None:
        kind = attributes.get("type", "").lower() if tag == "input" else tag
        if kind == "file":
            self._mistake("files cannot be sent; take this field out")
        elif tag in ("input", "select", "textarea") and kind not in BUTTONS and not attributes.get("name"):
            self._unnamed.append((self._line, tag))

    def _left_out(self, tag: str, attributes: dict[str, str]) -> None:
        """Remark on tags that the frame leaves out, where a page would need them."""
        if tag == "meta" and attributes.get("http-equiv", "").lower() == "refresh":
            self._remark('<meta http-equiv="refresh"> does nothing; write a link and a <script> (docs/recruiting.md)')
        elif tag == "base" and attributes.get("href"):
            self._remark("<base> does nothing; write the whole address in each tag")
        elif tag == "form" and self._is_elsewhere(attributes.get("action", "")):
            self._remark("the answers are stored as those of this study, and are not sent to the form's action")

    @staticmethod
    def _is_elsewhere(address: str) -> bool:
        return address.startswith("//") or _SCHEME.match(address) is not None

    def _without_a_name(self) -> list[Diagnostic]:
        """One remark on all fields without a name: a name that is missing once is often missing everywhere."""
        if not self._unnamed:
            return []
        (first, tag), count = self._unnamed[0], len(self._unnamed)
        fields = f"this <{tag}> has" if count == 1 else f"{count} fields have"
        message = f"{fields} no name, so what is entered there is never sent"
        if count > 1:
            message += f": {_lines(sorted({line for line, _ in self._unnamed}))}"
        return [Diagnostic(self._label, first, "", message, remark=True)]

    def _style(self, text: str, line: int = 0) -> None:
        """Remark on the files of a style that begins `line` lines after its tag."""
        for match in _IN_STYLE.finditer(text):
            address = match[1]
            if MARK not in address and not address.startswith(("/", "#")) and not _SCHEME.match(address):
                place = f"{self._own or '/steps/your-project/'}{address.removeprefix('./')}"
                message = f"{short(address)} is not found from a style; write url({short(place)})"
                self._remark(message, line + text.count("\n", 0, match.start()))

    def _address(self, tag: str, address: str, attributes: dict[str, str]) -> None:
        """Check whether the file or the page at this address can be loaded."""
        relations = attributes.get("rel", "").lower().split()
        if not address or (tag == "link" and not {"stylesheet", "icon"} & set(relations)):
            return
        if self._on_disk(address):
            return
        if self._is_elsewhere(address):
            host = _HOST.match(address)
            if host is None or MARK not in host[0]:
                self._elsewhere(tag, host[0] if host else address, "stylesheet" in relations)
        elif address.startswith(MARK):
            if tag == "script":
                self._mistake(_SCRIPT)
            elif tag in fragments.ADDRESSES:
                self._begins_with_a_value(address)
        elif tag in ("iframe", "embed", "object"):
            self._remark(f"<{tag}> cannot show a file of the project")
        elif not address.startswith(("#", "?")):
            path = _path(address)
            if MARK not in path:
                self._file(path)
            elif tag == "script":
                self._mistake(_SCRIPT)

    def _link(self, address: str) -> None:
        """Check whether the file at this address can be opened. A link to another site opens whatever it names."""
        path = _path(address)
        if address.startswith(MARK):
            self._begins_with_a_value(address)
        if not path or MARK in path or self._on_disk(address) or self._is_elsewhere(address):
            return
        if path.startswith("/") and not path.startswith("/steps/"):
            return
        if path.lower().endswith((".html", ".htm")):
            self._remark(f"{short(path)} cannot be opened by a link; make it a step, or link to a PDF")
        elif path.startswith("www."):
            self._remark(f"{short(path)} is not found; write https:// before it")
        elif path != "next":
            self._file(path)

    def _on_disk(self, address: str) -> bool:
        """Remark on the address of a file on the researcher's own disk; return whether it is one."""
        if not _ON_DISK.match(address):
            return False
        alone = re.split(r"[/\\]", _path(address))[-1]
        message = (
            f"participants do not have {short(address)}: put the file into {self._folder}/ and write {short(alone)}"
        )
        self._remark(message)
        return True

    def _begins_with_a_value(self, address: str) -> None:
        """Remark on the name of a file that begins with a value: it may be a whole address, so it is not changed."""
        path = _path(address)
        if is_served(path) and "/" not in path:
            self._remark("a file's name that begins with a value is not found; write ./ before it")

    def _elsewhere(self, tag: str, address: str, style_sheet: bool) -> None:
        try:
            parts = urlsplit(address)
            origin = f"{parts.scheme or 'https'}://{parts.netloc.rpartition('@')[2].removesuffix(':443')}".lower()
        except ValueError:
            self._mistake(f"{short(address)} is no address")
            return
        if parts.scheme not in ("", "http", "https"):
            return
        if style_sheet:
            self._mistake(f"style sheets of other places are not loaded; put the file into {self._folder}/")
        elif tag in ("embed", "object"):
            self._mistake(f"<{tag}> is never shown; use <img>, <video>, <audio> or <iframe>")
        elif self._hosts is not None and origin not in self._hosts:
            secure = origin.replace("http://", "https://", 1)
            advice = "write https:// here" if secure in self._hosts else f"add {short(secure)} to allowedHosts"
            self._mistake(f"{short(origin)} is not in allowedHosts of the config file, so nothing is loaded; {advice}")

    def _file(self, path: str) -> None:
        """Check whether this file of the project exists and is shown."""
        name = path.removeprefix(self._own) if self._own else path.rpartition("/")[2]
        name = composed(name.removeprefix("./"))
        alone = re.split(r"[/\\]", name)[-1]
        if name != alone:
            message = f"{short(name)} is not found: put the file into {self._folder}/ itself and write {short(alone)}"
        elif not is_served(name):
            message = f"{short(name)} is not shown: of files beside the pages only {', '.join(KINDS)} are"
        elif name.startswith("."):
            message = f"{short(name)} is not found: its name must not begin with a dot"
        elif name not in self._names:
            message = f"there is no {short(name)} in {self._folder}/{did_you_mean(name, self._names, SIMILAR_FILES)}"
        else:
            return
        self._remark(message)

    def _remark(self, message: str, line: int = 0) -> None:
        self._found.append(Diagnostic(self._label, self._line + line, "", message, remark=True))

    def _mistake(self, message: str) -> None:
        self._found.append(Diagnostic(self._label, self._line, "", message))


def _path(address: str) -> str:
    """The path in a relative address, decoded."""
    return unquote(re.split(r"[?#]", address, maxsplit=1)[0])


def _lines(numbers: list[int]) -> str:
    """The numbers of lines in words: "line 2", "lines 2, 4 and 5"."""
    *others, last = numbers
    return f"lines {', '.join(map(str, others))} and {last}" if others else f"line {last}"
