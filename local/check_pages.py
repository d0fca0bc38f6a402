"""What is wrong with step pages: mistakes in their Jinja, and HTML that cannot do what it was written for."""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable, Iterator
from html.parser import HTMLParser
from pathlib import Path
from random import Random
from typing import Any
from urllib.parse import unquote, urlsplit

from jinja2 import meta, nodes
from jinja2.exceptions import SecurityError, TemplateRuntimeError, TemplateSyntaxError, UndefinedError

from hippodrome.config import Config, Diagnostic
from hippodrome.config.diagnostics import printable
from hippodrome.config.steps import StepFileError, open_folder
from hippodrome.participants import fragments
from hippodrome.participants.files import KINDS
from hippodrome.participants.fragments import FragmentError
from local import check_forms, spans
from rehearsal import forms

VALUES = ("answers", "completion_code", "group", "participant", "project")  # what a page may mention: docs/pages.md

_LIMIT = 300  # characters of a message that is not ours
_MARK = "\ue000"  # stands for what Jinja fills in
_JINJA = (spans.VALUE, spans.BLOCK, spans.NOTE)
_HANDLER = re.compile(r"on[a-z]{3,}")
_SCHEME = re.compile(r"[a-z][a-z0-9+.-]*:", re.IGNORECASE)
_IN_STYLE = re.compile(r"""url\(\s*["']?([^"')\s]+)""", re.IGNORECASE)
_IN_SRCSET = re.compile(r"(?:\A|,)\s*([^\s,]+)")
_BUTTONS = ("button", "reset", "submit", "image")  # inputs that do well without a name
_LOADED = {**fragments._ADDRESSES, "iframe": ("src",), "embed": ("src",), "object": ("data",)}


def look(folder: Path, config: Config | None) -> list[Diagnostic]:
    """What is wrong with the pages of the study: with all those in the folder if its configuration is not known."""
    try:
        steps = open_folder(folder)
    except StepFileError:
        return []
    found: list[Diagnostic] = []
    for name, groups in _pages(steps.names, config).items():
        try:
            source = (steps.path / name).read_bytes().decode("utf-8", "replace")
        except OSError:
            continue  # the configuration's check says so
        label = f"{steps.path.name}/{name}"
        here = [
            *_template(label, source, config, groups, _Earlier(steps.path, config, name)),
            *_Html(label, steps.names, config).read(source),
            *check_forms.look(label, source),
        ]
        found += sorted(dict.fromkeys(here), key=lambda problem: problem.line or 0)
    return found + (_of_all(steps.path, steps.names, config) if config else [])


def _of_all(folder: Path, names: Iterable[str], config: Config) -> list[Diagnostic]:
    """What can be said of all pages together only."""
    used = _pages(names, config)
    found = [
        Diagnostic(
            f"{folder.name}/{name}",
            None,
            "",
            "no step shows this page; name it under project.steps, or delete it",
            True,
        )
        for name in sorted(names)
        if name.endswith(".html") and name not in used
    ]
    if config.project.use_aws:
        last = dict.fromkeys(file.name for file in config.steps[-1].files)
        found += [_no_code(f"{folder.name}/{name}") for name in last if not _leads_back(_source(folder / name))]
    return found


def _no_code(label: str) -> Diagnostic:
    message = "this last page shows no code for the recruiting site: write {{ completion_code }}, or a link back to it"
    return Diagnostic(label, None, "", message, remark=True)


def _leads_back(source: str) -> bool:
    """Whether a last page shows the participant's code, or has a link to another place: docs/recruiting.md."""
    try:
        if "completion_code" in meta.find_undeclared_variables(fragments._environment().parse(source)):
            return True
    except Exception:  # noqa: BLE001 - the page's own check says what Jinja cannot read
        return True
    links = _Links()
    links.feed(spans.replace(source, lambda jinja: _MARK, *_JINJA))
    links.close()
    return links.elsewhere


class _Links(HTMLParser):
    """Whether a page has a link to another place."""

    elsewhere = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        address = (dict(attrs).get("href") or "").strip().lower() if tag == "a" else ""
        self.elsewhere = self.elsewhere or address.startswith(("https://", "http://", _MARK))


def _source(path: Path) -> str:
    try:
        return path.read_bytes().decode("utf-8", "replace")
    except OSError:
        return ""  # the configuration's check says so


class _Earlier:
    """The answers of a participant who sees a page: to every question, or only to the required ones."""

    def __init__(self, folder: Path, config: Config | None, name: str) -> None:
        self._folder = folder
        steps = list(config.steps) if config else []
        place = next((n for n, step in enumerate(steps) if name in [file.name for file in step.files]), 0)
        self._steps = steps[:place]

    def answers(self, group: int | None) -> list[dict[str, dict[str, Any]]]:
        """By step: the most that may have been answered there, and the least."""
        most: dict[str, dict[str, Any]] = {}
        least: dict[str, dict[str, Any]] = {}
        for step in self._steps:
            if step.type.on_server:
                most[step.key] = least[step.key] = dict(_PLAYED)
                continue
            file = step.files[(group or 0) if step.variants else 0]
            page = spans.replace(_source(self._folder / file.name), lambda jinja: _MARK, *_JINJA)
            most[step.key], least[step.key] = _answered(page)
        return [most, least]


_PLAYED = {"episodes": 1, "score": 1.5, "frames": 100, "seconds": 3.5, "trial": "t", "outcome": "finished"}


def _answered(page: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Answers to a page: to all its questions, and to those only that must be answered."""
    found = forms.forms(f"<form>{fragments.prepare(page).text}</form>")
    if not found:
        return {}, {}
    controls = found[0].controls
    filled = forms.gathered(forms.fill(found[0], Random(1)))  # noqa: S311 - nothing secret
    most = {control.name: "1" for control in controls if control.name} | filled
    boxes = {control.name for control in controls if control.kind in ("checkbox", "radio")}
    needed = {control.name for control in controls if control.required}
    least = {
        name: (value if name in needed else "") for name, value in most.items() if name in needed or name not in boxes
    }
    return most, least


def _pages(names: Iterable[str], config: Config | None) -> dict[str, list[int | None]]:
    """The files of the pages in the study's order, and the groups that may see each."""
    if config is None:
        return {name: [None] for name in names if name.endswith(".html")}
    most = max((step.variants for step in config.steps), default=0)
    everybody: list[int | None] = [*range(most)] or [None]
    pages: dict[str, list[int | None]] = {}
    for step in config.steps:
        for group, file in enumerate(step.files):
            pages[file.name] = [group] if step.variants else everybody
    return pages


# Jinja


def _template(
    label: str, source: str, config: Config | None, groups: list[int | None], earlier: _Earlier
) -> Iterator[Diagnostic]:
    """Whether the page can be read, and whether it can be shown to somebody who has answered the pages before it."""
    page = fragments.prepare(source)
    if not fragments._uses_jinja(page.text):
        return
    environment = fragments._environment()
    try:
        parsed = environment.parse(page.text)
    except TemplateSyntaxError as error:
        yield Diagnostic(label, error.lineno, "", _unread(error))
        return
    except Exception as error:  # noqa: BLE001 - such as a page that is nested too deeply
        yield Diagnostic(label, None, "", f"Jinja cannot read this page: {_short(str(error))}")
        return
    unknown = [*_unknown(label, parsed, environment)]
    if unknown:  # Jinja would say the same of the first
        yield from unknown
        return
    strangers = meta.find_undeclared_variables(parsed) - {*VALUES, *environment.globals}
    for name in parsed.find_all(nodes.Name):
        if name.name in strangers:
            strangers.remove(name.name)
            message = f"nothing is shown: there is no value {_short(name.name)}{_nearest(name.name, VALUES)}"
            yield Diagnostic(label, name.lineno, "", message, remark=True)
    for group in groups:
        for answers in earlier.answers(group):
            try:
                page.render({**_nothing_known(config, group), "answers": answers})
            except FragmentError as error:
                yield _failing(label, error, may_depend=bool(fragments.needs(page.text)))
                return


def _unread(error: TemplateSyntaxError) -> str:
    comment = (
        '; {# begins a comment, also in a style: write "{ #" there' if "end of comment" in str(error.message) else ""
    )
    return f"Jinja cannot read this: {_short(error.message or '')}{comment}"


def _unknown(label: str, parsed: nodes.Template, environment: Any) -> Iterator[Diagnostic]:
    """Filters and tests that do not exist: Jinja itself finds those of a condition only when it holds."""
    for kind, node_type, known in (
        ("filter", nodes.Filter, environment.filters),
        ("test", nodes.Test, environment.tests),
    ):
        for node in parsed.find_all(node_type):
            if node.name not in known:
                message = f"there is no {kind} {_short(node.name)} in Jinja{_nearest(node.name, known)}"
                yield Diagnostic(label, node.lineno, "", message)


def _nothing_known(config: Config | None, group: int | None) -> dict[str, Any]:
    """What a page may mention, for somebody who has not answered anything."""
    project = config.project if config else None
    return {
        "project": {
            "id": project.id if project else "",
            "name": (project.name or project.id) if project else "",
            "researcher": project.researcher if project else "",
        },
        "participant": {"userId": "P1"},
        "group": group,
        "completion_code": "ABCDEF",
        "answers": {},
    }


def _failing(label: str, error: FragmentError, may_depend: bool) -> Diagnostic:
    """A page that cannot be shown; only a remark if it may be possible with answers."""
    cause, why = error.__cause__, _short(error.message)
    if isinstance(cause, TypeError) and "no loader" in str(cause):
        why = "include, import and extends do not work: a page is one file"
    elif isinstance(cause, TemplateSyntaxError):
        why = _unread(cause)
    elif may_depend and cause is not None and not _certain(cause):
        why = f"whoever lacks the answer gets an error page here ({why}); |default(…) helps"
        return Diagnostic(label, error.line, "", why, remark=True)
    else:
        why = f"the page cannot be shown: {why}"
    return Diagnostic(label, error.line, "", why)


def _certain(cause: BaseException) -> bool:
    """Whether it fails whatever the participants answer."""
    return isinstance(cause, SecurityError) or (
        isinstance(cause, TemplateRuntimeError) and not isinstance(cause, UndefinedError)
    )


# HTML


class _Html(HTMLParser):
    """Looks at each tag of a page for what browsers or our frame will not do."""

    def __init__(self, label: str, names: Iterable[str], config: Config | None) -> None:
        super().__init__()
        self._label = label
        self._folder = label.partition("/")[0]
        self._names = frozenset(names)
        self._own = f"/steps/{config.project.id}/" if config else None
        self._hosts = frozenset(config.project.allowed_hosts) if config else None
        self._found: list[Diagnostic] = []
        self._styling = False

    def read(self, source: str) -> list[Diagnostic]:
        """Everything that is wrong. Jinja's expressions are set aside, and what depends on them is not judged."""
        self.feed(spans.replace(source, lambda jinja: _MARK + spans.lines(jinja), *_JINJA))
        self.close()
        return self._found

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given: dict[str, str] = {}
        for name, value in attrs:
            given.setdefault(name, (value or "").strip())
        self._styling = tag == "style"
        self._field(tag, given)
        for name, value in given.items():
            if _HANDLER.fullmatch(name) and value:
                self._remark(f"{name} never runs; use addEventListener in a <script> of the page")
            elif name in ("href", "src", "action") and value.lower().startswith("javascript:"):
                self._remark("javascript: never runs; use addEventListener in a <script> of the page")
            elif name == "style":
                self._style(value)
            elif name in _LOADED.get(tag, ()):
                for address in _IN_SRCSET.findall(value) if name == "srcset" else [value]:
                    self._address(tag, address, given)

    def handle_endtag(self, tag: str) -> None:
        self._styling = False

    def handle_data(self, data: str) -> None:
        if self._styling:
            self._style(data)

    def _field(self, tag: str, given: dict[str, str]) -> None:
        kind = given.get("type", "").lower() if tag == "input" else tag
        if kind == "file":
            self._mistake("files cannot be sent; take this field out")
        elif tag in ("input", "select", "textarea") and kind not in _BUTTONS and not given.get("name"):
            self._remark(f"this <{tag}> has no name, so what is entered there is never sent")

    def _style(self, text: str) -> None:
        for found in _IN_STYLE.finditer(text):
            address = found[1]
            if _MARK not in address and not address.startswith(("/", "#")) and not _SCHEME.match(address):
                place = f"{self._own or '/steps/your-project/'}{address.removeprefix('./')}"
                line = text[: found.start()].count("\n")
                self._remark(f"{_short(address)} is not found from a style; write url({_short(place)})", line)

    def _address(self, tag: str, address: str, given: dict[str, str]) -> None:
        """Whether what is loaded from there can be loaded."""
        relations = given.get("rel", "").lower().split()
        if _MARK in address or not address or (tag == "link" and not {"stylesheet", "icon"} & set(relations)):
            return
        if address.startswith("//") or _SCHEME.match(address):
            self._elsewhere(tag, address, "stylesheet" in relations)
        elif tag in ("iframe", "embed", "object"):
            self._remark(f"<{tag}> cannot show a file of the project")
        elif not address.startswith(("#", "?")):
            self._file(unquote(re.split(r"[?#]", address, maxsplit=1)[0]))

    def _elsewhere(self, tag: str, address: str, style_sheet: bool) -> None:
        try:
            parts = urlsplit(address)
            origin = f"{parts.scheme or 'https'}://{parts.netloc.rpartition('@')[2].removesuffix(':443')}".lower()
        except ValueError:
            self._mistake(f"{_short(address)} is no address")
            return
        if parts.scheme not in ("", "http", "https"):
            return
        if style_sheet:
            self._mistake(f"style sheets of other places are not loaded; put the file into {self._folder}/")
        elif tag in ("embed", "object"):
            self._mistake(f"<{tag}> is never shown; use <img>, <video>, <audio> or <iframe>")
        elif self._hosts is not None and origin not in self._hosts:
            secure = origin.replace("http://", "https://", 1)
            known = "write https:// here" if secure in self._hosts else f"add {_short(secure)} to allowedHosts"
            self._mistake(f"{_short(origin)} is not in allowedHosts of the config file, so nothing is loaded; {known}")

    def _file(self, path: str) -> None:
        """A file of the project's, by its name."""
        name = path.removeprefix(self._own) if self._own else path.rpartition("/")[2]
        name = name.removeprefix("./")
        alone = re.split(r"[/\\]", name)[-1]
        kind = alone.rpartition(".")[2].lower()
        if name != alone:
            message = f"{_short(name)} is not found: put the file into {self._folder}/ itself and write {_short(alone)}"
        elif kind not in KINDS:
            message = f"{_short(name)} is not shown: of files beside the pages only {', '.join(KINDS)} are"
        elif name.startswith("."):
            message = f"{_short(name)} is not found: its name must not begin with a dot"
        elif name not in self._names:
            message = f"there is no {_short(name)} in {self._folder}/{_nearest(name, self._names)}"
        else:
            return
        self._remark(message)

    def _remark(self, message: str, line: int = 0) -> None:
        self._found.append(Diagnostic(self._label, self.getpos()[0] + line, "", message, remark=True))

    def _mistake(self, message: str) -> None:
        self._found.append(Diagnostic(self._label, self.getpos()[0], "", message))


# Words


def _nearest(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, known, n=1, cutoff=0.75)
    return f"; did you mean {near[0]}?" if near else ""


def _short(text: str) -> str:
    return printable(" ".join(text.split()), _LIMIT)
