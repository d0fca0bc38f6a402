"""Checks a page as a whole: questions that share a name, tags left open, values inside scripts."""

from __future__ import annotations

import re
from bisect import bisect
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

from hippodrome.control.config import Diagnostic
from hippodrome.control.participants.markup import MARK, RAW, VOID, Token, attributes
from hippodrome.local.check.page_source import PageSource
from hippodrome.local.check.tags import BUTTONS
from hippodrome.protocol.values import printable

_HARMLESS = re.compile(r"group|.*\|\s*(?:tojson|int|float|length|count)(?:\([^()]*\))?\s*", re.DOTALL)

_OPTIONAL = frozenset(("p", "li", "dt", "dd", "tr", "td", "th", "thead", "tbody", "tfoot", "option", "optgroup"))
_OPTIONAL |= {"rt", "rp", "colgroup", "caption", "html", "head", "body", "form"}
"""Tags whose end tags may be left out, or that the frame removes."""
_SWALLOWS = ("script", "style", "textarea", "title", "select")
"""Tags that, if left open, swallow the rest of the page with its button."""


def check_structure(label: str, page: PageSource) -> list[Diagnostic]:
    """Return the page's mistakes and remarks, in no order."""
    structure = _Structure(label, page)
    problems = [*structure.radios(), *structure.mixed(), *structure.values_in_scripts()]
    # each branch of an {% if %} may open a tag that is closed once
    return problems if page.blocks else [*problems, *structure.left_open()]


class _Radio(NamedTuple):
    """A radio button: its line and value, and the numbers of {% … %} before it, of its fieldset and table row."""

    line: int
    value: str | None
    blocks: int
    fieldset: int
    row: int


class _Structure:
    """The fields of a page by name, its scripts, and the tags that are not closed."""

    def __init__(self, label: str, page: PageSource) -> None:
        self._label, self._page = label, page
        self._radios: dict[str, list[_Radio]] = {}
        self._kinds: dict[tuple[str, int], str] = {}  # by name and blocks: the kind of the first field
        self._mixed: dict[str, int] = {}  # by name: the line of the first field that is a question of its own
        self._scripts: list[range] = []
        self._open: list[tuple[str, int]] = []
        self._left: list[tuple[str, int]] = []
        self._strays: list[tuple[str, int]] = []
        self._comments: list[int] = []
        self._fieldsets: list[int] = []
        self._row = self._count = 0
        for line, token in page.tokens():
            if token.start and token.is_closed:
                self._start(line, token)
            elif token.end:
                self._end(line, token.end)
            elif token.is_comment and not token.is_closed:
                self._comments.append(line)

    def _start(self, line: int, token: Token) -> None:
        tag = token.start
        is_left_open = not token.end_tag if tag in RAW else not token.attributes.endswith("/")  # as <path/> in <svg>
        if is_left_open and tag not in VOID | _OPTIONAL:
            self._open.append((tag, line))
        if tag == "fieldset":
            self._count += 1
            self._fieldsets.append(self._count)
        elif tag == "tr":
            self._row += 1
        elif tag == "script":
            begin = token.at + len(token.source)
            self._scripts.append(range(begin, begin + len(token.content)))
        elif tag in ("input", "select", "textarea"):
            values = attributes(token.attributes)
            kind = values.get("type", "").strip().lower() if tag == "input" else tag
            name = values.get("name", "")
            if name and MARK not in name and kind not in BUTTONS:
                blocks = bisect(self._page.blocks, token.at)
                fieldset = self._fieldsets[-1] if self._fieldsets else 0
                if kind == "radio":
                    radio = _Radio(line, values.get("value"), blocks, fieldset, self._row)
                    self._radios.setdefault(name, []).append(radio)
                first = self._kinds.get((name, blocks))
                self._kinds.setdefault((name, blocks), kind)
                is_list = first == kind and kind in ("radio", "checkbox")
                if first is not None and not is_list and {first, kind} - {"checkbox", "hidden"}:
                    self._mixed.setdefault(name, line)

    def _end(self, line: int, tag: str) -> None:
        if tag == "fieldset" and self._fieldsets:
            self._fieldsets.pop()
        elif tag == "table":
            self._row += 1
        if tag in VOID | _OPTIONAL:
            return
        names = [name for name, _ in self._open]
        if tag in names:
            place = len(names) - 1 - names[::-1].index(tag)
            self._left += self._open[place + 1 :]
            del self._open[place:]
        elif tag in (name for name, _ in self._left):  # closed in another order: browsers mend it
            self._left = [open_tag for open_tag in self._left if open_tag[0] != tag]
        else:
            self._strays.append((tag, line))

    def radios(self) -> Iterator[Diagnostic]:
        """Yield mistakes: radio buttons without a value, and questions that share a name."""
        for name, radios in self._radios.items():
            shown = printable(name, 40)
            for radio in radios:
                if radio.value is None:
                    yield self._mistake(
                        radio.line, f'this choice of {shown} has no value, so it is sent as "on"; add value="…"'
                    )
            again = _second_question(radios)
            if again is not None:
                message = f"an earlier question has the name {shown} too, so only one of the two can be answered"
                yield self._mistake(again.line, f"{message}; give each a name of its own")

    def mixed(self) -> Iterator[Diagnostic]:
        """Yield remarks: fields that share a name, other than the choices of one question.

        Only fields between the same {% … %} are compared.
        """
        for name, line in self._mixed.items():
            message = f"an earlier question has the name {printable(name, 40)} too, so both answers are stored under it"
            yield self._mistake(line, f"{message}, as a list; give each a name of its own", remark=True)

    def values_in_scripts(self) -> Iterator[Diagnostic]:
        """Yield mistakes: values in scripts that an answer can break."""
        for script in self._scripts:
            first = bisect(self._page.values, (script.start,))
            for at, expression in self._page.values[first:]:
                if at not in script:
                    break
                value = expression[2:-2].removeprefix("-").removesuffix("-").strip()
                if not _HARMLESS.fullmatch(value):
                    shown = printable(" ".join(value.split()), 60)
                    message = f"in a <script>, write {{{{ {shown}|tojson }}}} without quotes around it"
                    line = self._page.text.count("\n", 0, at) + 1
                    yield self._mistake(line, f"{message}: else an answer can break it")

    def left_open(self) -> Iterator[Diagnostic]:
        """Yield mistakes and remarks: tags and comments that are never closed, and end tags that close nothing."""
        for tag, line in [*self._left, *self._open]:
            shown, swallows = printable(tag, 40), tag in _SWALLOWS
            rest = ", so the rest of the page is not shown" if swallows else ""
            yield self._mistake(line, f"<{shown}> is never closed{rest}; add </{shown}>", remark=not swallows)
        for tag, line in self._strays:
            yield self._mistake(line, f"</{printable(tag, 40)}> closes nothing; take it out", remark=True)
        for line in self._comments:
            yield self._mistake(line, "this comment is never closed, so the rest is not shown; add -->")

    def _mistake(self, line: int, message: str, *, remark: bool = False) -> Diagnostic:
        return Diagnostic(self._label, line, "", message, remark)


def _second_question(radios: list[_Radio]) -> _Radio | None:
    """The radio button at which a second question of the same name begins; None if there is no such question.

    Only radio buttons between the same {% … %} are compared.
    """
    for number, radio in enumerate(radios):
        before = [earlier for earlier in radios[:number] if earlier.blocks == radio.blocks]
        later = [other for other in radios[number:] if other.blocks == radio.blocks]
        if radio.value is not None and MARK not in radio.value and radio.value in [other.value for other in before]:
            return radio
        for place in ("fieldset", "row"):
            here, earlier = getattr(radio, place), Counter(getattr(other, place) for other in before)
            begins = here and here not in earlier and sum(getattr(other, place) == here for other in later) > 1
            if begins and any(count > 1 for group, count in earlier.items() if group):
                return radio
    return None
