"""Fills in a page's form as a person might, within the limits of its inputs. Pure.

The result is what a browser would send (https://html.spec.whatwg.org/#constructing-the-form-data-set): the fields in
their order, hidden fields unchanged, line ends as CR LF, and the button that was pressed.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from decimal import Decimal, InvalidOperation
from math import floor
from random import Random

from hippodrome.bots.forms import PRESSED, Control, Form

Pairs = list[tuple[str, str]]

ANSWERED = 0.8
"""The probability with which an optional field gets an answer."""

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


def fill(form: Form, random: Random) -> Pairs:
    """Return a name and value for each field that a browser would send.

    Every required field has an answer, most of the others too, and one of the buttons is pressed.
    """
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
            values = [control.attributes.get("value", "on")] if control in chosen else []
        elif control.kind == "checkbox":
            values = [control.attributes.get("value", "on")] if control in checked else []
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
    for radios in sets.values():
        checked = [radio for radio in radios if "checked" in radio.attributes]
        if any(radio.required for radio in radios) or random.random() < ANSWERED:
            chosen.append(random.choice(radios))
        else:
            chosen += checked[-1:]
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
    if "multiple" in control.attributes:
        least = 1 if control.required else 0
        chosen = random.sample(answers, random.randint(least, len(answers)))
        return [option.value for option in free if option in chosen]
    if control.required or random.random() < ANSWERED:
        return [random.choice(answers).value]
    return [next((option for option in reversed(free) if option.selected), free[0]).value]


# Texts, numbers and times


def _text(control: Control, random: Random) -> str:
    """The value of a field that is no choice: an answer, nothing, or for a hidden or read-only field its own value."""
    if control.kind in _GENERATORS and "readonly" not in control.attributes:
        if control.required or control.kind in ("range", "color") or random.random() < ANSWERED:
            return _GENERATORS[control.kind](control, random)
        return ""
    return control.text if control.kind == "textarea" else control.value


def _words(control: Control, random: Random) -> str:
    joint = "\n" if control.kind == "textarea" else " "
    return _fitted(control, joint.join(random.sample(_WORDS, random.randint(1, 3))))


def _phrase(control: Control, random: Random) -> str:
    pattern = control.attributes.get("pattern")
    if pattern is None:
        return _words(control, random)
    try:
        matching = [text for text in _PATTERNS if re.fullmatch(pattern, text)]
    except re.error:  # JavaScript's regular expressions are not quite Python's
        matching = []
    return _fitted(control, random.choice(matching or _PATTERNS))


def _fitted(control: Control, text: str) -> str:
    """The text, shortened to maxlength or lengthened to minlength."""
    most, least = _whole(control.attributes.get("maxlength")), _whole(control.attributes.get("minlength"))
    while most is not None and text and _length(text) > most:
        text = text[:-1]
    return text + "x" * max(0, (least or 0) - _length(text)) if text else "x" * (least or 0)


def _length(text: str) -> int:
    """The length in UTF-16 code units, in which HTML counts minlength and maxlength."""
    return len(text.encode("utf-16-le")) // 2


def _email(control: Control, random: Random) -> str:
    return f"p{random.randrange(10**4)}@example.org"


def _url(control: Control, random: Random) -> str:
    return f"https://example.org/{random.randrange(10**4)}"


def _phone(control: Control, random: Random) -> str:
    return _phrase(control, random) if "pattern" in control.attributes else "+1 204 555 0100"


def _color(control: Control, random: Random) -> str:
    return f"#{random.randrange(1 << 24):06x}"


def _number(control: Control, random: Random) -> str:
    slider = control.kind == "range"
    low, high = decimal_of(control.attributes.get("min")), decimal_of(control.attributes.get("max"))
    base = low if low is not None else decimal_of(control.attributes.get("value")) or Decimal(0)
    step = decimal_of(control.attributes.get("step"))
    if step is None or step <= 0:
        step = Decimal("0.25") if control.attributes.get("step", "").lower() == "any" else Decimal(1)
    if slider:
        low = Decimal(0) if low is None else low
        base = low
        high = max(low, Decimal(100) if high is None else high)
    return f"{_on_grid(low, high, base, step, random).normalize():f}"


def _on_grid(low: Decimal | None, high: Decimal | None, base: Decimal, step: Decimal, random: Random) -> Decimal:
    """A value from `low` to `high` that lies a whole number of steps from `base`.

    Without one of the limits, it lies at most 40 steps from the other; without both, at most 20 from `base`.
    """
    first = -20 if low is None else -floor((base - low) / step)
    last = first + 40 if high is None else floor((high - base) / step)
    if low is None and high is not None:
        first = last - 40
    return base + step * (random.randint(first, last) if first <= last else 0)


def _moment(control: Control, random: Random) -> str:
    """A date, time, month or week: the first within its limits, from which HTML counts its steps."""
    limits = (control.attributes.get(name) for name in ("min", "max", "value"))
    return next(filter(None, limits), _MOMENTS[control.kind])


def decimal_of(text: str | None) -> Decimal | None:
    """Return the finite number in this text; None if it holds none."""
    try:
        number = Decimal(text or "")
    except InvalidOperation:
        return None
    return number if number.is_finite() else None


def _whole(text: str | None) -> int | None:
    return int(text) if text and text.isdecimal() else None


_MOMENTS = {
    "date": "2024-02-29",
    "time": "12:34",
    "datetime-local": "2024-02-29T12:34",
    "month": "2024-02",
    "week": "2024-W09",
}
_GENERATORS = {
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
    **dict.fromkeys(_MOMENTS, _moment),
}


def gathered(pairs: Iterable[tuple[str, str]]) -> dict[str, str | list[str]]:
    """Return the answers as the study stores them.

    A name that comes several times has the list of its values. Hippodrome's own fields are left out.
    """
    answers: dict[str, list[str]] = {}
    for name, value in pairs:
        if not name.startswith("hippodrome-"):
            answers.setdefault(name, []).append(value)
    return {name: values[0] if len(values) == 1 else values for name, values in answers.items()}
