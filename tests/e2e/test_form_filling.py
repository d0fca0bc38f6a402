"""What bots answer satisfies what the page asks for, as a browser would check it."""

from __future__ import annotations

import html
import re
from datetime import date, datetime, time, timedelta
from decimal import Decimal
from random import Random
from typing import Any

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from hippodrome.bots import form_filling, forms

SEEDS = st.integers(0, 2**32)
NAMES = st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z")), min_size=1, max_size=12)


def one(page: str) -> forms.Form:
    form = forms.to_answer(page)
    assert form is not None
    return form


def filled(inner: str, seed: int = 0) -> list[tuple[str, str]]:
    return form_filling.fill(one(f"<form method=post>{inner}</form>"), Random(seed))


def attributes(**given: Any) -> str:
    return " ".join(f'{name}="{html.escape(str(value))}"' for name, value in given.items() if value is not None)


DECIMALS = st.decimals(-1000, 1000, places=2)


@example(seed=0, low=Decimal("-0.01"), span=Decimal(0), step="1", open_end="min")
@given(
    seed=SEEDS,
    low=DECIMALS,
    span=st.decimals(0, 500, places=2),
    step=st.sampled_from(["1", "0.01", "0.5", "7", "any", None]),
    open_end=st.sampled_from(["", "min", "max"]),
)
def test_numbers_keep_their_limits_and_steps(
    seed: int, low: Decimal, span: Decimal, step: str | None, open_end: str
) -> None:
    high = low + span
    given = {"min": None if open_end == "min" else low, "max": None if open_end == "max" else high, "step": step}
    [(name, text)] = filled(f"<input type=number name=n required {attributes(**given)}>", seed)
    value = Decimal(text)
    assert name == "n"
    assert re.fullmatch(r"-?\d+(\.\d+)?", text)
    assert open_end == "min" or value >= low
    assert open_end == "max" or value <= high
    if step != "any":
        base = Decimal(0) if open_end == "min" else low
        assert (value - base) % Decimal(step or 1) == 0


@given(seed=SEEDS, low=st.integers(-100, 100), span=st.integers(0, 100), step=st.integers(1, 7))
def test_sliders_always_send_a_value(seed: int, low: int, span: int, step: int) -> None:
    [(_, text)] = filled(f"<input type=range name=n min={low} max={low + span} step={step}>", seed)
    assert low <= int(text) <= low + span
    assert (int(text) - low) % step == 0


def test_a_slider_without_limits_goes_from_0_to_100() -> None:
    assert all(0 <= int(filled("<input type=range name=n>", seed)[0][1]) <= 100 for seed in range(50))


DATES = st.dates(date(1900, 1, 1), date(2100, 1, 1))


@given(seed=SEEDS, low=DATES, span=st.integers(0, 4000), step=st.sampled_from([None, 1, 7]))
def test_dates(seed: int, low: date, span: int, step: int | None) -> None:
    high = low + timedelta(span)
    [(_, text)] = filled(f"<input type=date name=d required {attributes(min=low, max=high, step=step)}>", seed)
    assert low <= date.fromisoformat(text) <= high
    assert (date.fromisoformat(text) - low).days % (step or 1) == 0


@given(seed=SEEDS, low=DATES, days=st.integers(30, 4000))
def test_months_and_weeks(seed: int, low: date, days: int) -> None:
    high = low + timedelta(days)
    month = filled(f"<input type=month name=d required {attributes(min=f'{low:%Y-%m}', max=f'{high:%Y-%m}')}>", seed)[
        0
    ][1]
    assert f"{low:%Y-%m}" <= month <= f"{high:%Y-%m}"
    weeks = [f"{day.isocalendar().year:04d}-W{day.isocalendar().week:02d}" for day in (low, high)]
    week = filled(f"<input type=week name=d required {attributes(min=weeks[0], max=weeks[1])}>", seed)[0][1]
    assert weeks[0] <= week <= weeks[1]


TIMES = st.times().map(lambda t: t.replace(second=0, microsecond=0))


@given(seed=SEEDS, ends=st.tuples(TIMES, TIMES).map(sorted), step=st.sampled_from([None, 60, 900]))
def test_times(seed: int, ends: list[time], step: int | None) -> None:
    low, high = (f"{end:%H:%M}" for end in ends)
    text = filled(f"<input type=time name=t required {attributes(min=low, max=high, step=step)}>", seed)[0][1]
    assert low <= text <= high
    first, value = (datetime.fromisoformat(f"2000-01-01T{part}") for part in (low, text))
    assert (value - first).total_seconds() % (step or 60) == 0
    both = filled(f'<input type=datetime-local name=t required min="2024-05-01T{low}" max="2024-05-01T{high}">', seed)[
        0
    ][1]
    assert f"2024-05-01T{low}" <= both <= f"2024-05-01T{high}"


@given(seed=SEEDS, least=st.integers(0, 30), span=st.integers(0, 60), tag=st.sampled_from(["input", "textarea"]))
def test_texts_are_neither_too_short_nor_too_long(seed: int, least: int, span: int, tag: str) -> None:
    limits = attributes(minlength=least, maxlength=least + span)
    end = "</textarea>" if tag == "textarea" else ""
    pairs = filled(f"<{tag} name=t required {limits}>{end}", seed)
    if not least + span:
        return  # nobody can satisfy this
    text = pairs[0][1].replace("\r\n", "\n")
    assert least <= len(text.encode("utf-16-le")) // 2 <= least + span  # as JavaScript counts
    assert text
    assert tag == "textarea" or "\n" not in text


@given(seed=SEEDS, values=st.lists(NAMES, min_size=1, max_size=6, unique=True), required=st.booleans())
def test_radios_selects_and_boxes(seed: int, values: list[str], required: bool) -> None:
    must = "required" if required else ""
    quoted = [html.escape(value) for value in values]
    radios = "".join(f'<input type=radio name=r value="{value}" {must}>' for value in quoted)
    pairs = filled(radios, seed)
    assert len(pairs) == 1 if required else len(pairs) <= 1
    assert all(value in values for _, value in pairs)
    options = "".join(f'<option value="{value}">{value}</option>' for value in quoted)
    [(_, chosen)] = filled(f'<select name=s {must}><option value="">Please choose</option>{options}</select>', seed)
    assert chosen in values or (chosen == "" and not required)
    several = [value for _, value in filled(f"<select name=s multiple {must}>{options}</select>", seed)]
    assert set(several) <= set(values)
    assert several or not required
    boxes = "".join(f'<input type=checkbox name=b value="{value}" {must}>' for value in quoted)
    ticked = [value for _, value in filled(boxes, seed)]
    assert ticked == values if required else set(ticked) <= set(values)


@given(
    seed=SEEDS, name=NAMES, value=st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=60)
)
def test_hidden_fields_and_buttons_go_through_unchanged(seed: int, name: str, value: str) -> None:
    given = f'name="{html.escape(name)}" value="{html.escape(value)}"'
    assert filled(f"<input type=hidden {given}><button {given}>Go</button>", seed) == [(name, value), (name, value)]


def test_line_ends_are_sent_as_browsers_send_them() -> None:
    assert filled("<textarea name=t readonly>\none\ntwo\r\nthree</textarea>") == [("t", "one\r\ntwo\r\nthree")]


def test_one_of_several_buttons_is_pressed() -> None:
    buttons = (
        "<button name=go value=a>A</button><input type=submit name=go value=b><button type=button name=no>No</button>"
    )
    assert {filled(buttons, seed)[0] for seed in range(40)} == {("go", "a"), ("go", "b")}
    assert filled("<input type=image name=at>")[:2] == [("at.x", "1"), ("at.y", "1")]


def test_disabled_fields_are_left_alone() -> None:
    page = """<fieldset disabled><legend><input name=in_legend required></legend><input name=no required></fieldset>
      <input name=neither required disabled>
      <select name=s required><optgroup disabled label=x><option>no</option></optgroup><option disabled>nor</option><option>yes</option></select>"""
    pairs = filled(page)
    assert [name for name, _ in pairs] == ["in_legend", "s"]
    assert pairs[1][1] == "yes"


def test_fields_outside_of_their_form() -> None:
    page = "<form method=post id=f></form><input form=f name=a required><input name=b required><input form=g name=c required>"
    assert [name for name, _ in form_filling.fill(one(page), Random(0))] == ["a"]


@pytest.mark.parametrize(
    "kind",
    [
        "email",
        "url",
        "tel",
        "color",
        "search",
        "password",
        "text",
        "date",
        "time",
        "month",
        "week",
        "datetime-local",
        "number",
    ],
)
def test_every_kind_of_input_gets_an_answer(kind: str) -> None:
    patterns = {
        "email": r"\S+@\S+\.\w+",
        "url": r"https://\S+",
        "color": "#[0-9a-f]{6}",
        "date": r"\d{4}-\d\d-\d\d",
        "time": r"\d\d:\d\d",
        "month": r"\d{4}-\d\d",
        "week": r"\d{4}-W\d\d",
        "datetime-local": r"\d{4}-\d\d-\d\dT\d\d:\d\d",
    }
    for seed in range(20):
        [(_, text)] = filled(f"<input type={kind} name=x required>", seed)
        assert re.fullmatch(patterns.get(kind, r"(?s).+"), text), text


def test_answers_match_simple_patterns() -> None:
    for pattern in (r"\d{4}", "[A-Z]{3}", "[a-z]+", r"[A-Z0-9]{6}"):
        assert all(
            re.fullmatch(pattern, filled(f'<input name=x required pattern="{pattern}">', seed)[0][1])
            for seed in range(20)
        )


def test_optional_fields_are_sometimes_left_out() -> None:
    texts = [filled("<input name=x>", seed)[0][1] for seed in range(60)]
    assert 0 < sum(not text for text in texts) < 30


def test_repeated_names_are_lists_and_fields_of_hippodrome_are_no_answers() -> None:
    pairs = [("hippodrome-step", "1"), ("a", "1"), ("b", "2"), ("a", "3")]
    assert form_filling.gathered(pairs) == {"a": ["1", "3"], "b": "2"}


def test_the_example_pages_can_be_answered() -> None:
    from pathlib import Path

    steps = Path(__file__).parents[2] / "steps"
    for page in ("consent-0", "consent-1", "questionnaire", "survey"):
        form = one(f"<form method=post>{(steps / f'{page}.html').read_text()}</form>")
        for seed in range(20):
            names = [name for name, _ in form_filling.fill(form, Random(seed))]
            assert {control.name for control in form.controls if control.required} <= set(names)
