"""Checks a page as a whole: questions that share a name, tags left open, values inside scripts."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from hippodrome.control.config import Diagnostic
from hippodrome.control.participants.page_parser import VOID, PageParser, attributes_of
from hippodrome.local.check import spans
from hippodrome.local.check.tags import BUTTONS
from hippodrome.protocol.values import printable

_HARMLESS = re.compile(r"group|.*\|\s*(?:tojson|int|float|length|count)(?:\([^()]*\))?\s*", re.DOTALL)
_STEP = "\ue001"  # stands for {% … %}

_OPTIONAL = frozenset(("p", "li", "dt", "dd", "tr", "td", "th", "thead", "tbody", "tfoot", "option", "optgroup"))
_OPTIONAL |= {"rt", "rp", "colgroup", "caption", "html", "head", "body", "form"}
"""Tags whose end tags may be left out, or that the frame removes."""
_SWALLOWS = ("script", "style", "textarea", "title", "select")
"""Tags that, if left open, swallow the rest of the page with its button."""


def check_structure(label: str, source: str) -> list[Diagnostic]:
    """Return the page's mistakes and remarks, in no order."""
    check_structure = [*_scripts(label, source)]
    text = spans.replace(source, spans.lines, spans.RAW)
    text = spans.replace(text, lambda value: spans.MARK + spans.lines(value), spans.VALUE, spans.NOTE)
    text = spans.replace(text, lambda block: _STEP + spans.lines(block), spans.BLOCK)
    reader = _Reader(label)
    reader.feed(text)
    reader.close()
    check_structure += [*reader.radios(), *reader.mixed()]
    if _STEP not in text:  # each branch of an {% if %} may open a tag that is closed once
        check_structure += reader.open_tags()
        check_structure += _comments(label, text)
    return check_structure


def _scripts(label: str, source: str) -> Iterator[Diagnostic]:
    """Mistakes: values in scripts that an answer can break."""
    text = spans.replace(source, _blank, spans.RAW)
    for script in spans.spans(text, spans.SCRIPT):
        inside = text[script.inside : script.until]
        for value in spans.spans(inside, spans.VALUE):
            expression = inside[value.inside : value.until].removeprefix("-").removesuffix("-").strip()
            if _HARMLESS.fullmatch(expression):
                continue
            line = text.count("\n", 0, script.inside + value.start) + 1
            shown = printable(" ".join(expression.split()), 60)
            message = (
                f"in a <script>, write {{{{ {shown}|tojson }}}} without quotes around it: else an answer can break it"
            )
            yield Diagnostic(label, line, "", message)


def _comments(label: str, text: str) -> Iterator[Diagnostic]:
    """A mistake: a comment that is never closed."""
    rest = spans.replace(text, _blank, spans.COMMENT)
    begin = rest.find("<!--")
    if begin >= 0:
        yield Diagnostic(
            label, rest[:begin].count("\n") + 1, "", "this comment is never closed, so the rest is not shown; add -->"
        )


@dataclass
class _Radio:
    """A radio button: its line and value, and the numbers of {% … %} before it, of its fieldset and table row."""

    line: int
    value: str | None
    blocks: int
    fieldset: int
    row: int


class _Reader(PageParser):
    """Notes the names of the fields of a page, its radio buttons, and the tags that are not closed."""

    def __init__(self, label: str) -> None:
        super().__init__()
        self._label = label
        self._radios: dict[str, list[_Radio]] = {}
        self._kinds: dict[tuple[str, int], bool] = {}  # by name and blocks: whether the first field is a radio button
        self._mixed: dict[str, int] = {}  # by name: the line of the first field that is of the other kind
        self._open: list[tuple[str, int]] = []
        self._left: list[tuple[str, int]] = []
        self._strays: list[tuple[str, int]] = []
        self._blocks = self._count = 0
        self._fieldsets: list[int] = []
        self._row = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        attributes = attributes_of(attrs)
        self._blocks += sum((value or "").count(_STEP) + name.count(_STEP) for name, value in attrs)
        if tag not in VOID and tag not in _OPTIONAL:
            self._open.append((tag, self.getpos()[0]))
        if tag == "fieldset":
            self._count += 1
            self._fieldsets.append(self._count)
        elif tag == "tr":
            self._row += 1
        elif tag in ("input", "select", "textarea"):
            name, kind = (
                attributes.get("name", ""),
                attributes.get("type", "").strip().lower() if tag == "input" else tag,
            )
            if name and spans.MARK not in name and _STEP not in name and kind not in BUTTONS:
                self._field(name, kind == "radio", attributes.get("value"))

    def _field(self, name: str, is_radio: bool, value: str | None) -> None:
        line = self.getpos()[0]
        if is_radio:
            fieldset = self._fieldsets[-1] if self._fieldsets else 0
            self._radios.setdefault(name, []).append(_Radio(line, value, self._blocks, fieldset, self._row))
        if self._kinds.setdefault((name, self._blocks), is_radio) != is_radio:
            self._mixed.setdefault(name, line)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attrs)
        if tag not in VOID and tag not in _OPTIONAL:
            self._open.pop()  # such as <path/> in an <svg>

    def handle_endtag(self, tag: str) -> None:
        if tag == "fieldset" and self._fieldsets:
            self._fieldsets.pop()
        elif tag == "table":
            self._row += 1
        if tag in VOID or tag in _OPTIONAL:
            return
        names = [name for name, _ in self._open]
        if tag in names:
            place = len(names) - 1 - names[::-1].index(tag)
            self._left += self._open[place + 1 :]
            del self._open[place:]
        elif tag in (name for name, _ in self._left):
            self._left = [
                open_tag for open_tag in self._left if open_tag[0] != tag
            ]  # closed in another order: browsers mend it
        else:
            self._strays.append((tag, self.getpos()[0]))

    def handle_data(self, data: str) -> None:
        self._blocks += data.count(_STEP)

    # Diagnostics

    def radios(self) -> Iterator[Diagnostic]:
        """Yield mistakes: radio buttons without a value, and questions that share a name."""
        for name, radios in self._radios.items():
            shown = printable(name, 40)
            for radio in radios:
                if radio.value is None:
                    message = f'this choice of {shown} has no value, so it is sent as "on"; add value="…"'
                    yield Diagnostic(self._label, radio.line, "", message)
            again = self._second_question(radios)
            if again is not None:
                message = (
                    f"an earlier question has the name {shown} too, so only one of the two can be answered; "
                    "give each a name of its own"
                )
                yield Diagnostic(self._label, again.line, "", message)

    def mixed(self) -> Iterator[Diagnostic]:
        """Yield remarks: radio buttons that share their name with a field of another kind, such as a slider.

        Only fields between the same {% … %} are compared.
        """
        for name, line in self._mixed.items():
            message = (
                f"an earlier question has the name {printable(name, 40)} too, so both answers are stored under it, as "
                "a list; give each a name of its own"
            )
            yield Diagnostic(self._label, line, "", message, remark=True)

    @staticmethod
    def _second_question(radios: list[_Radio]) -> _Radio | None:
        """The radio button at which a second question of the same name begins; None if there is no such question.

        Only radio buttons between the same {% … %} are compared.
        """
        for number, radio in enumerate(radios):
            before = [radio_button for radio_button in radios[:number] if radio_button.blocks == radio.blocks]
            same = [radio_button for radio_button in radios[number:] if radio_button.blocks == radio.blocks]
            if not before:
                continue
            if (
                radio.value is not None
                and spans.MARK not in radio.value
                and radio.value in [radio_button.value for radio_button in before]
            ):
                return radio
            for place in ("fieldset", "row"):
                here, earlier = getattr(radio, place), Counter(getattr(radio_button, place) for radio_button in before)
                begins = (
                    here
                    and here not in earlier
                    and sum(getattr(radio_button, place) == here for radio_button in same) > 1
                )
                if begins and any(count > 1 for text, count in earlier.items() if text):
                    return radio
        return None

    def open_tags(self) -> Iterator[Diagnostic]:
        """Yield mistakes and remarks: tags that are never closed, and end tags that close nothing."""
        for tag, line in [*self._left, *self._open]:
            swallows = tag in _SWALLOWS
            rest = ", so the rest of the page is not shown" if swallows else ""
            yield Diagnostic(
                self._label, line, "", f"<{_plain(tag)}> is never closed{rest}; add </{_plain(tag)}>", not swallows
            )
        for tag, line in self._strays:
            yield Diagnostic(self._label, line, "", f"</{_plain(tag)}> closes nothing; take it out", remark=True)


def _blank(text: str) -> str:
    """The text with every character replaced by a space, except for the ends of lines."""
    return re.sub(r"[^\n]", " ", text)


def _plain(tag: str) -> str:
    return printable(tag, 40)
