"""Filling in a page's form as a person might: from the page's own inputs and within their limits. Pure.

What is sent is what a browser would send (https://html.spec.whatwg.org/#constructing-the-form-data-set): the fields in
their order, hidden ones as they are, line ends as CR LF, and the button that was pressed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import date, datetime, timedelta
from decimal import ROUND_FLOOR, Decimal, InvalidOperation
from random import Random

from bots.forms import PRESSED, Control, Form

Pairs = list[tuple[str, str]]

ANSWERED = 0.8
"""The share of the optional fields that get an answer."""

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
_EPOCH = datetime(1970, 1, 1)


def fill(form: Form, random: Random) -> Pairs:
    """Answers to every required field and most of the others, with one of the buttons."""
    chosen = _choose_radios(form, random)
    checked = _choose_boxes(form, random)
    pressed = random.choice(form.buttons) if form.buttons else None
    pairs: Pairs = []
    for control in form.controls:
        if control.kind in PRESSED:
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


def gathered(pairs: Iterable[tuple[str, str]]) -> dict[str, str | list[str]]:
    """The answers as they are to be stored: a name that comes twice holds all its values."""
    seen: dict[str, list[str]] = {}
    for name, value in pairs:
        if not name.startswith("hippodrome-"):
            seen.setdefault(name, []).append(value)
    return {name: values[0] if len(values) == 1 else values for name, values in seen.items()}
