"""Bots choose the answers that lead to an end, or past all ends, by the rules of the study and the fields of its pages."""

from __future__ import annotations

from random import Random

import pytest

from hippodrome.bots import form_filling, forms
from hippodrome.bots.steering import Design, Steering, offered
from hippodrome.control.model import rules
from hippodrome.control.model.design import Block, End, Factor, Levels, Step

CONSENT = '<button name="agree" value="yes">Yes</button><button name="agree" value="no">No</button>'
ABOUT = """<input type="number" name="age" min="10" max="99" required>
<select name="land" required><option value="">-<option>fr<option>de</select>"""
QUIZ = """<input type="number" name="soups" required>
<label><input type="radio" name="late" value="yes" required></label><label><input type="radio" name="late" value="no"></label>"""
RATE = '<select name="liked"><option value="">-<option>1<option>2<option>3</select>'
LOOK = Block((Factor("look", {"plain": "plain", "face": "face"}),))
RIGHT = {"soups": "3", "late": "no"}


def form(page: str) -> forms.Form:
    (found,) = forms.read(f'<form method="post">{page}<button>Go</button></form>')
    return found


def end(name: str, *when: str) -> End:
    return End(name, when)


def answers(
    page: str, step: Step, ends: list[End], target: End | None, seed: int = 1, condition: Levels | None = None
) -> dict[str, object]:
    """The answers of a bot that comes to this one page."""
    design = Design([step], conditions=(Factor("advice", {"on": "on", "off": "off"}),), ends=ends)
    steering = Steering(design, target, Random(seed), condition)
    return dict(steering.fill(step.key, form(page), form_filling.fill(form(page), Random(seed))))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize(
    ("rule", "page", "key"),
    [
        ('answers.consent.agree == "no"', CONSENT, "consent"),
        ("answers.about.age < 18", ABOUT, "about"),
        ("answers.about.age > 70 and answers.about.age <= 71", ABOUT, "about"),
        ("answers.about.age == 42", ABOUT, "about"),
        ('answers.about.age < 18 or answers.about.land in ["fr", "it"]', ABOUT, "about"),
        ('not answers.about.land == "de" and answers.about.age != 10', ABOUT, "about"),
    ],
)
def test_a_bot_makes_a_rule_true_or_false_as_it_is_told(rule: str, page: str, key: str, seed: int) -> None:
    ends = [end("out", rule)]
    for target, wanted in ((ends[0], True), (None, False)):
        given = answers(page, Step(key, key), ends, target, seed)
        assert rules.holds(rule, {"answers": {key: given}}) is wanted, given


def test_a_bot_keeps_away_from_the_ends_that_count_before_its_own() -> None:
    ends = [end("child", "answers.about.age < 14"), end("young", "answers.about.age < 18")]
    given = answers(ABOUT, Step("about", "about"), ends, ends[1])
    assert 14 <= int(str(given["age"])) < 18


@pytest.mark.parametrize("seed", range(3))
def test_a_bot_fails_a_check_as_often_as_it_may_or_passes_it(seed: int) -> None:
    step, ends = Step("quiz", "quiz", right=RIGHT, tries=2), [end("screenedOut", "not answers.quiz.passed")]
    given = answers(QUIZ, step, ends, None, seed)
    assert {name: given[name] for name in RIGHT} == RIGHT
    given = answers(QUIZ, step, ends, ends[0], seed)
    assert {name: given.get(name) for name in RIGHT} != RIGHT


def test_a_check_without_an_end_of_its_tries_is_answered_right() -> None:
    step, ends = Step("quiz", "quiz", right=RIGHT), [end("screenedOut", "not answers.quiz.passed")]
    given = answers(QUIZ, step, ends, ends[0])
    assert {name: given[name] for name in RIGHT} == RIGHT, "otherwise it would be asked for ever"


@pytest.mark.parametrize(("level", "land"), [("on", "fr"), ("off", "de")])
def test_a_bot_knows_the_cell_that_it_was_sent_to(level: str, land: str) -> None:
    rule = 'condition.advice == "on" and answers.about.land == "de"'
    other = 'condition.advice == "off" and answers.about.land == "fr"'
    ends = [end("out", rule), end("away", other)]
    assert answers(ABOUT, Step("about", "about"), ends, None, condition={"advice": level})["land"] == land


@pytest.mark.parametrize(
    ("rule", "wanted"), [("max(answers.rate.liked) < 2", {"1"}), ("answers.rate.face.liked == 3", {"3"})]
)
def test_a_bot_remembers_what_it_answered_in_the_other_runs_of_a_block(rule: str, wanted: set[str]) -> None:
    design = Design([Step("rate", "rate", block=0)], (LOOK,), ends=[end("unhappy", rule)])
    steering = Steering(design, design.ends[0], Random(3))
    for key in ("rate-face", "rate-plain"):
        steering.fill(key, form(RATE), [("liked", "2")])
    assert steering.answers["rate-face"]["liked"] in wanted
    facts = {"answers": {"rate": rules.Runs({key[5:]: given for key, given in steering.answers.items()})}}
    assert rules.holds(rule, facts)


def test_a_bot_chooses_its_device_and_the_fields_of_its_link() -> None:
    ends = [end("phone", 'participant.device == "phone" and participant.country == "fr"')]
    steering = Steering(Design([], ends=ends), ends[0], Random(1))
    steering.set_out()
    assert steering.participant == {"device": "phone", "country": "fr"}
    past = Steering(Design([], ends=ends), None, Random(1))
    past.set_out()
    assert past.participant != steering.participant


def test_an_answer_over_two_pages_is_finished_on_the_second() -> None:
    rule = 'answers.consent.agree == "yes" and answers.about.age < 18'
    design = Design([Step("consent", "consent"), Step("about", "about")], ends=[end("out", rule)])
    for seed in range(5):
        steering = Steering(design, design.ends[0], Random(seed))
        for key, page in (("consent", CONSENT), ("about", ABOUT)):
            steering.fill(key, form(page), form_filling.fill(form(page), Random(seed)))
        assert rules.holds(rule, {"answers": steering.answers}), steering.answers


def test_numbers_are_offered_within_the_limits_of_their_field() -> None:
    page = form('<input type="number" name="age" min="10" max="20" step="5">')
    assert set(offered(page, "age", [5, 15, 40, "x"])) == {"10", "15", "20"}
