"""`hippodrome check` on agent.py: each failure with its line."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import pytest

from hippodrome.control.config import read_project
from hippodrome.local.check import agent as agent_check
from testing.exploration import sample
from testing.waiting import until
from tests.local.check.checking import agent, config, looked, page, run, tried
from tests.local.conftest import ROOT

# --- agent.py ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("class Agent:", "class Other:", "agent.py: there is no class Agent"),
        ("class Agent:", "class Agnet:", "agent.py: there is no class Agent; is Agnet meant to be Agent?"),
        ("class Agent:", "class agent:", "agent.py: there is no class Agent; is agent meant to be Agent?"),
        ("def render(self):\n        return self.env", "def rendr(self):\n        return self.env", "agent.py:15: Agent has no render"),
        ("def step(self, action):", "def step(self, a, b, c):", "agent.py:21: step(a, b, c) cannot be called; write step(action) or step(env, action)"),
        ("import numpy", "import no_such_thing; import numpy", "agent.py:1: start(\"none\") fails: ModuleNotFoundError: No module named 'no_such_thing'; name its package in a requirements.txt beside agent.py: no_such_thing"),
        ("self.n += 1", "self.n += 'x'", "agent.py:8: step(0) fails: TypeError: unsupported operand"),
        ("return self.env.step(action)", "return 5", "agent.py:21: step() must return "),
        ("return self.env.step(action)", "self.env.step(action)", "agent.py:21: step() must return (observation, reward, terminated, truncated, info) or a dict of these; it returned nothing"),
        ("np.zeros((16, 16, 3), np.uint8)", "None", "agent.py:23: render() returned nothing: is a `return` missing? "),
        ("def reset(self, seed=None):", "def reset():", "agent.py:"),
        ("render()\n    def close(self):\n        pass", "render()\n    def close(self):\n        1 / 0", "agent.py:26: remark: close() fails: ZeroDivisionError"),
        ("self.env = Env()", "raise SystemExit(3)", 'agent.py:17: start("none") fails: SystemExit: 3'),
        ("self.env = Env()", "print('Oh!'); import os; os._exit(4)", 'agent.py:16: start("none") ended Python itself (exit status 4)'),
        ("self.env = Env()", "import signal; signal.raise_signal(11)", 'agent.py:16: start("none") ended Python itself (signal SIGSEGV)'),
    ],
)  # fmt: skip
def test_failures_of_an_agent_are_reported_with_their_line(folder: Path, old: str, new: str, said: str) -> None:
    agent(folder, old, new)
    (line,) = tried(folder)
    assert line.startswith(said)


@pytest.mark.parametrize(
    ("chat", "method", "said"),
    [
        (
            "",
            "def reply(self, session, player, text): pass",
            "remark: reply() is never called, since nobody talks; write",
        ),
        ("  chat: true", "", "remark: trial.chat: nobody answers for ai: write reply(self, session, player, text) in"),
        ("  chat: true", "def reply(self, session, player, text): return session.talk[0]['texts']", "reply() fails"),
        ("  chat: true", "def moderate(self, session, player, text): return 1 / 0", "moderate() fails"),
        ("  chat: true", "def reply(self, session, player, text): yield 'Hi'; session.say('!')", ""),
    ],
)
def test_who_talks_to_nobody_and_an_agent_that_cannot_answer_are_named(
    folder: Path, chat: str, method: str, said: str
) -> None:
    source, written = folder / "agent.py", folder / "config.yml"
    source.write_text(source.read_text() + f"    {method}\n")
    written.write_text(written.read_text().rstrip() + f"\n{chat}\n")
    found = tried(folder)
    assert any(said in line for line in found) if said else found == [], found


def test_callbacks_that_fail_are_mistakes_and_the_game_goes_on(folder: Path) -> None:
    source = folder / "agent.py"
    start = len(source.read_text().splitlines())
    source.write_text(
        source.read_text() + "    def on_tick(self, session):\n        return session.observatons\n"
        "    def on_episode_end(self):\n        pass\n"
    )
    raising, uncallable = tried(folder)
    assert raising.startswith(f"agent.py:{start + 2}: on_tick() fails: AttributeError: 'Session' object has no")
    assert uncallable == (
        f"agent.py:{start + 3}: on_episode_end() fails: TypeError: Agent.on_episode_end() takes 1 positional argument "
        "but 2 were given"
    )


def test_a_callback_that_hangs_is_remarked(folder: Path) -> None:
    source = folder / "agent.py"
    start = len(source.read_text().splitlines())
    source.write_text(
        source.read_text() + "    def on_tick(self, session):\n        import time\n        time.sleep(999)\n"
    )
    assert tried(folder) == [
        f"agent.py:{start + 1}: remark: on_tick() takes longer than callbackSeconds (0.5 s); callbacks are skipped "
        "until it has returned"
    ]


def test_good_callbacks_get_no_remark(folder: Path) -> None:
    source = folder / "agent.py"
    source.write_text(
        source.read_text() + "    def on_tick(self, session):\n        session.record('t', session.ticks)\n"
    )
    assert tried(folder) == []


@pytest.mark.parametrize(
    ("old", "new", "where"),
    [
        ("return 0, 1.0", "return {'world': Env()}, 1.0", "an observation"),
        ("False, {}", "False, {'world': [Env()]}", "info"),
        ("return 0, 1.0", "return {'at': datetime.date.today(), 'seen': np.array(['a'])}, 1.0", None),
    ],
)
def test_an_object_that_is_kept_as_text_only_is_remarked(folder: Path, old: str, new: str, where: str | None) -> None:
    config(folder, "trial:\n", "trial:\n  recordObservations: true\n")
    agent(folder, "import numpy as np", "import datetime; import numpy as np")
    agent(folder, old, new)
    remark = (
        f"agent.py:21: remark: {where} has an object of the class Env, of which only str() is recorded, at most 1000 "
        "characters; return numbers, texts, arrays, lists, dicts or dataclasses"
    )
    assert tried(folder) == ([remark] if where else [])


def test_an_agent_that_fails_late_is_reported(folder: Path) -> None:
    agent(folder, "self.n += 1", "self.n += 1; assert self.n != 25, 'late'")
    (line,) = tried(folder)
    assert line.startswith("agent.py:8: step(")
    assert "fails (episode 1, after 24 steps in all): AssertionError: late" in line


def test_an_agent_that_fails_with_the_options_of_one_level_only_is_reported(folder: Path) -> None:
    config(folder, "project:\n", "project:\n  conditions: {advice: [shown, hidden]}\n")
    config(folder, "trial:\n", 'trial:\n  options: {advice: "{advice}"}\n')
    agent(
        folder,
        "    def reset(self, seed=None):\n        return self.env",
        "    def reset(self, seed=None, options=None):\n"
        "        assert options['advice'] == 'shown'\n"
        "        return self.env",
    )
    (problem,) = tried(folder)
    assert 'reset(), with the options {"advice": "hidden"} and the condition {"advice": "hidden"}, fails' in problem
    assert "AssertionError" in problem


@pytest.mark.parametrize(("field", "is_well"), [("word", True), ("words", False)])
def test_an_agent_gets_made_up_answers_to_the_steps_that_a_game_names(folder: Path, field: str, is_well: bool) -> None:
    config(folder, "trial:\n", 'trial:\n  answers: ["1"]\n')
    agent(
        folder,
        "    def reset(self, seed=None):\n        return self.env",
        "    def on_session_start(self, session):\n"
        f"        self.word = session.answers['1']['{field}']\n"
        "    def reset(self, seed=None, answers=None):\n"
        f"        assert answers['1']['{field}']\n"
        "        return self.env",
    )
    problems = tried(folder)
    assert (problems == []) == is_well, problems
    assert is_well or f"reset() fails: KeyError: '{field}'" in str(problems)


@pytest.mark.parametrize(("level", "is_well"), [("shown", True), ("seen", False)])
def test_callbacks_find_their_participants_condition(folder: Path, level: str, is_well: bool) -> None:
    config(folder, "project:\n", "project:\n  conditions: {advice: [shown, hidden]}\n")
    agent(
        folder,
        "    def reset(self, seed=None):\n        return self.env",
        "    def on_session_start(self, session):\n"
        f"        assert session.condition['advice'] == '{level}'\n"
        "    def reset(self, seed=None):\n        return self.env",
    )
    assert (tried(folder) == []) == is_well


def test_an_agent_that_fails_in_one_group_only_is_reported(folder: Path) -> None:
    (folder / "steps" / "hello.html").unlink()
    page(folder, "<p>0", "hello-0")
    page(folder, "<p>1", "hello-1")
    agent(folder, "self.n += 1", "import os; self.n += 1; assert os.environ['GROUP'] != '1', 'never'")
    (line,) = tried(folder)
    assert "group 1): AssertionError: never" in line
    status, lines = run(folder)
    assert status == 1
    assert "  played in group 0: 1 of 1 episodes to the end, 30 steps" in lines


def test_check_says_how_long_it_played_a_game_without_an_end(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    agent(folder, "self.n >= 30", "False")
    monkeypatch.setattr(agent_check, "PLAY_SECONDS", 0.5)
    said: list[str] = []
    assert agent_check.try_agent(folder, read_project(folder), 60, said.append) == []
    assert re.fullmatch(r"played: 0 of 1 episodes to the end, \d+ steps \(its time was over\)", said[0])


ENDLESS = (
    r"agent\.py:21: remark: no episode ended within \d+ steps of random play; if that is not intended, step\(\) must "
    "return terminated or truncated, or maxSteps or episodeSeconds under trial must end episodes"
)


@pytest.mark.parametrize(
    ("changes", "remarked"),
    [
        ([("maxEpisodes: 1", "maxEpisodes: 2")], True),
        ([(", stop: true", ", stop: false")], True),
        ([], False),  # the participant ends the only episode
        ([("maxEpisodes: 1", "maxEpisodes: 2\n  maxSteps: 90000")], False),
        ([("maxEpisodes: 1", "maxEpisodes: 2\n  episodeSeconds: 9000")], False),
    ],
)
def test_episodes_that_never_end_are_remarked(folder: Path, changes: list[tuple[str, str]], remarked: bool) -> None:
    agent(folder, "self.n >= 30", "False")
    for old, new in changes:
        config(folder, old, new)
    found = tried(folder)
    assert len(found) == remarked
    assert all(re.fullmatch(ENDLESS, line) for line in found)


def test_a_method_that_is_named_like_a_callback_is_remarked_on(folder: Path) -> None:
    agent(folder, "    def close", "    def on_key(self, key):\n        pass\n\n    def close")
    (line,) = looked(folder)
    assert line.endswith("remark: on_key is never called by Hippodrome; docs/callbacks.md lists the callbacks")


def test_a_method_that_is_nearly_a_callback_is_remarked_on(folder: Path) -> None:
    agent(folder, "    def close", "    def on_episode_over(self, session):\n        pass\n\n    def close")
    (line,) = looked(folder)
    assert re.fullmatch(
        r"agent\.py:\d+: remark: on_episode_over is never called by Hippodrome; did you mean on_episode_end\?",
        line,
    )
    agent(
        folder,
        "    def close",
        "    def on_episode_end(self, session):\n        self.on_episode_over(session)\n\n    def close",
    )
    assert looked(folder) == []


@pytest.mark.parametrize("limit", ["maxSteps: 12", "episodeSeconds: 0.2"])
def test_an_episode_ends_at_its_limit(folder: Path, limit: str) -> None:
    agent(folder, "self.n >= 30", "False")
    config(folder, "  maxEpisodes: 1\n", f"  maxEpisodes: 2\n  {limit}\n")
    said: list[str] = []
    assert agent_check.try_agent(folder, read_project(folder), 60, said.append) == []
    assert said == ["played: 2 of 2 episodes to the end, 24 steps"]


@pytest.mark.parametrize(("names", "remark"), [("[noop, left, right]", False), ("[noop]", True)])
def test_more_names_than_actions_is_a_mistake(folder: Path, names: str, remark: bool) -> None:
    config(folder, "actionSpace: [noop, left]", f"actionSpace: {names}")
    config(folder, ", left: true", "")
    agent(folder, "class Env:", "class Space:\n    n = 2\n\nclass Env:\n    action_space = Space()")
    (line,) = tried(folder)
    assert f"has {names.count(',') + 1} names, but the environment has 2 actions" in line
    assert (": remark: " in line) is remark
    assert line.startswith("config.yml:")


@pytest.mark.parametrize(
    ("actions", "dead"),
    [
        ("[noop, left, wright]", True),
        ("[noop, left, RIGHT]", False),
        ("[noop, left, upright]", False),
        ("[noop, left, jump, jumpright]", False),
    ],
)
def test_an_arrow_that_no_action_is_called_after_is_remarked(folder: Path, actions: str, dead: bool) -> None:
    config(folder, "actionSpace: [noop, left]", f"actionSpace: {actions}")
    config(folder, "left: true", "left: true, right: true, down: false")
    remark = "config.yml:14: remark: trial.ui.right: the arrow does nothing: no action is called right"
    assert looked(folder) == ([remark] if dead else [])


@pytest.mark.parametrize(
    ("ui", "count", "remark"),
    [
        ("left: true, right: true", 2, "the arrows left and right are not shown: the environment has 2 actions without "
         "names; name them all, in their order: actionSpace: [left, right]"),
        ("up: true", 3, "the arrow up is not shown: the environment has 3 actions without names; name them all, in "
         "their order: actionSpace: [up, …]"),
        ("left: false", 2, None),
    ],
)  # fmt: skip
def test_arrows_of_actions_without_names_are_remarked(folder: Path, ui: str, count: int, remark: str | None) -> None:
    config(folder, "  actionSpace: [noop, left]\n", "  idleAction: '0'\n")
    config(folder, "left: true", ui)
    agent(folder, "class Env:", f"class Space:\n    n = {count}\n\nclass Env:\n    action_space = Space()")
    assert tried(folder) == ([] if remark is None else [f"config.yml:14: remark: trial.ui: {remark}"])


@pytest.mark.parametrize("action_space", ["", "  actionSpace: []\n"])
def test_an_arrow_without_an_action_of_the_environment_is_remarked(folder: Path, action_space: str) -> None:
    config(folder, "  actionSpace: [noop, left]\n", action_space)
    config(folder, "left: true", "left: true, right: true")
    agent(folder, "class Env:", "class Env:\n    def get_action_meanings(self):\n        return ['NOOP', 'LEFT']")
    (line,) = tried(folder)
    assert line.endswith("remark: trial.ui.right: the arrow does nothing: no action is called right")


def test_without_ui_arrows_of_actions_without_names_get_no_remark(folder: Path) -> None:
    config(folder, "  actionSpace: [noop, left]\n", "  idleAction: '0'\n")
    config(folder, "  ui: {start: true, pause: true, stop: true, left: true}\n", "")
    agent(folder, "class Env:", "class Space:\n    n = 2\n\nclass Env:\n    action_space = Space()")
    assert tried(folder) == []


def test_default_arrows_without_ui_get_no_remark(folder: Path) -> None:
    config(folder, "  ui: {start: true, pause: true, stop: true, left: true}\n", "")
    assert looked(folder) == []


def test_a_key_without_an_action_of_the_environment_is_remarked(folder: Path) -> None:
    config(folder, "  actionSpace: [noop, left]\n", "  keys:\n    ArrowLeft: left\n    Space: jump\n")
    agent(folder, "class Env:", "class Env:\n    def get_action_meanings(self):\n        return ['NOOP', 'LEFT']")
    (line,) = tried(folder)
    assert line.endswith("the key does nothing: no action is called jump; there are noop, left")


def test_with_keys_the_arrows_of_ui_are_not_remarked(folder: Path) -> None:
    config(folder, "actionSpace: [noop, left]", "actionSpace: [noop, left]\n  keys: {a: left}")
    config(folder, "left: true", "left: true, right: true")
    assert looked(folder) == []


def test_players_without_a_participant_are_remarked(folder: Path) -> None:
    config(folder, "actionSpace: [noop, left]", "actionSpace: [noop, left]\n  players: {a: human, b: human, c: idle}")
    (line,) = looked(folder)
    assert line.endswith(
        "remark: trial.players: 2 players are human (a, b), and a game has one participant, who plays the first; "
        "write players: 2 under project, or let the others be played by a policy"
    )
    groups = "players: {0: {a: human, b: random}, 1: {a: human, b: human}}"
    config(folder, "players: {a: human, b: human, c: idle}", groups)
    page = (folder / "steps" / "hello.html").rename(folder / "steps" / "hello-0.html")
    (folder / "steps" / "hello-1.html").write_bytes(page.read_bytes())
    (line,) = looked(folder)
    assert "trial.players.1: 2 players are human" in line


def test_keys_that_act_before_their_combination_are_remarked(folder: Path) -> None:
    keys = "keys: {a: left, b+a: noop, c+d: noop}"
    config(folder, "actionSpace: [noop, left]", f"actionSpace: [noop, left]\n  {keys}")
    assert looked(folder) == []
    config(folder, keys, f"{keys}\n  input: single")
    (line,) = looked(folder)
    assert line.endswith('trial.keys.b+a: with input: single, a does "left" before the other key is down')


def test_fields_of_a_page_that_the_game_page_shows_are_sent(folder: Path) -> None:
    (folder / "steps" / "rules.html").write_text("<h1>Rules</h1><label>Age <input name='age'></label>")
    config(folder, "actionSpace: [noop, left]", "actionSpace: [noop, left]\n  instructions: rules")
    assert looked(folder) == []
    (folder / "steps" / "rules.html").write_text("<h1>Rules</h1><p>{{ nobody.knows }}</p>")
    assert any("nobody" in line for line in looked(folder))


def with_a_third_name(folder: Path, step: str) -> None:
    """A study with three names, of which the environment has two; it complains of any other."""
    config(folder, "actionSpace: [noop, left]", "actionSpace: [noop, left, right]")
    agent(folder, "class Env:", "class Space:\n    n = 2\n\nclass Env:\n    action_space = Space()")
    agent(folder, "self.n += 1", "self.n += 1; assert action in (0, 1), 'no such action'")
    agent(folder, "return self.env.step(action)", step)


def test_turn_by_turn_no_action_is_taken_that_the_mask_forbids(folder: Path) -> None:
    config(folder, "  maxEpisodes: 1\n", "  maxEpisodes: 1\n  pace: turns\n")
    agent(folder, "return 0, {}", "return 0, {'action_mask': [1, 0]}")
    agent(folder, "self.n >= 30, False, {}", "self.n >= 30, False, {'action_mask': np.array([1, 0])}")
    agent(folder, "self.n += 1", "self.n += 1; assert action == 0, 'an illegal action'")
    assert tried(folder) == []


def test_turn_by_turn_the_idle_action_is_taken_if_the_mask_allows_none_of_the_named_actions(folder: Path) -> None:
    config(folder, "  maxEpisodes: 1\n", "  maxEpisodes: 1\n  pace: turns\n")
    agent(folder, "return 0, {}", "return 0, {'action_mask': [0, 0, 1]}")
    agent(folder, "self.n >= 30, False, {}", "self.n >= 30, False, {'action_mask': [0, 0, 1]}")
    agent(folder, "self.n += 1", "self.n += 1; assert action == 0, 'another action'")
    assert tried(folder) == []


def test_an_agent_may_turn_names_into_actions_of_the_environment(folder: Path) -> None:
    with_a_third_name(folder, "return self.env.step([0, 0, 1][action])")
    assert tried(folder) == []


def test_if_the_agent_translates_names_an_error_is_not_attributed_to_the_names(folder: Path) -> None:
    with_a_third_name(folder, "assert action != 2, 'mine'; return self.env.step(0)")
    (line,) = tried(folder)
    assert "step(2) fails" in line
    assert line.endswith("AssertionError: mine")


def test_more_names_than_the_action_space_has_are_a_mistake_if_the_agent_has_no_step(folder: Path) -> None:
    with_a_third_name(folder, "return self.env.step(action)")
    agent(folder, "def step(self, action):\n        return", "def unused(self, action):\n        return")
    (line,) = tried(folder)
    assert line.startswith("config.yml:13: trial.actionSpace: has 3 names, but the environment has 2 actions; ")


def test_an_action_that_the_environment_refuses_is_a_mistake_in_the_names(folder: Path) -> None:
    with_a_third_name(folder, "return self.env.step(action)")
    (line,) = tried(folder)
    assert line.startswith("config.yml:13: trial.actionSpace: has 3 names, but the environment has 2 actions; ")


def test_an_agent_that_hangs_is_reported(folder: Path) -> None:
    agent(folder, "self.n += 1", "import time; time.sleep(1000)")
    began = time.monotonic()
    assert tried(folder, 4) == ["agent.py:8: step(0) has not come back within 4 s"]
    assert time.monotonic() - began < 10


@pytest.mark.parametrize(
    ("old", "line", "call"),
    [
        ("self.n += 1", 8, "step(0)"),
        ("self.n = 0", 5, "reset()"),
        ("return np.zeros((16, 16, 3), np.uint8)", 11, "render()"),
    ],
)
def test_a_single_call_is_given_up_when_a_server_gives_it_up(
    folder: Path, monkeypatch: pytest.MonkeyPatch, old: str, line: int, call: str
) -> None:
    assert agent_check.CALL_SECONDS == 30
    monkeypatch.setattr(agent_check, "CALL_SECONDS", 1.5)
    agent(folder, "import numpy as np", "import time; import numpy as np; time.sleep(2)")  # the start may take longer
    agent(folder, old, "time.sleep(1000)")
    said = f"agent.py:{line}: {call} has not come back within 1.5 s: a server waits no longer either"
    assert tried(folder) == [said]


def test_calls_that_take_less_than_the_limit_may_take_longer_together(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(agent_check, "CALL_SECONDS", 3.0)
    monkeypatch.setattr(agent_check, "PLAY_SECONDS", 4.0)
    agent(folder, "self.n += 1", "import time; time.sleep(0.9); self.n += 5")
    assert not [line for line in tried(folder) if "has not come back" in line]


def test_processes_of_the_agent_end_with_the_check(folder: Path, tmp_path: Path) -> None:
    note = tmp_path / "pid"
    agent(
        folder,
        "self.env = Env()",
        f"import subprocess; open({str(note)!r}, 'w').write(str(subprocess.Popen(['sleep', '99']).pid)); self.env = Env()",
    )
    assert tried(folder) == []
    line = Path(f"/proc/{note.read_text()}/cmdline")
    until(lambda: not (line.exists() and line.read_bytes()))


def test_a_custom_agent_needs_an_action_space(folder: Path) -> None:
    config(folder, "  actionSpace: [noop, left]\n", "  idleAction: '0'\n")
    assert tried(folder) == [
        "config.yml:8: trial.actionSpace: missing; list the game's actions, since the environment does not name them"
    ]


def test_a_game_that_does_not_exist_is_reported(folder: Path) -> None:
    (folder / "agent.py").unlink()
    config(folder, "game: none", "game: CartPoll-v1")
    (line,) = tried(folder)
    assert line.startswith('config.yml:9: trial.game: start("CartPoll-v1") fails: gymnasium.error.NameNotFound: ')


def test_a_game_without_an_agent_is_tried(folder: Path) -> None:
    (folder / "agent.py").unlink()
    config(folder, "game: none", "game: ALE/Pong-v5")
    said = "config.yml:13: remark: trial.actionSpace: has 2 names, but the environment has 6 actions"
    assert tried(folder) == [said]


def test_an_agent_sees_what_a_server_would_see(folder: Path) -> None:
    config(folder, "  maxEpisodes: 1", "  maxEpisodes: 1\n  options: {level: 7}")
    (folder / "beside.py").write_text("LEVEL = 7")
    lines = """import beside, json, os, threading
        assert json.loads(os.environ["TRIAL"])["options"]["level"] == beside.LEVEL
        assert os.environ["GROUP"] == "" and os.path.exists("config.yml")
        assert threading.current_thread() is not threading.main_thread()
        self.env = Env()"""
    agent(folder, "self.env = Env()", lines)
    assert tried(folder) == []


# --- agents that are started before their participant is known


def warm(folder: Path, *, groups: bool = True) -> None:
    config(folder, "  maxRuntime: 5", "  maxRuntime: 5\n  warmServers: 2")
    if groups:
        page(folder, "<h1>Hello</h1>", "hello-0")
        (folder / "steps" / "hello.html").rename(folder / "steps" / "hello-1.html")


EARLY = "is not known here: with warmServers the agent starts before its participant comes; read it in reset()"


READS = ("os.environ.get('GROUP')", "os.getenv('GROUP')", "'GROUP' in os.environ", "environ.get('GROUP', '0')")


@pytest.mark.explores
@pytest.mark.parametrize(("reads", "at"), sample([(reads, at) for reads in READS for at in (1, 18)], 3))
def test_a_group_that_is_read_before_the_handover_is_remarked(folder: Path, reads: str, at: int) -> None:
    warm(folder)
    if at == 1:
        agent(folder, "import numpy as np", f"import os; from os import environ; import numpy as np; x = {reads}")
    else:
        agent(folder, "self.env = Env()", f"import os; from os import environ\n        x = {reads}; self.env = Env()")
    assert tried(folder) == [f"agent.py:{at}: remark: GROUP {EARLY}"]


def test_a_group_that_is_required_before_the_handover_is_a_mistake(folder: Path) -> None:
    warm(folder, groups=False)  # an ordinary server has an empty one
    agent(folder, "self.env = Env()", "import os; self.group = os.environ['GROUP']")
    remark, mistake = tried(folder)
    assert remark == f"agent.py:17: remark: GROUP {EARLY}"
    assert mistake == "agent.py:17: start(\"none\") fails: KeyError: 'GROUP'"


def test_a_participant_id_that_is_read_before_the_handover_is_remarked(folder: Path) -> None:
    warm(folder, groups=False)
    (folder / "beside.py").write_text("import os\nPERSON = os.environ.get('USER_ID')\nGROUP = os.environ.get('GROUP')")
    agent(folder, "import numpy", "import beside; import numpy")
    assert tried(folder) == [f"beside.py:2: remark: USER_ID {EARLY}"]


def test_a_group_can_be_read_at_reset(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("GROUP", "of this shell")
    monkeypatch.setenv("USER_ID", "of this shell")
    warm(folder)
    agent(folder, "self.env = Env()", "import os; dict(os.environ); os.environ.copy(); self.env = Env()")
    agent(
        folder,
        "return self.env.reset(seed=seed)",
        "import os; assert (os.environ['GROUP'] in '01', os.environ['USER_ID']) == (True, 'check'); return self.env.reset()",
    )
    assert tried(folder) == []


def test_variables_that_libraries_read_are_not_the_projects(folder: Path) -> None:
    warm(folder)
    library = folder / ".venv" / "lib" / "site-packages"
    library.mkdir(parents=True)
    (library / "somebodys.py").write_text("import os\nx = os.environ.get('GROUP')")
    agent(folder, "import numpy", f"import sys; sys.path.append({str(library)!r}); import somebodys; import numpy")
    assert tried(folder) == []


def test_without_warm_servers_a_group_may_be_read_at_any_time(folder: Path) -> None:
    page(folder, "<h1>Hello</h1>", "hello-0")
    (folder / "steps" / "hello.html").rename(folder / "steps" / "hello-1.html")
    agent(folder, "self.env = Env()", "import os; assert os.environ['GROUP'] in '01'; self.env = Env()")
    assert tried(folder) == []


def test_a_mistake_in_a_file_beside_the_agent_is_reported_there(folder: Path) -> None:
    (folder / "beside.py").write_text("\nx = (")
    agent(folder, "import numpy", "import beside; import numpy")
    assert tried(folder) == ["beside.py:2: start(\"none\") fails: SyntaxError: '(' was never closed"]


def test_without_a_game_the_agent_does_not_matter(folder: Path) -> None:
    config(folder, "2: game, 3: bye", "2: bye")
    config(folder, "  events: {startServerStep: 2, stopServerStep: 3}\n", "")
    (folder / "agent.py").write_text("(")
    status, lines = run(folder)
    assert status == 0
    assert len(lines) == 1


@pytest.mark.parametrize("source", [b"x = '\xff'", b"\0", b"(", b"  x", b"return"])
def test_an_agent_with_a_syntax_error_is_refused(folder: Path, source: bytes) -> None:
    (folder / "agent.py").write_bytes(source)
    (line,) = looked(folder)
    assert line.startswith("agent.py")
    assert "Python cannot read this" in line


@pytest.mark.parametrize("control", ["good", "trainOnline", "wave"])
def test_words_that_reach_no_method_of_the_agent_are_remarked(folder: Path, control: str) -> None:
    config(folder, "left: true", f"left: true, {control}: true")
    (line,) = tried(folder)
    assert line.endswith(
        f"remark: trial.ui.{control}: class Agent has no feedback(word), so what participants say ({control}) is only recorded"
    )
    agent(folder, "class Agent:", "class Agent:\n    def on_feedback(self, session, record): pass\n")
    assert tried(folder) == []


@pytest.mark.parametrize(
    ("file", "whose"),
    [
        ("hippodrome.py", "Hippodrome"), ("hippodrome/maze.py", "Hippodrome"), ("random.py", "Python"), ("test.py", "Python"),
        ("maze.py", None), ("console.py", None), ("export/__init__.py", None), ("trial.py", None), ("responses.py", None),
    ],
)  # fmt: skip
def test_a_file_that_an_import_does_not_get_is_named(folder: Path, file: str, whose: str | None) -> None:
    name, _, inner = file.removesuffix(".py").partition("/")
    (folder / file).parent.mkdir(exist_ok=True)
    (folder / file).touch()
    assert looked(folder) == [], "it is not imported"
    agent(folder, "class Agent:", f"import {name}{'.maze' if inner == 'maze' else ''}\n\nclass Agent:")
    found = [line.partition(": ")[2] for line in looked(folder)]
    shown = name if inner else file
    message = f"import {name} finds a module of {whose}, and not {shown} beside agent.py; rename {shown}"
    assert found == ([message] if whose else [])


def test_the_agents_files_win_over_installed_packages_and_hippodromes_folders(folder: Path) -> None:
    names = ("responses", "utils", "console", "export", "testing", "trial", "communicator")  # responses is installed
    for name in names:
        (folder / f"{name}.py").write_text("WHOSE = 'the researcher'\n")
    (folder / "random.py").write_text("raise SystemExit('hides random')\n")
    uses = (
        f"import random, {', '.join(names)}\nassert {{m.WHOSE for m in ({', '.join(names)})}} == {{'the researcher'}}"
    )
    agent(folder, "class Agent:", f"{uses}\n\nclass Agent:")
    assert tried(folder) == []


@pytest.mark.parametrize(
    ("file", "module"),
    [
        ("numpy.py", "numpy"),
        ("PIL/__init__.py", "PIL"),
        ("websockets/__init__.py", "websockets"),
    ],
)
def test_a_file_that_hides_a_package_of_the_servers_is_a_mistake(folder: Path, file: str, module: str) -> None:
    (folder / file).parent.mkdir(exist_ok=True)
    (folder / file).write_text("raise SystemExit('hides the package')\n")
    shown = file.removesuffix("__init__.py")
    mistake = f"agent.py: {shown} hides the package {module}, which servers need; rename it"
    status, lines = run(folder)
    assert (status, lines) == (1, [mistake, "1 mistake."])
    (on_a_server,) = tried(folder)
    assert on_a_server.endswith(mistake.removeprefix("agent.py:"))


def test_a_command_names_the_file_that_hides_a_package_of_the_servers(folder: Path) -> None:
    for name in ("gymnasium", "hippodrome", "websockets"):
        (folder / f"{name}.py").write_text("raise SystemExit('hides the package')\n")
    command = [sys.executable, "-P", "-m", "hippodrome", "check"]
    done = subprocess.run(
        command, check=False, cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert done.returncode == 1, done.stderr
    assert done.stdout.splitlines() == [
        "agent.py: gymnasium.py hides the package gymnasium, which servers need; rename it",
        "agent.py: websockets.py hides the package websockets, which servers need; rename it",
        "2 mistakes.",
    ]


def test_a_folder_without_code_hides_no_package(folder: Path) -> None:
    (folder / "numpy").mkdir()
    (folder / "numpy" / "maze.npy").touch()
    assert [*looked(folder), *tried(folder)] == []


def test_the_studys_files_hide_nothing_from_a_command_in_its_folder(folder: Path) -> None:
    for name in ("random", "typer", "responses"):
        (folder / f"{name}.py").write_text("raise SystemExit('hides it')\n")
    command = [sys.executable, "-m", "hippodrome", "check"]
    done = subprocess.run(
        command, check=False, cwd=folder, env={**os.environ, "PYTHONPATH": str(ROOT)}, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout.splitlines()[-1][:11]) == (0, "No mistakes"), done.stdout + done.stderr
