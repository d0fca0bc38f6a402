"""How agents may be written: HIPPO's signatures, its functions without a class, and what its `step` returns."""

from __future__ import annotations

import json
import logging
import math
import textwrap
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hippodrome.trial.agent import signatures
from hippodrome.trial.agent.agent import AgentAdapter, read_step_result
from hippodrome.trial.agent.calls import AgentCalls
from hippodrome.trial.agent.joint import start
from hippodrome.trial.agent.loading import AgentError
from hippodrome.trial.core.effects import StepCall
from hippodrome.trial.core.players import PLAYER, Action
from hippodrome.trial.recordings import recording

AGENT = """
import numpy
class Env:
    pass
class Agent:
    def start(self, game):
        self.env = Env()
        self.env.said = []
        return self.env
    def step(self, action):
        self.env.said.append(("step", action))
        return 0, 1.0, False, {}
    def render(self):
        return numpy.zeros((2, 2, 3), numpy.uint8)
    def reset(self):
        self.env.said.append("reset")
    def close(self):
        self.env.said.append("close")
"""


def adapter(folder: Path, source: str, **names: Any) -> AgentAdapter:
    (folder / "agent.py").write_text(textwrap.dedent(source))
    return AgentAdapter(folder, "a-game", ("noop", "left"), **names)


def started_agent(folder: Path, old: str = "", new: str = "", source: str = AGENT) -> AgentAdapter:
    assert old in source
    player = adapter(folder, source.replace(old, new))
    start(player)
    return player


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("", ""),
        ("step(self, action)", "step(self, env, action)"),
        ("step(self, action)", "step(self, action, env)"),
        ("step(self, action)", "step(self, environment, action)"),
        ("step(self, action)", "step(self, e, action)"),
        ("step(self, action)", "step(self, action, noise=1)"),
        ("step(self, action)", "step(self, env=None, action=0)"),
        ("render(self)", "render(self, env)"),
        ("render(self)", "render(self, mode)"),
        ("render(self)", "render(self, mode='human')"),
        ("reset(self)", "reset(self, env)"),
        ("reset(self)", "reset(self, env, seed=None)"),
        ("reset(self)", "reset(self, seed)"),
        ("reset(self)", "reset(self, seed, options)"),
        ("reset(self)", "reset(self, *, seed=None, options=None)"),
        ("close(self)", "close(self, env)"),
        ("start(self, game)", "start(self)"),
        ("start(self, game)", "start(self, game, *more)"),
    ],
)
def test_methods_are_called_with_or_without_the_environment(tmp_path: Path, old: str, new: str) -> None:
    player = started_agent(tmp_path, old, new)
    player.reset(1)
    player.step(1)
    player.render()
    player.close()
    assert player.env.said == ["reset", ("step", 1), "close"]


@pytest.mark.parametrize(
    ("parameters", "without"),
    [("seed, options", None), ("seed=None, options=None", None), ("*, seed=None, options='mine'", "mine")],
)
def test_reset_gets_the_options_of_the_game(tmp_path: Path, parameters: str, without: object) -> None:
    """With a default of its own, too: that is how Gymnasium writes `reset`. The default stays if there are no options."""
    body = f"def reset(self, {parameters}):\n        self.env.said.append(options)\n        return"
    player = started_agent(
        tmp_path, "def reset(self):\n        return", body, AGENT.replace('self.env.said.append("reset")', "return")
    )
    player.reset(1)
    player.set_game({"partner": "kind"})
    player.reset(1)
    assert player.env.said == [without, {"partner": "kind"}]


def test_an_environments_own_reset_gets_the_options_of_the_game(tmp_path: Path) -> None:
    source = OWN_STEP.replace("SPACE", "spaces.Discrete(2)").replace("self.taken = []", "self.taken = [options]")
    player = started_agent(tmp_path, source=source)
    player.set_game({"layout": "ring"})
    player.reset(1)
    assert player.env.taken == [{"layout": "ring"}]


def test_start_may_take_the_trial_section_in_hippos_form(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Some of HIPPO's agents read keys of their own there; here these keys stand under `options`."""
    options = {"rows": 6, "game": "x", "instructions": ["Mark it"]}
    section = {"game": "maze", "instructions": None, "ui": {"left": True, "up": False}, "options": options}
    monkeypatch.setenv("TRIAL", json.dumps(section))
    monkeypatch.setenv("PROJECT_ID", "my_study")
    player = started_agent(tmp_path, "start(self, game):", "start(self, config):\n        Env.config = config")
    own = {"rows": 6, "instructions": ["Mark it"]}
    assert player.env.config == {"game": "maze", "ui": ["left"], "projectId": "my_study", **own}
    monkeypatch.delenv("TRIAL")
    player = started_agent(
        tmp_path, "start(self, game):", "start(self, config: dict = None):\n        Env.config = config"
    )
    assert player.env.config == {"ui": [], "projectId": "my_study"}


def test_methods_get_the_environment_that_start_returned(tmp_path: Path) -> None:
    source = AGENT.replace("self.env = Env()", "self.env = Env(); other = Env(); other.mine = True").replace(
        "return self.env", "return other"
    )
    player = started_agent(
        tmp_path, "step(self, action):", "step(self, env, action):\n        assert env.mine", source=source
    )
    assert player.step(1).reward == 1.0


def test_reset_gets_a_seed_if_it_takes_one(tmp_path: Path) -> None:
    player = started_agent(tmp_path, "reset(self):", "reset(self, env, seed=None):\n        self.seed = seed")
    assert player.reset(7)[2] is True
    assert player._agent.seed == 7
    assert started_agent(tmp_path).reset(7)[2] is False


def test_functions_without_a_class_are_an_agent(tmp_path: Path) -> None:
    player = started_agent(
        tmp_path,
        source="""
import numpy
def start(game):
    return {"game": game, "steps": []}
def step(env, action):
    env["steps"].append(action)
    return {"observation": 0, "reward": 2, "done": len(env["steps"]) == 2, "info": {}}
def render(env):
    return numpy.zeros((2, 2, 3), numpy.uint8)
def reset(env):
    env["steps"].clear()
def close(env):
    env["closed"] = True
""",
    )
    player.reset(1)
    assert [player.step(action).terminated for action in (1, 0)] == [False, True]
    player.render()
    player.close()
    assert player.env == {"game": "a-game", "steps": [1, 0], "closed": True}


def test_functions_without_all_five_names_are_no_agent(tmp_path: Path) -> None:
    player = adapter(tmp_path, "def start(game): pass\ndef step(env, action): pass\n")
    with pytest.raises(AgentError, match=r"no class Agent, and of its functions no render, reset, close"):
        start(player)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("step(self, action)", "step(self)", "step() cannot be called; write step(action) or step(env, action)"),
        (
            "step(self, action)",
            "step(self, a, b, c)",
            "step(a, b, c) cannot be called; write step(action) or step(env, action)",
        ),
        (
            "step(self, action)",
            "step(self, action, *, noise)",
            "step(action, *, noise) cannot be called; write step(action) or step(env, action)",
        ),
        ("reset(self)", "reset(self, a, b)", "reset(a, b) cannot be called; write reset(), reset(seed) or reset(env)"),
        (
            "render(self)",
            "render(self, a, b, c)",
            "render(a, b, c) cannot be called; write render(), render(env) or render(player)",
        ),
        ("start(self, game)", "start(self, game, more)", "start(game, more) cannot be called; write start(game)"),
    ],
)
def test_a_method_with_wrong_parameters_is_refused_with_a_sentence(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    with pytest.raises(AgentError) as raised:
        started_agent(tmp_path, old, new)
    assert str(raised.value) == words


def test_if_a_method_takes_the_environment_start_must_return_it(tmp_path: Path) -> None:
    hidden = AGENT.replace("        return self.env\n", "").replace("self.env", "self.mine")
    assert started_agent(tmp_path, source=hidden).reset(1) == (None, {}, False)
    player = started_agent(tmp_path, "step(self, action)", "step(self, env, action)", source=hidden)
    with pytest.raises(AgentError, match=r"step\(\) takes the environment; return it from start\(game\)"):
        player.step(1)


def test_a_step_that_takes_a_reward_gets_the_newest_feedback(tmp_path: Path) -> None:
    player = started_agent(
        tmp_path, "step(self, action):", "step(self, action, reward):\n        self.env.said.append(reward)"
    )
    player.step(0)
    player.feedback("bad")
    player.feedback("good")
    player.step(0)
    player.step(0)
    assert [word for word in player.env.said if isinstance(word, str)] == ["None", "good", "None"]


def test_a_callable_without_a_signature_is_called_as_usual() -> None:
    assert signatures.read("step", dict) == signatures.usual("step")


# ---- what step returns


@pytest.mark.parametrize("done", [True, np.True_, np.bool_(1)])
def test_a_step_may_return_only_whether_it_is_done(done: Any) -> None:
    assert (read_step_result(done).terminated, read_step_result(done).reward) == (True, 0.0)
    assert read_step_result(np.False_).terminated is False


def test_numbers_of_numpy_are_read() -> None:
    found = read_step_result({"reward": np.array([2.5]), "done": np.array([True]), "observation": 0})
    assert (found.reward, found.terminated) == (2.5, True)
    with pytest.raises(AgentError, match="a reward that is no number"):
        read_step_result({"reward": np.array([1.0, 2.0])})


@pytest.mark.parametrize("of_hippo", [True, False])
def test_gyms_time_limit_truncates(of_hippo: bool) -> None:
    def ended(done: bool, info: dict[str, Any]) -> tuple[bool, bool]:
        found = read_step_result({"done": done, "info": info} if of_hippo else (0, 1.0, done, info))
        return found.terminated, found.truncated

    assert ended(True, {"TimeLimit.truncated": True}) == (False, True)
    assert ended(True, {"TimeLimit.truncated": False}) == (True, False)
    assert ended(True, {}) == (True, False)
    assert ended(False, {"TimeLimit.truncated": True}) == (False, False)


def test_other_entries_of_the_dict_are_kept() -> None:
    found = read_step_result({"reward": 1, "done": False, "info": {}, "agentAction": 2, "q": [1, 2]})
    assert found.extra == {"agentAction": 2, "q": [1, 2]}
    assert read_step_result({"reward": 1, "done": False, "info": {}, "observation": 0}).extra is None
    both = read_step_result({"done": True, "terminated": False, "truncated": True, "action": "left"})
    assert both.extra == {"done": True, "action": "left"}


# ---- actions that the environment numbers in another way, and actions that are no numbers

OWN_STEP = """
import numpy
from gymnasium import spaces
class Env:
    action_space = SPACE
    def reset(self, seed=None, options=None):
        self.taken = []
        return 0, {}
    def step(self, action):
        self.taken.append(action)
        return 0, float(action), False, False, {"action": action}
    def render(self):
        return numpy.zeros((2, 2, 3), numpy.uint8)
    def close(self):
        pass
class Agent:
    def start(self, game):
        return Env()
"""


@pytest.mark.parametrize("start_number", [-1, 5])
def test_an_environment_whose_actions_begin_elsewhere_gets_its_own_numbers(tmp_path: Path, start_number: int) -> None:
    player = started_agent(tmp_path, source=OWN_STEP.replace("SPACE", f"spaces.Discrete(2, start={start_number})"))
    player.reset(1)
    results = [player.step(action) for action in (0, 1)]
    assert player.env.taken == [start_number, start_number + 1]
    assert [result.action for result in results] == [0, 1], "as everywhere in Hippodrome, places in actionSpace"
    assert player.action_starts == {PLAYER: start_number}


def test_a_step_of_agent_py_gets_the_numbers_of_action_space(tmp_path: Path) -> None:
    player = started_agent(
        tmp_path, "class Env:", "import gymnasium\nclass Env:\n    action_space = gymnasium.spaces.Discrete(2, start=5)"
    )
    player.step(1)
    assert player.env.said == [("step", 1)]
    assert player.action_starts == {}


SPACES = [
    "spaces.Box(-1, 1, (2,))", "spaces.MultiDiscrete([2, 3])", "spaces.MultiBinary(3)",
    "spaces.Dict(x=spaces.Discrete(2))", "spaces.Tuple([spaces.Discrete(2)])",
]  # fmt: skip


@pytest.mark.parametrize("space", SPACES)
@pytest.mark.parametrize("names", [("left", "right"), ()])
@pytest.mark.parametrize("several", [False, True])
def test_actions_that_are_no_numbers_need_a_step_that_translates_them(
    tmp_path: Path, space: str, names: tuple[str, ...], several: bool
) -> None:
    source = OWN_STEP.replace("SPACE", space + ("; possible_agents = ['a']" if several else ""))
    (tmp_path / "agent.py").write_text(source)
    with pytest.raises(
        AgentError, match=rf"takes actions of {space.partition('.')[2].partition('(')[0]}.*write step\(self, action\)"
    ):
        start(AgentAdapter(tmp_path, "a-game", names))
    (tmp_path / "agent.py").write_text(f"{source}    def step(self, action): ...\n")
    start(AgentAdapter(tmp_path, "a-game", ("left", "right")))


# ---- what is recorded of it


def line_of(folder: Path, returned: str, more: str = "") -> dict[str, Any]:
    player = started_agent(folder, "return 0, 1.0, False, {}", f"return {returned}", AGENT + more)
    calls = AgentCalls(player, dict, record_observations=False)
    step = StepCall(
        limit=1, actions={PLAYER: Action(1, "left", "human")}, feedback=(), messages=0, fields={"episode": 1, "step": 1}
    )
    return json.loads(calls.run(step).line)


def test_the_dict_of_a_step_is_recorded_whole(tmp_path: Path) -> None:
    returned = """{"observation": 0, "reward": numpy.float32(1.5), "done": numpy.False_, "info": {"lives": numpy.int64(3)},
        "agentAction": numpy.int64(2), "q": numpy.array([0.5, float("nan")]), "why": {"word": "good", 3: (1, b"x")},
        "map": numpy.arange(1000, dtype=numpy.uint16).reshape(10, 100)}"""
    line = line_of(tmp_path, returned)
    assert (line["reward"], line["info"]) == (1.5, {"lives": 3})
    extra = line["extra"]
    assert extra.keys() == {"agentAction", "q", "why", "map"}
    assert (extra["agentAction"], extra["q"]) == (2, [0.5, None])
    assert extra["why"] == {"word": "good", "3": [1, "eA=="]}
    assert np.array_equal(recording.read_observation(extra["map"]), np.arange(1000, dtype=np.uint16).reshape(10, 100))


def test_a_step_that_returns_a_tuple_records_no_extra(tmp_path: Path) -> None:
    assert "extra" not in line_of(tmp_path, "0, 1.0, False, {}")


def test_an_entry_that_is_too_large_is_logged_once_and_the_others_are_recorded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    player = started_agent(
        tmp_path, "return 0, 1.0, False, {}", 'return {"done": False, "small": 1, "large": "x" * 2_000_000, "last": 2}'
    )
    calls = AgentCalls(player, dict, record_observations=False)
    step = StepCall(limit=1, actions={PLAYER: Action(1, "left", "human")}, feedback=(), messages=0, fields={})
    with caplog.at_level(logging.WARNING, "trial"):
        lines = [json.loads(calls.run(step).line) for _ in range(3)]
    assert [line["extra"] for line in lines] == [{"small": 1, "large": {"tooLarge": 2_000_002}, "last": 2}] * 3
    assert [record.getMessage() for record in caplog.records] == [
        "what step() returns as 'large' is too large for the recording (2000002 bytes); its size is recorded instead"
    ]


def test_an_info_that_is_too_large_is_logged_once_and_the_rest_of_it_is_recorded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    info = '{"small": 1, "large": "x" * 2_000_000, "last": [2]}'
    player = started_agent(tmp_path, "return 0, 1.0, False, {}", f"return 0, 1.0, False, False, {info}")
    calls = AgentCalls(player, dict, record_observations=False)
    step = StepCall(limit=1, actions={PLAYER: Action(1, "left", "human")}, feedback=(), messages=0, fields={})
    with caplog.at_level(logging.WARNING, "trial"):
        lines = [json.loads(calls.run(call).line) for call in (step, step)]
    assert [line["info"] for line in lines] == [{"small": 1, "large": {"tooLarge": 2_000_002}, "last": [2]}] * 2
    assert [record.getMessage() for record in caplog.records] == [
        "'large' in info is too large for the recording (2000002 bytes); its size is recorded instead"
    ]


def test_an_info_of_too_many_values_is_cut_off_with_a_mark(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    info = "{str(number): 'x' * 100 for number in range(50_000)}"
    player = started_agent(tmp_path, "return 0, 1.0, False, {}", f"return 0, 1.0, False, False, {info}")
    calls = AgentCalls(player, dict, record_observations=False)
    step = StepCall(limit=1, actions={PLAYER: Action(1, "left", "human")}, feedback=(), messages=0, fields={})
    with caplog.at_level(logging.WARNING, "trial"):
        lines = [calls.run(call).line for call in (step, step)]
    assert max(map(len, lines)) < 1.2 * recording.MAX_EXTRA_BYTES
    kept = json.loads(lines[1])["info"]
    assert json.loads(lines[0])["info"] == kept
    assert kept["0"] == "x" * 100
    assert len(kept) - 1 + kept["<cut off>"] == 50_000
    assert len(caplog.records) == 20


def test_thirty_infos_of_fifty_megabytes_are_written_within_the_tests_time(tmp_path: Path) -> None:
    info = '{"text": "x" * 50_000_000, "array": numpy.zeros((10, 1_000_000)), "last": 1}'
    player = started_agent(tmp_path, "return 0, 1.0, False, {}", f"return 0, 1.0, False, False, {info}")
    calls = AgentCalls(player, dict, record_observations=False)
    step = StepCall(limit=1, actions={PLAYER: Action(1, "left", "human")}, feedback=(), messages=0, fields={})
    first, *others = [json.loads(calls.run(step).line)["info"] for _ in range(30)]
    assert first["text"] == {"tooLarge": 50_000_002}
    assert first["array"].keys() == {"tooLarge"}
    assert first["last"] == 1
    assert others == [first] * 29


def test_a_small_info_after_a_large_one_is_recorded_as_usual(tmp_path: Path) -> None:
    info = '{"a": ["x" * 2_000_000, 1][game.steps > 1], "on": {True: [1]}, "deep": deep}'
    more = """
class game: steps = 0
deep = []
for _ in range(25): deep = [deep]
"""
    player = started_agent(
        tmp_path, "return 0, 1.0, False, {}", f"game.steps += 1; return 0, 1.0, False, False, {info}", AGENT + more
    )
    step = StepCall(limit=1, actions={PLAYER: Action(1, "left", "human")}, feedback=(), messages=0, fields={})
    calls = AgentCalls(player, dict, record_observations=False)
    _, after, later = [json.loads(calls.run(step).line)["info"] for _ in range(3)]
    assert after == later
    assert later["on"] == {"true": [1]}


def test_an_info_is_recorded_whole_beside_a_large_observation(tmp_path: Path) -> None:
    info, observation = '{"many": numpy.arange(200)}', "numpy.random.default_rng(1).bytes(3_000_000).hex()"
    player = started_agent(tmp_path, "return 0, 1.0, False, {}", f"return {observation}, 1.0, False, False, {info}")
    calls = AgentCalls(player, dict, record_observations=True)
    step = StepCall(limit=1, actions={PLAYER: Action(1, "left", "human")}, feedback=(), messages=0, fields={})
    line = json.loads(calls.run(step).line)
    assert line["info"] == {"many": list(range(200))}
    assert len(line["observation"]) == 6_000_000


@pytest.mark.parametrize("value", ["game.steps", "[game.steps]", "{'x': (game.steps,)}", "numpy.int64(game.steps)"])
def test_an_info_that_the_game_changes_afterwards_stays_as_it_was(tmp_path: Path, value: str) -> None:
    changes = f"game.steps += 1; game.info['lives'] = {value}; return 0, 1.0, False, False, game.info"
    player = started_agent(tmp_path, "return 0, 1.0, False, {}", changes, AGENT + "\nclass game: steps, info = 0, {}\n")
    calls = AgentCalls(player, dict, record_observations=False)
    step = StepCall(limit=1, actions={PLAYER: Action(1, "left", "human")}, feedback=(), messages=0, fields={})
    lines = [calls.run(step).line for _ in range(3)]
    expected: dict[str, Any] = {"game.steps": [1, 2, 3], "[game.steps]": [[1], [2], [3]]}
    expected |= {"{'x': (game.steps,)}": [{"x": [1]}, {"x": [2]}, {"x": [3]}], "numpy.int64(game.steps)": [1, 2, 3]}
    assert [json.loads(line)["info"]["lives"] for line in lines] == expected[value]


def test_a_dict_that_contains_itself_is_recorded(tmp_path: Path) -> None:
    returned = '(lambda c: c.update(me=c) or {"done": False, "circle": c})({})'
    assert "circle" in line_of(tmp_path, returned)["extra"]


def test_a_step_may_return_a_tuple_or_hippos_dict():
    five = read_step_result((1, np.float32(2), np.bool_(True), False, {"a": 1}))
    assert (five.reward, five.terminated, five.truncated, five.info) == (2.0, True, False, {"a": 1})
    assert read_step_result((1, 2, True, None)).terminated
    hippo = read_step_result({"observation": 1, "reward": 3, "done": True, "info": {}, "action": np.int64(4)})
    assert (hippo.reward, hippo.terminated, hippo.action) == (3.0, True, 4)
    for wrong in (None, (1, 2), (1, "x", False, {}), (1, math.nan, False, {}), 5):
        with pytest.raises(AgentError):
            read_step_result(wrong)


def test_an_agent_that_reads_arguments_when_it_is_imported_gets_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.argv", ["process.py", "report"])
    started_agent(tmp_path, "import numpy", "import argparse, numpy\nargparse.ArgumentParser().parse_args()")
