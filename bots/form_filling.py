"""Filling in a page's form as a person might: from the page's own inputs and within their limits. Pure.

What is sent is what a browser would send (https://html.spec.whatwg.org/#constructing-the-form-data-set): the fields in
their order, hidden ones as they are, line ends as CR LF, and the button that was pressed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from datetime import date, datetime, timedelta
from decimal import ROUND_FLOOR, Decimal, InvalidOperation
from html.parser import HTMLParser
from random import Random

Pairs = list[tuple[str, str]]

ANSWERED = 0.8
"""Of the fields that may be left out, so many get an answer."""

_WORDS = (
    "It was fine, thank you.",
    "Ça allait très bien — «merci»",
    'I said "no" & meant <b>yes</b>',
    "50 % = ½; 1 < 2 > 0, isn't it?",
    "很好玩 🎮 ありがとう",
    "نعم، أحببته",
    "  with spaces around  ",
    "a+b=c&d=%20\\n",
    "{{ 7 * 7 }} {% raw %}",
    "x",
)
_PATTERNS = (
    "1",
    "12",
    "123",
    "1234",
    "12345",
    "123456",
    "a",
    "ab",
    "abc",
    "abcdef",
    "A",
    "AB",
    "ABC",
    "ABC123",
    "a1b2",
)
_PRESSED = ("submit", "image")
_NEVER_SENT = ("reset", "button")
_EPOCH = datetime(1970, 1, 1)


@dataclass(frozen=True)
class Option:
    """One choice of a select."""

    value: str
    selected: bool = False
    disabled: bool = False


@dataclass
class Control:
    """An input, select, textarea or button; `kind` is the type of an input or button, or the name of the element."""

    kind: str
    given: Mapping[str, str]
    options: list[Option] = field(default_factory=list)
    text: str = ""  # of a textarea

    @property
    def name(self) -> str:
        return self.given.get("name", "")

    @property
    def required(self) -> bool:
        return "required" in self.given

    @property
    def value(self) -> str:
        return self.given.get("value", "")


@dataclass
class Form:
    """A form of a page. Disabled fields are not in it."""

    action: str
    method: str
    controls: list[Control] = field(default_factory=list)

    @property
    def buttons(self) -> list[Control]:
        return [control for control in self.controls if control.kind in _PRESSED]


def forms(page: str) -> list[Form]:
    """The forms of a page in their order."""
    reader = _Reader()
    reader.feed(page)
    reader.close()
    return reader.forms


def to_answer(page: str) -> Form | None:
    """The form that a page asks to be answered; None if it asks for nothing."""
    return next((form for form in forms(page) if form.method == "post"), None)


def fill(form: Form, random: Random) -> Pairs:
    """Answers to every required field and most of the others, with one of the buttons."""
    chosen = _choose_radios(form, random)
    checked = _choose_boxes(form, random)
    pressed = random.choice(form.buttons) if form.buttons else None
    pairs: Pairs = []
    for control in form.controls:
        if control.kind in _PRESSED:
            values = [control.value] if control is pressed else []
            if control is pressed and control.kind == "image":
                prefix = f"{control.name}." if control.name else ""
                pairs += [(f"{prefix}x", "1"), (f"{prefix}y", "1")]
                continue
        elif control.kind == "radio":
            values = [control.given.get("value", "on")] if control in chosen else []
        elif control.kind == "checkbox":
            values = [control.given.get("value", "on")] if control in checked else []
        elif control.kind == "select":
            values = _select(control, random)
        else:
            values = [_text(control, random)]
        if control.name:
            pairs += [(control.name, re.sub(r"\r\n|\r|\n", "\r\n", value)) for value in values]
    return pairs


# Choices


def _choose_radios(form: Form, random: Random) -> list[Control]:
    sets: dict[str, list[Control]] = {}
    for control in form.controls:
        if control.kind == "radio":
            sets.setdefault(control.name, []).append(control)
    chosen = []
    for circles in sets.values():
        given = [circle for circle in circles if "checked" in circle.given]
        if any(circle.required for circle in circles) or random.random() < ANSWERED:
            chosen.append(random.choice(circles))
        else:
            chosen += given[-1:]
    return chosen


def _choose_boxes(form: Form, random: Random) -> list[Control]:
    return [
        control
        for control in form.controls
        if control.kind == "checkbox" and (control.required or random.random() < 0.5)
    ]


def _select(control: Control, random: Random) -> list[str]:
    free = [option for option in control.options if not option.disabled]
    answers = [option for option in free if option.value] or free
    if not answers:
        return []
    if "multiple" in control.given:
        least = 1 if control.required else 0
        some = random.sample(answers, random.randint(least, len(answers)))
        return [option.value for option in free if option in some]
    if control.required or random.random() < ANSWERED:
        return [random.choice(answers).value]
    return [next((option for option in reversed(free) if option.selected), free[0]).value]


# Texts, numbers and times


def _text(control: Control, random: Random) -> str:
    """What a field that holds a text is filled with."""
    if control.kind in _MADE and "readonly" not in control.given:
        if control.required or control.kind in ("range", "color") or random.random() < ANSWERED:
            return _MADE[control.kind](control, random)
        return ""
    return control.text if control.kind == "textarea" else control.value


def _words(control: Control, random: Random) -> str:
    joint = "\n" if control.kind == "textarea" else " "
    return _fitted(control, joint.join(random.sample(_WORDS, random.randint(1, 3))))


def _phrase(control: Control, random: Random) -> str:
    pattern = control.given.get("pattern")
    if pattern is None:
        return _words(control, random)
    try:
        fitting = [text for text in _PATTERNS if re.fullmatch(pattern, text)]
    except re.error:  # JavaScript's expressions are not quite Python's
        fitting = []
    return _fitted(control, random.choice(fitting or _PATTERNS))


def _fitted(control: Control, text: str) -> str:
    """The text within minlength and maxlength, which count as JavaScript does."""
    most, least = _whole(control.given.get("maxlength")), _whole(control.given.get("minlength"))
    while most is not None and text and _length(text) > most:
        text = text[:-1]
    return text + "x" * max(0, (least or 0) - _length(text)) if text else "x" * (least or 0)


def _length(text: str) -> int:
    return len(text.encode("utf-16-le")) // 2


def _email(control: Control, random: Random) -> str:
    return f"p{random.randrange(10**4)}@example.org"


def _url(control: Control, random: Random) -> str:
    return f"https://example.org/{random.randrange(10**4)}"


def _phone(control: Control, random: Random) -> str:
    return _phrase(control, random) if "pattern" in control.given else "+1 204 555 0100"


def _color(control: Control, random: Random) -> str:
    return f"#{random.randrange(1 << 24):06x}"


def _number(control: Control, random: Random) -> str:
    slider = control.kind == "range"
    low, high = _decimal(control.given.get("min")), _decimal(control.given.get("max"))
    base = low if low is not None else _decimal(control.given.get("value")) or Decimal(0)
    step = _decimal(control.given.get("step"))
    if step is None or step <= 0:
        step = Decimal("0.25") if control.given.get("step", "").lower() == "any" else Decimal(1)
    if slider:
        low = Decimal(0) if low is None else low
        base = low
        high = max(low, Decimal(100) if high is None else high)
    return _plain(_on_grid(low, high, base, step, random))


def _on_grid(low: Decimal | None, high: Decimal | None, base: Decimal, step: Decimal, random: Random) -> Decimal:
    """A value from low to high (and not far from base) that is whole steps away from base."""
    first = -20 if low is None else -_floor((base - low) / step)
    last = first + 40 if high is None else _floor((high - base) / step)
    if low is None and high is not None:
        first = last - 40
    return base + step * (random.randint(first, last) if first <= last else 0)


def _floor(number: Decimal) -> int:
    """The largest whole number that is not above; Decimal's own `//` rounds towards zero."""
    return int(number.to_integral_value(ROUND_FLOOR))


def _plain(number: Decimal) -> str:
    text = f"{number:f}"
    return (text.rstrip("0").rstrip(".") if "." in text else text) or "0"


def _when(control: Control, random: Random) -> str:
    """A date, time, month or week within its limits, counted in steps of its smallest part."""
    kind = control.kind
    unit = _SECONDS[kind]
    low, high = _moment(kind, control.given.get("min")), _moment(kind, control.given.get("max"))
    step = _decimal(control.given.get("step"))
    length = unit * (step if step is not None and step > 0 else Decimal(60 if unit == 1 else 1))
    if kind == "time":
        low = Decimal(0) if low is None else low
        high = Decimal(86399) if high is None or high < low else high  # a time after midnight is as good as before
    elif low is None and high is None:
        low = _moment(kind, _PLAIN[kind])
    given = _moment(kind, control.given.get("value"))
    base = low if control.given.get("min") and low is not None else given if given is not None else Decimal(0)
    if kind == "week" and low is None and given is None:
        base = Decimal(4 * 86400)  # the first Monday
    seconds = _on_grid(low, high, base, length, random)
    return _write(kind, int(seconds))


def _moment(kind: str, text: str | None) -> Decimal | None:
    """Seconds (of months: months) since 1970 began; None for what is no such time."""
    if not text:
        return None
    try:
        if kind == "month":
            day = date.fromisoformat(f"{text}-01")
            return Decimal((day.year - 1970) * 12 + day.month - 1)
        if kind == "week":
            text = f"{text}-1"
        if kind == "time":
            text = f"1970-01-01T{text}"
        return Decimal(int((datetime.fromisoformat(text) - _EPOCH).total_seconds()))
    except (ValueError, OverflowError):
        return None


def _write(kind: str, count: int) -> str:
    if kind == "month":
        return f"{1970 + count // 12:04d}-{count % 12 + 1:02d}"
    moment = _EPOCH + timedelta(seconds=count)
    if kind == "date":
        return moment.date().isoformat()
    if kind == "week":
        year, week, _ = moment.isocalendar()
        return f"{year:04d}-W{week:02d}"
    clock = moment.strftime("%H:%M:%S" if moment.second else "%H:%M")
    return clock if kind == "time" else f"{moment.date().isoformat()}T{clock}"


def _decimal(text: str | None) -> Decimal | None:
    try:
        number = Decimal(text or "")
    except InvalidOperation:
        return None
    return number if number.is_finite() else None


def _whole(text: str | None) -> int | None:
    return int(text) if text and text.isdecimal() else None


_SECONDS = {"date": 86400, "time": 1, "datetime-local": 1, "month": 1, "week": 7 * 86400}
_PLAIN = {"date": "2024-02-29", "datetime-local": "2024-02-29T12:00", "month": "2024-02", "week": "2024-W09"}
_MADE = {
    "text": _phrase,
    "search": _phrase,
    "password": _phrase,
    "textarea": _words,
    "email": _email,
    "url": _url,
    "tel": _phone,
    "color": _color,
    "number": _number,
    "range": _number,
    **dict.fromkeys(_SECONDS, _when),
}
_TYPES = {*_MADE, *_PRESSED, *_NEVER_SENT, "hidden", "radio", "checkbox", "file"} - {"textarea"}


# Reading


class _Reader(HTMLParser):
    """Gathers forms. Follows `form="…"` and disabled fieldsets; tolerates what browsers tolerate."""

    def __init__(self) -> None:
        super().__init__(convert_charrefs=True)
        self.forms: list[Form] = []
        self._by_id: dict[str, Form] = {}
        self._form: Form | None = None
        self._elsewhere: list[tuple[str, Control]] = []  # controls that name their form
        self._fieldsets: list[_Fieldset] = []
        self._select: Control | None = None
        self._option: dict[str, str] | None = None
        self._label: list[str] = []  # the text of the option
        self._group_disabled = False
        self._textarea: Control | None = None

    def handle_starttag(self, tag: str, attrs: Iterable[tuple[str, str | None]]) -> None:
        given: dict[str, str] = {}
        for name, value in attrs:
            given.setdefault(name, value or "")
        if tag == "form" and self._form is None:
            self._form = Form(given.get("action", ""), given.get("method", "get").lower())
            self.forms.append(self._form)
            self._by_id.setdefault(given.get("id", ""), self._form)
        elif tag == "fieldset":
            self._fieldsets.append(_Fieldset("disabled" in given))
        elif tag == "legend" and self._fieldsets:
            self._fieldsets[-1].legend_begins()
        elif tag == "input":
            kind = given.get("type", "text").lower()
            self._add(Control(kind if kind in _TYPES else "text", given))
        elif tag == "button":
            kind = given.get("type", "submit").lower()
            self._add(Control(kind if kind in _NEVER_SENT else "submit", given))
        elif tag == "textarea":
            self._textarea = Control("textarea", given)
            self._add(self._textarea)
        elif tag == "select":
            self._select = Control("select", given)
            self._add(self._select)
        elif tag == "optgroup":
            self._end_option()
            self._group_disabled = "disabled" in given
        elif tag == "option" and self._select is not None:
            self._end_option()
            self._option, self._label = given, []

    def handle_endtag(self, tag: str) -> None:
        if tag == "form":
            self._form = None
        elif tag == "fieldset" and self._fieldsets:
            self._fieldsets.pop()
        elif tag == "legend" and self._fieldsets:
            self._fieldsets[-1].in_legend = False
        elif tag == "textarea" and self._textarea is not None:
            self._textarea.text = self._textarea.text.removeprefix("\n")
            self._textarea = None
        elif tag == "option":
            self._end_option()
        elif tag == "optgroup":
            self._end_option()
            self._group_disabled = False
        elif tag == "select":
            self._end_option()
            self._select, self._group_disabled = None, False

    def handle_data(self, data: str) -> None:
        if self._textarea is not None:
            self._textarea.text += data
        elif self._option is not None:
            self._label.append(data)

    def close(self) -> None:
        super().close()
        for form_id, control in self._elsewhere:
            if form_id in self._by_id:
                self._by_id[form_id].controls.append(control)

    def _add(self, control: Control) -> None:
        if "disabled" in control.given or any(fieldset.disables for fieldset in self._fieldsets):
            return
        if control.kind in _NEVER_SENT:
            return
        if "form" in control.given:
            self._elsewhere.append((control.given["form"], control))
        elif self._form is not None:
            self._form.controls.append(control)

    def _end_option(self) -> None:
        if self._select is not None and self._option is not None:
            given = self._option
            text = " ".join("".join(self._label).split())
            disabled = "disabled" in given or self._group_disabled
            self._select.options.append(Option(given.get("value", text), "selected" in given, disabled))
        self._option = None


@dataclass
class _Fieldset:
    """A fieldset that is open; what stands in its first legend is not disabled with it."""

    disabled: bool
    legends: int = 0
    in_legend: bool = False

    def legend_begins(self) -> None:
        self.legends += 1
        self.in_legend = self.legends == 1

    @property
    def disables(self) -> bool:
        return self.disabled and not self.in_legend


def gathered(pairs: Iterable[tuple[str, str]]) -> dict[str, str | list[str]]:
    """The answers as they are to be stored: a name that comes twice holds all its values."""
    seen: dict[str, list[str]] = {}
    for name, value in pairs:
        if not name.startswith("hippodrome-"):
            seen.setdefault(name, []).append(value)
    return {name: values[0] if len(values) == 1 else values for name, values in seen.items()}


def hidden(form: Form) -> Iterator[tuple[str, str]]:
    """The hidden fields of a form."""
    return ((control.name, control.value) for control in form.controls if control.kind == "hidden")
