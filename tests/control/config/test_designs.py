"""The design in config.yml: what is said of the likeliest mistakes, with their lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.control.config import ConfigErrors, read_project
from hippodrome.local.check.command import check_project
from testing.designed import write

CONFIG = """project:
  id: soup
  conditions: {partner: [helpful, lazy], advice: [on, off]}
  steps:
    - consent
    - quiz: {right: {soups: 3, late: no}, tries: 2}
    - game
    - each: {look: [a, b]}
      steps: [show, rate]
    - debrief
  ends:
    declined: answers.consent.agree == "no"
    out: not answers.quiz.passed
trial:
  game: kitchen
  players: {human: human, partner: "agent:{partner}"}
"""
STEPS = CONFIG[CONFIG.index("    - consent") : CONFIG.index("  ends:")]
PAGES = {
    "consent": "<input name='agree'>",
    "quiz": "<input name='soups'><input name='late'>",
    **{name: f"<h1>{name}</h1>" for name in ("show", "rate")},
    "debrief": "<p>{{ completion_code }}</p>",
}


def said(tmp_path: Path, old: str, new: str) -> list[str]:
    """The mistakes, or without any the remarks, in the study with this change."""
    assert old in CONFIG
    folder = write(tmp_path / "soup", CONFIG.replace(old, new, 1), PAGES)
    try:
        config = read_project(folder)
    except ConfigErrors as errors:
        return str(errors).split("\n")
    return [str(found) for found in (*config.remarks, *check_project(folder, config)) if "agent" not in str(found)]


def test_the_study_itself_has_no_mistake(tmp_path: Path) -> None:
    assert said(tmp_path, "soup", "soup") == []


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        (
            "    - quiz: {right: {soups: 3, late: no}, tries: 2}",
            "    - quiz:\n      right: {soups: 3, late: no}\n      tries: 2",
            "config.yml:6: project.steps item 2: a step is a name, or one name with its settings in braces or indented "
            "below it; quiz, right, tries are 3 names. Indent the settings of quiz by two more spaces",
        ),
        (
            "answers.consent.agree",
            "consent.agree",
            "config.yml:12: project.ends.declined.when: consent is a step; write answers.consent",
        ),
        ('"no"', "no", 'config.yml:12: project.ends.declined.when: no is not a name here; put texts in quotes ("no")'),
        ("==", "=", "config.yml:12: project.ends.declined.when: one = sets a value; write == to compare"),
        (
            "    - game\n",
            "    - game: {until: {success: 3}, maxEpisodes: 2}\n",
            "config.yml:7: project.steps item 3.game.until: nobody can reach it in 2 episodes; write a larger maxEpisodes "
            "(with partner: helpful)",
        ),
        (
            "    - game\n",
            "    - game: {until: {success: two}}\n",
            'config.yml:7: project.steps item 3.game.until.success: must be a whole number from 1 to 1000000, not "two" '
            "(with partner: helpful)",
        ),
        (
            "    - game\n",
            "    - game: {until: {success: 3}}\n    - train:\n        until:\n          success: two\n",
            'config.yml:10: project.steps item 4.train.until.success: must be a whole number from 1 to 1000000, not "two" '
            "(with partner: helpful)",
        ),
        (
            "    - game\n",
            "    - game: {answers: [consents]}\n",
            "config.yml:7: project.steps item 3.game.answers item 1: there is no step consents; did you mean consent?",
        ),
        (
            "  game: kitchen\n",
            "  game: kitchen\n  answers: [quiz, rate]\n",
            "config.yml:16: trial.answers item 2: rate does not come before the game game, whose agent would read its "
            "answers; give game its own answers, such as answers: []",
        ),
        (
            "soups: 3",
            "soup: 3",
            "config.yml:6: project.steps item 2.quiz.right.soup: the page of quiz has no field soup; did you mean "
            "soups?; nobody who sees it could answer right",
        ),
        (
            "agent:{partner}",
            "agent:{partners}",
            "config.yml:16: trial.players.partner: there is no factor partners; did you mean partner?",
        ),
        (
            "not answers.quiz.passed",
            "answers.game.scor < 3",
            "config.yml:13: project.ends.out: the answer of the game game has no scor; did you mean score?",
        ),
        (
            "not answers.quiz.passed",
            "not answers.game.reached",
            "config.yml:13: project.ends.out: the answer of the game game has no reached; give game a criterion, such as "
            "until: {success: 3}",
        ),
        ("answers.consent", 'answers["1"]', "config.yml:12: project.ends.declined.when: there is no step 1"),
        (
            "    - debrief",
            "    - consent\n    - debrief",
            "config.yml:10: project.steps item 5: there are two steps called consent; name one of them otherwise: "
            "- consent2: {page: consent}",
        ),
        (
            STEPS,
            "    1: consent\n    2: {page: quiz, right: {soups: 3}}\n    3: game\n    finalStep: debrief\n",
            "config.yml:6: project.steps.2: settings need the list form, in which steps have names: - quiz: {…} instead "
            "of 2: …",
        ),
        (
            "agent:{partner}",
            "{partners}",
            "config.yml:16: trial.players.partner: there is no factor partners; did you mean partner?",
        ),
        (
            "  conditions: {partner: [helpful, lazy], advice: [on, off]}\n",
            "",
            "config.yml:15: trial.players.partner: there is no factor partner; add it to conditions, such as "
            "conditions: {partner: [a, b]}",
        ),
        (
            "steps: [show, rate]",
            "steps: [show, {each: {k: [c, d]}, steps: [rate]}]",
            "config.yml:9: project.steps item 4.steps item 2: is a block in a block; write both factors in one: "
            "each: {a: […], b: […]}",
        ),
        (
            "not answers.quiz.passed",
            "answers.rate.q1 < 3",
            "config.yml:13: project.ends.out.when: answers.rate has an answer for each look; write answers.rate.a.q1, or "
            "sum(answers.rate.q1)",
        ),
        (
            "    - game\n",
            "    - intro: {when: answers.rate.a.q1 == 1}\n    - game\n",
            "config.yml:7: project.steps item 3.intro.when: rate is asked later; a rule may ask about earlier steps only",
        ),
        (
            "    out: not answers.quiz.passed\n",
            "",
            "config.yml:6: remark: project.steps item 2.quiz.tries: no end asks for answers.quiz.passed: who fails goes "
            "on like everybody, and the column quiz.passed tells",
        ),
        (
            "{partner}",
            "{look}",
            "config.yml:7: project.steps item 3: the game game takes players.partner from trial, with {look}, and is "
            "outside of each: look; give it players of its own",
        ),
        (
            'answers.consent.agree == "no"',
            '{when: answers["consent"].agree == "no"}',
            "config.yml:12: in braces put the whole rule into '…', or write answers.consent.agree",
        ),
        (
            "[a, b]",
            "[a-1, b]",
            "config.yml:8: project.steps item 4.each.look: a level's name has letters, digits, _ and . only; give "
            '"a-1" a name: {a_1: "a-1"}',
        ),
        (
            "[helpful, lazy]",
            "[helpful]",
            "config.yml:3: project.conditions.partner: has one level; a factor needs two or more, or leave it out",
        ),
    ],
)
def test_a_mistake_gets_its_line_and_what_to_write(tmp_path: Path, old: str, new: str, sentence: str) -> None:
    assert sentence in said(tmp_path, old, new)


def test_with_several_players_levels_are_drawn_at_the_first_game(tmp_path: Path) -> None:
    old = CONFIG[CONFIG.index("    - consent") :]
    new = """    - consent
    - quiz: {when: condition.partner == "lazy"}
    - game: {players: {a: human, b: "agent:{partner}"}}
    - debrief
  players: 2
trial: {game: kitchen, players: {a: human, b: human}}
"""
    assert said(tmp_path, old, new) == [
        "config.yml:6: project.steps item 2.quiz: comes too early: with players: 2 or more, levels are drawn when "
        "participants are matched, at the first game; move this step behind it",
        "config.yml:7: project.steps item 3.game: 1 of the players are human with partner: helpful, and project.players "
        "is 2; all who play together play each game",
    ]


def test_with_several_players_the_last_page_is_there_for_the_unmatched_too(tmp_path: Path) -> None:
    old = CONFIG[CONFIG.index("    - consent") :]
    new = """    - consent
    - game
    - debrief: {page: "debrief-{partner}"}
  players: 2
trial: {game: kitchen, players: {a: human, b: human}}
"""
    assert any("the last page names a factor" in sentence for sentence in said(tmp_path, old, new))
