"""`make check` of studies in which several participants play together."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path

import pytest

from hippodrome.control.config import read_project
from hippodrome.local.check import agent as agent_check
from hippodrome.local.check.command import check_project
from hippodrome.trial.agent.match import SECONDS
from tests.local.check.test_players import AGENT
from tests.local.conftest import write_study

TRIAL = """
trial:
  game: none
  maxEpisodes: 3
  actionSpace: [noop, up, down]
  players: {left: human, right: human}
"""
ASKS = "<h1>Hello</h1><input name=language><input name=age><button>Go on</button>"
SPEAKS = "<h1>Bye</h1>{% if participant.unmatched %}Sorry{% else %}Thanks{% endif %}<input name=word>"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    found = write_study(tmp_path / "study", start=2)
    (found / "agent.py").write_text(AGENT)
    (found / "steps/hello.html").write_text(ASKS)
    (found / "steps/bye.html").write_text(SPEAKS)
    return configured(found)


def configured(folder: Path, project: str = "", trial: str = "") -> Path:
    """Return the study with more lines in the sections of its config.yml."""
    file = folder / "config.yml"
    before = file.read_text().partition("\ntrial:")[0].replace("  players: 2\n", "")
    file.write_text(before.replace("project:\n", f"project:\n  players: 2\n{project}") + TRIAL + trial)
    return folder


def looked(folder: Path) -> list[str]:
    return [str(problem) for problem in check_project(folder, read_project(folder))]


def tried(folder: Path, said: list[str] | None = None, seconds: float = 60) -> list[str]:
    say = (said if said is not None else []).append
    return [str(problem) for problem in agent_check.try_agent(folder, read_project(folder), seconds, say)]


def test_a_game_of_two_people_is_played_with_random_keys_in_both_places(folder: Path) -> None:
    said: list[str] = []
    assert looked(folder) == []
    assert (tried(folder, said), said) == ([], ["played: 3 of 3 episodes to the end, 60 steps"])


def test_the_substitute_plays_in_each_place_for_a_while(folder: Path) -> None:
    agent = folder / "agent.py"
    note = 'open("played", "a").write(f"{observation[0]:.0f}")\n        return 2'
    agent.write_text(agent.read_text().replace("assert observation[0] == 1\n        return 2", note))
    assert tried(configured(folder, trial="  substitute: agent:Partner\n")) == []
    assert (folder / "played").read_text() == "0" * 20 + "1" * 20


def test_a_substitute_that_cannot_play_is_reported_at_its_line_in_config_yml(folder: Path) -> None:
    (line,) = tried(configured(folder, trial="  substitute: agent:Partnr\n"))
    assert line.endswith("trial.substitute: there is no class Partnr in agent.py; classes with act() there: Partner")
    (line,) = tried(configured(folder, trial="  substitute: agent:Partner\n"))  # which asserts that it plays right
    assert line.startswith("agent.py:")
    assert "AssertionError" in line


def test_an_environment_with_one_player_is_refused_for_two_people(tmp_path: Path) -> None:
    single = configured(write_study(tmp_path / "single", start=2))
    (line,) = tried(single)
    assert line == (
        "agent.py:19: reset() must return observations by player, not int; an environment with one player is for "
        "participants who play alone (project.players: 1)"
    )


def test_an_agent_that_reads_its_group_at_the_start_is_reported(folder: Path) -> None:
    agent = folder / "agent.py"
    agent.write_text("import os\n" + agent.read_text().replace("pass\n", 'self.id = os.environ.get("GROUP")\n', 1))
    (folder / "steps/hello.html").rename(folder / "steps/hello-0.html")
    (folder / "steps/hello-1.html").write_text(ASKS)
    (line,) = tried(folder)
    assert line.endswith(
        "GROUP is not known here: with players the agent starts before its participants come; read it in reset()"
    )


@pytest.mark.parametrize(
    ("field", "said"),
    [
        ("language", []),
        ("languag", ["no page before the game asks languag; did you mean language?"]),
        ("town", ["no page before the game asks town; there are the fields language, age"]),
        ("word", ["no page before the game asks word; there are the fields language, age"]),  # asked after it
    ],
)
def test_a_matching_field_must_be_asked_before_the_game(folder: Path, field: str, said: list[str]) -> None:
    found = looked(configured(folder, f"  matching: {{same: {field}}}\n"))
    assert [line.partition("project.matching: ")[2] for line in found] == said


def test_a_matching_field_may_be_made_by_a_pages_script(folder: Path) -> None:
    (folder / "steps/hello.html").write_text(ASKS + "<script>addField('town')</script>")
    assert looked(configured(folder, "  matching: {different: town}\n")) == []


BOX = "<input type=checkbox name=consent value=yes required>"
SIDES = "".join(f"<input type=radio name=side value={side} required>" for side in ("left", "right"))
ROLES = "<select name=role required><option value=''>?<option>cook<option>waiter</select>"


@pytest.mark.parametrize(
    ("field", "players", "answers"),
    [
        ("consent", 2, "one answer"),
        ("side", 2, None),
        ("side", 3, "2 different answers"),
        ("role", 3, "2 different answers"),
        ("age", 3, None),  # written by the participant
    ],
)
def test_a_field_with_fewer_answers_than_players_matches_no_one_by_different_answers(
    folder: Path, field: str, players: int, answers: str | None
) -> None:
    (folder / "steps/hello.html").write_text(ASKS + BOX + SIDES + ROLES)
    configured(folder, f"  matching: {{different: {field}}}\n")
    file = folder / "config.yml"
    third = ", third: human" if players == 3 else ""
    text = file.read_text().replace("players: 2\n", f"players: {players}\n")
    file.write_text(text.replace("right: human}", f"right: human{third}}}"))
    said = [line.partition("project.matching: ")[2] for line in looked(folder)]
    assert said == (
        [f"{field} can have {answers} only, and {players} players need different ones: no participant finds others"]
        if answers
        else []
    )


def test_a_field_with_one_answer_matches_everyone_by_the_same(folder: Path) -> None:
    (folder / "steps/hello.html").write_text(ASKS + BOX)
    assert looked(configured(folder, "  matching: {same: consent}\n")) == []


def test_a_page_after_the_game_that_thanks_everyone_for_playing_is_remarked(folder: Path) -> None:
    (folder / "steps/bye.html").write_text("<h1>You have played well</h1>")
    assert looked(folder) == [
        "steps/bye.html: remark: participants who find no other to play with come here too, without having played; "
        "{% if participant.unmatched %} … {% else %} … {% endif %} tells them apart"
    ]
    assert looked(configured(folder, "  afterPatience: policies\n", "  substitute: random\n")) == []


def test_a_page_that_shows_the_score_is_tried_for_those_who_did_not_play(folder: Path) -> None:
    (folder / "steps/bye.html").write_text("<!-- unmatched -->\n{{ answers['2'].score|round }}")
    (line,) = looked(folder)
    assert line.startswith("steps/bye.html:2: remark: a participant without the answer gets an error page here")
    played = "{% if not participant.unmatched %}{{ answers['2'].score|round }}{% endif %}"
    (folder / "steps/bye.html").write_text(played)
    assert looked(folder) == []


def test_an_agent_sees_what_it_sees_on_a_sessions_server(folder: Path) -> None:
    """The session and its group, and no participant's id."""
    agent = folder / "agent.py"
    note = """
import json, os

class Agent(Agent):
    def reset(self, seed=None):
        told = {name: os.environ.get(name) for name in ("USER_ID", "SESSION", "GROUP")}
        open("told", "w").write(json.dumps(told))
        return super().reset(seed)
"""
    agent.write_text(agent.read_text() + note)
    assert tried(folder) == []
    told = json.loads((folder / "told").read_text())
    assert told == {"USER_ID": None, "SESSION": f"s.{'0' * 20}", "GROUP": ""}


def test_the_number_of_members_is_known_only_after_the_game(folder: Path) -> None:
    count = "{{ '%d people'|format(participant.members) }}"
    (folder / "steps/bye.html").write_text(SPEAKS + count)
    assert looked(folder) == []
    (folder / "steps/hello.html").write_text(ASKS + count)
    (line,) = looked(folder)
    assert line.startswith("steps/hello.html:1: ")


def test_the_function_match_must_exist(folder: Path) -> None:
    (line,) = tried(configured(folder, "  matching: match\n"))
    assert line == "agent.py:5: there is no function match(waiting), and config.yml says matching: match"


def test_the_function_match_must_stand_beside_the_class(folder: Path) -> None:
    inside = "    def match(self, waiting):\n        return []\n\n    def close"
    (folder / "agent.py").write_text(AGENT.replace("    def close", inside))
    (line,) = tried(configured(folder, "  matching: match\n"))
    assert line.endswith("matching: match; write it beside the class Agent, not in it, and without self")


@pytest.mark.parametrize("fits", ["==", "!="])
def test_invented_participants_give_different_and_equal_answers(folder: Path, fits: str) -> None:
    roles = "".join(f"<input type=radio name=role value={role} required>" for role in ("guide", "seeker"))
    (folder / "steps/hello.html").write_text(f"{ASKS}{roles}")
    (folder / "agent.py").write_text(
        f"{AGENT}\n\ndef match(waiting):\n    first = waiting[0]\n"
        f"    return [[first, other] for other in waiting[1:] if other['answers']['role'] {fits} first['answers']['role']][:1]\n"
    )
    assert tried(configured(folder, "  matching: match\n")) == []


def test_a_function_match_without_its_key_is_remarked(folder: Path) -> None:
    (folder / "agent.py").write_text(f"{AGENT}\n\ndef match(waiting):\n    return []\n")
    (line,) = looked(folder)
    assert re.fullmatch(
        r"agent\.py:\d+: remark: match\(\) is never called; matching: match under project of config.yml asks for it",
        line,
    )
    assert looked(configured(folder, "  matching: match\n")) == []
    (folder / "agent.py").write_text(f"{AGENT}\n\ndef match(waiting):\n    return []\n\nmatch([])\n")
    assert looked(configured(folder)) == []


def test_a_player_without_keys_is_remarked_on_where_players_have_keys_of_their_own(folder: Path) -> None:
    (line,) = looked(configured(folder, trial="  keys: {left: {a: up}}\n"))
    assert line.endswith(": remark: trial.keys: says nothing of right: the names of the actions decide their keys")
    assert looked(configured(folder, trial="  keys: {left: {a: up}, right: {b: down}}\n")) == []
    assert looked(configured(folder, trial="  keys: {a: up}\n")) == []


@pytest.mark.parametrize(
    ("code", "said"),
    [
        ("return [[one['id'] for one in waiting[:2]]]", None),
        ("return [[waiting[0]['id'], waiting[1]['answers']['language'] and waiting[1]['id']]]", None),
        ("return None", "match() must return a list of groups, and returned NoneType"),
        ("return ['made-up-0']", "each group that match() returns must be a list of ids; one is str"),
        ("return [waiting[:3]]", "match() made a group of 3, and project.players is 2"),
        ("return []", "remark: match() made no session of 6 made-up participants: such participants wait on"),
        ("return [nobody]", "match() fails: NameError: name 'nobody' is not defined"),
    ],
)
def test_match_is_called_with_invented_participants(folder: Path, code: str, said: str | None) -> None:
    before = f"{AGENT}\n\n"
    (folder / "agent.py").write_text(f"{before}def match(waiting):\n    {code}\n")
    found = tried(configured(folder, "  matching: match\n"))
    line = before.count("\n") + (2 if said and "NameError" in said else 1)
    assert found == ([f"agent.py:{line}: {said}"] if said else [])


@pytest.mark.parametrize(
    ("code", "line"), [("time.sleep(99)", 2), ("return sleepy()", 5)], ids=["itself", "its groups"]
)
def test_a_match_that_does_not_return_is_reported_after_the_time_limit_of_a_server(
    folder: Path, code: str, line: int
) -> None:
    before = f"import time\n{AGENT}\n\n"
    groups = "def sleepy():\n    yield time.sleep(99)\n"
    (folder / "agent.py").write_text(f"{before}def match(waiting):\n    {code}\n\n{groups}")
    began = time.monotonic()
    assert tried(configured(folder, "  matching: match\n")) == [
        f"agent.py:{before.count(chr(10)) + line}: match() has not come back within {SECONDS:g} s: a server waits no "
        "longer, and matches nobody"
    ]
    assert time.monotonic() - began < 30, "not the 60 s in which the agent must have played"


def test_the_agent_has_the_rest_of_the_time_after_match(folder: Path) -> None:
    matches = "def match(waiting):\n    return [[one['id'] for one in waiting[:2]]]\n"
    hangs = AGENT.replace("def reset(self, seed=None):", "def reset(self, seed=None):\n        time.sleep(99)")
    (folder / "agent.py").write_text(f"import time\n{hangs}\n\n{matches}")
    began = time.monotonic()
    (line,) = tried(configured(folder, "  matching: match\n"), seconds=3)
    assert line.endswith("reset() has not come back within 3 s")
    assert time.monotonic() - began < 10, "the process ended itself"
