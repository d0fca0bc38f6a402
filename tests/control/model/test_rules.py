"""Rules: what they may hold, what they compare, and what is said of the usual mistakes."""

from __future__ import annotations

import contextlib
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.model import rules

FACTS = {
    "answers": {
        "consent": {"agree": "no"},
        "pre": {"age": "17", "plays": ["cat", "dog"]},
        "game": rules.Runs({"sp": {"score": 3}, "cec": {"score": 4.5}}),
        "trust": rules.Runs({"60": {"q1": "2"}, "75": {"q1": "5"}}),
        "quiz": {"passed": False},
        "1": {"agree": "yes"},
    },
    "condition": {"chat": "on"},
    "participant": {"device": "phone"},
}


@pytest.mark.parametrize(
    ("rule", "value"),
    [
        ('answers.consent.agree == "no"', True),
        ("answers.pre.age < 18", True),
        ("17 <= answers.pre.age and answers.pre.age < 17.5", True),
        ("answers.pre.age == 17", True),
        ('answers.pre.age == "17"', True),
        ("not answers.quiz.passed", True),
        ('"cat" in answers.pre.plays', True),
        ('"cow" not in answers.pre.plays', True),
        ('condition.chat in ["on", "half"]', True),
        ('participant.device != "desktop"', True),
        ('answers["1"].agree == "yes"', True),
        ("answers.1.agree == 'yes'", True),
        ("answers.trust.60.q1 + answers.trust.75.q1", 7),
        ("0.02 * sum(answers.game.score)", 0.15),
        ("max(answers.game.score)", 4.5),
        ("count(answers.trust.q1) >= 2", True),
        ("min(answers.game.nothing)", ""),
        ("answers.pre.missing < 3", False),
        ("answers.pre.missing > 3", False),
        ('answers.pre.missing == ""', True),
        ('answers.nobody.field != "yes"', True),
        ("1 / 0", 0),
        ("answers.consent.agree + 1", ""),
        ('answers.consent.agree == "a.60"', False),
    ],
)
def test_a_rule_compares_as_people_mean_it(rule: str, value: Any) -> None:
    assert rules.evaluate(rule, FACTS) == pytest.approx(value)


@pytest.mark.parametrize(
    ("rule", "sentence"),
    [
        ('answers.a = "x"', "one = sets a value; write == to compare"),
        ("answers.a == no", 'no is not a name here; put texts in quotes ("no")'),
        (
            'consent.agree == "no"',
            "consent.agree is not known here; write answers.consent.agree for the answer to a step",
        ),
        ("answer.pre.age < 18", "answer.pre.age is not known here; did you mean answers.pre.age?"),
        ("answers.a && answers.b", "write and, or, not"),
        ("1 < answers.pre.age < 3", "compares three values; write a < b and b < c"),
        ("answers.x | int < 3", "filters such as | int are for pages; here a text that is a number compares as one"),
        ("", 'cannot be read as a rule; write one such as answers.consent.agree == "no"'),
    ],
)
def test_the_usual_mistakes_are_named(rule: str, sentence: str) -> None:
    with pytest.raises(rules.BadRule) as refused:
        rules.holds(rule, FACTS)
    assert str(refused.value) == sentence


@pytest.mark.parametrize(
    "rule",
    [
        "__import__('os')",
        "answers.a.__class__()",
        "[x for x in answers]",
        "lambda: 1",
        "f'{answers}'",
        "answers if 1 else 2",
        "2 ** 9999999",
        "answers[condition]",
        "print(1)",
        "sum(*answers)",
        "(" * 400,
        "1" * 501,
        "a" * 100 + ".b",
    ],
)
def test_nothing_else_can_be_written(rule: str) -> None:
    with pytest.raises(rules.BadRule):
        rules.holds(rule, FACTS)


@given(st.text(max_size=40))
def test_any_text_is_a_rule_or_refused(text: str) -> None:
    with contextlib.suppress(rules.BadRule):
        rules.evaluate(text, FACTS)


def test_a_rule_says_which_steps_it_asks_about() -> None:
    assert rules.steps_mentioned('answers.consent.agree == "no" or sum(answers.game.score) < answers["1"].x') == {
        "consent",
        "game",
        "1",
    }
    assert rules.mentioned("condition.chat == order.look") == {("condition", "chat"), ("order", "look")}


def test_a_number_that_is_too_large_is_none() -> None:
    assert not rules.holds("answers.age.years < 18", {"answers": {"age": {"years": 10**400}}})
