"""Environments with several players: PettingZoo's own, and agents whose methods take and give dictionaries."""

from __future__ import annotations

import random
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.joint import Joint, JointAdapter, start
from hippodrome.trial.agent.joint_calls import snapshot
from hippodrome.trial.agent.loading import AgentError

PONG = "pettingzoo.butterfly.cooperative_pong_v6"
TICTACTOE = "pettingzoo.classic.tictactoe_v3"
ROCK_PAPER_SCISSORS = "pettingzoo.classic.rps_v2"


@pytest.fixture(autouse=True)
def _no_window(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def start_agent(
    folder: Path, source: str = "", *, game: str = "none", names: tuple[str, ...] = (), players: tuple[str, ...] = ()
) -> Any:
    if source:
        (folder / "agent.py").write_text(source)
    return start(AgentAdapter(folder, game, names), players)


def joint_adapter(folder: Path, source: str = "", **more: Any) -> JointAdapter:
    found = start_agent(folder, source, **more)
    assert isinstance(found, JointAdapter)
    return found


def play_episode(adapter: JointAdapter, seed: int = 3) -> list[Joint]:
    """Play an episode of random legal actions to its end; return its steps."""
    chance = random.Random(seed)
    now, _ = adapter.reset(seed)
    found = [now]
    while not now.over:
        legal = {
            player: [index for index, may in enumerate(now.masks[player]) if may]
            if player in now.masks
            else range(len(adapter.action_spaces[player]))
            for player in now.to_act
        }
        now = adapter.step({player: chance.choice(legal[player]) for player in sorted(now.to_act)})
        found.append(now)
    return found


# ---- PettingZoo


def test_a_parallel_environment_is_made_by_the_name_of_its_module(tmp_path: Path) -> None:
    adapter = joint_adapter(tmp_path, game=PONG)
    assert adapter.players == ("paddle_0", "paddle_1")
    assert adapter.action_spaces == {"paddle_0": ("0", "1", "2"), "paddle_1": ("0", "1", "2")}
    assert adapter.observation_spaces["paddle_1"].shape == (280, 480, 3)
    first, seeded = adapter.reset(1)
    assert seeded
    assert (first.to_act, first.over, first.rewards) == (
        {"paddle_0", "paddle_1"},
        False,
        {"paddle_0": 0, "paddle_1": 0},
    )
    picture = adapter.pictures()
    assert isinstance(picture, np.ndarray)
    assert (picture.shape[2], picture.dtype) == (3, np.uint8)
    last = play_episode(adapter)[-1]
    assert (last.over, last.why, last.to_act) == (True, "terminated", frozenset())
    adapter.close()


def test_the_same_seed_and_actions_give_the_same_rewards(tmp_path: Path) -> None:
    adapter = joint_adapter(tmp_path, game=PONG)
    one, two = ([step.rewards for step in play_episode(adapter, 5)] for _ in range(2))
    assert one == two
    assert any(any(rewards.values()) for rewards in one)


def test_in_an_aec_environment_players_act_in_turn(tmp_path: Path) -> None:
    adapter = joint_adapter(tmp_path, game=TICTACTOE)
    steps = play_episode(adapter)
    turns = [sorted(step.to_act) for step in steps[:4]]
    assert turns == [["player_1"], ["player_2"], ["player_1"], ["player_2"]]
    assert sum(steps[0].masks["player_1"]) == 9
    assert sum(steps[1].masks["player_2"]) == 8
    assert "player_1" not in steps[1].masks, "who is not to act has no mask"
    last = steps[-1]
    assert (last.over, sorted(last.rewards.values())) in ((True, [-1.0, 1.0]), (True, [0.0, 0.0]))
    again, _ = adapter.reset(4)
    assert (again.over, again.to_act) == (False, {"player_1"})
    assert not any([*again.terminated.values(), *again.truncated.values()])


def test_in_an_aec_environment_that_is_parallelizable_all_act_at_once(tmp_path: Path) -> None:
    steps = play_episode(joint_adapter(tmp_path, game=ROCK_PAPER_SCISSORS))
    assert {step.to_act for step in steps[:-1]} == {frozenset({"player_0", "player_1"})}
    assert steps[-1].why == "truncated"


RETURNED = """
class Agent:
    def start(self, game):
        from pettingzoo.classic import {module}
        return {module}.{make}(render_mode="rgb_array")
"""


@pytest.mark.parametrize(
    ("module", "make", "first"),
    [
        ("tictactoe_v3", "env", ["player_1"]),
        ("connect_four_v3", "raw_env", ["player_0"]),
        ("rps_v2", "env", ["player_0", "player_1"]),
        ("rps_v2", "parallel_env", ["player_0", "player_1"]),
    ],
)
def test_a_class_may_have_start_alone_and_leave_the_rest_to_the_environment(
    tmp_path: Path, module: str, make: str, first: list[str]
) -> None:
    adapter = joint_adapter(tmp_path, RETURNED.format(module=module, make=make))
    steps = play_episode(adapter)
    assert sorted(steps[0].to_act) == first
    assert steps[-1].over
    adapter.close()


def test_a_class_may_draw_and_leave_the_rest_to_the_environment(tmp_path: Path) -> None:
    source = RETURNED.format(module="tictactoe_v3", make="env") + (
        "    def render(self):\n        import numpy\n        return numpy.full((2, 3, 3), 7, numpy.uint8)\n"
    )
    adapter = joint_adapter(tmp_path, source)
    adapter.reset(1)
    picture = adapter.pictures()
    assert isinstance(picture, np.ndarray)
    assert (picture.shape, picture[0, 0, 0]) == ((2, 3, 3), 7)


def test_players_who_leave_before_the_others_do_not_act_any_more(tmp_path: Path) -> None:
    """PettingZoo takes them out of `agents`."""
    steps = play_episode(joint_adapter(tmp_path, game="pettingzoo.butterfly.knights_archers_zombies_v11"), 1)
    left = [step for step in steps if 0 < len(step.to_act) < 4]
    assert left, "with this seed, a player leaves early"
    for step in left:
        gone = {player for player in step.terminated if step.terminated[player] or step.truncated[player]}
        assert gone.isdisjoint(step.to_act)
        assert len(gone) + len(step.to_act) == 4


def test_the_error_about_a_missing_version_names_the_version_that_there_is(tmp_path: Path) -> None:
    with pytest.raises(AgentError) as refused:
        start_agent(tmp_path, game="pettingzoo.butterfly.cooperative_pong_v5")
    assert str(refused.value) == (
        "there is no module pettingzoo.butterfly.cooperative_pong_v5; its package has cooperative_pong_v6"
    )


def test_a_module_that_makes_no_environment_is_refused(tmp_path: Path) -> None:
    with pytest.raises(AgentError, match=r"the module email\.utils has neither parallel_env\(\) nor env\(\)"):
        start_agent(tmp_path, game="email.utils")


# ---- methods with dictionaries


def begin_and_step(adapter: JointAdapter) -> Joint:
    adapter.reset(1)
    return adapter.step({})


OWN = """
import numpy

class Agent:
    possible_agents = [0, 1]

    def start(self, game):
        self.heard = []

    def reset(self, seed=None):
        self.n, self.given = 0, []
        return {0: seed, 1: -seed}, {0: {}, 1: {"hint": 5}}

    def step(self, actions):
        self.n += 1
        self.given.append(dict(actions))
        return {0: self.n, 1: -self.n}, {0: 1.5, 1: -1}, {0: False, 1: False, "__all__": self.n == 3}, {}, {}

    def render(self, player):
        return numpy.full((2, 2, 3), 10 + player, numpy.uint8)

    def feedback(self, word, player):
        self.heard.append((word, player))

    def close(self):
        pass
"""


def test_five_methods_may_use_dictionaries_whose_keys_are_numbers(tmp_path: Path) -> None:
    adapter = joint_adapter(tmp_path, OWN, names=("left", "right"))
    assert adapter.players == ("0", "1")
    assert adapter.action_spaces == {"0": ("left", "right"), "1": ("left", "right")}
    first, seeded = adapter.reset(9)
    assert (seeded, first.observations, first.infos) == (True, {"0": 9, "1": -9}, {"0": {}, "1": {"hint": 5}})
    step = adapter.step({"0": 1, "1": 0})
    assert adapter.agent.given == [{0: 1, 1: 0}]
    assert (step.observations, step.rewards, step.over) == ({"0": 1, "1": -1}, {"0": 1.5, "1": -1.0}, False)
    adapter.step({"0": 0})
    assert adapter.agent.given[-1] == {0: 0, 1: 0}, "the environment gets an action of everyone"
    last = adapter.step({})
    assert (last.over, last.terminated, last.to_act) == (True, {"0": True, "1": True}, frozenset())


def test_each_player_has_a_view_of_their_own_if_render_takes_a_player(tmp_path: Path) -> None:
    adapter = joint_adapter(tmp_path, OWN, names=("left", "right"))
    adapter.reset(1)
    views = adapter.pictures()
    assert isinstance(views, dict)
    assert {player: picture[0, 0, 0] for player, picture in views.items()} == {"0": 10, "1": 11}
    adapter.views = ("1",)
    views = adapter.pictures()
    assert isinstance(views, dict)
    assert list(views) == ["1"]


def test_feedback_comes_with_its_player_if_the_method_takes_one(tmp_path: Path) -> None:
    adapter = joint_adapter(tmp_path, OWN, names=("left", "right"))
    adapter.feedback("1", "good")
    assert adapter.agent.heard == [("good", 1)]
    (tmp_path / "other").mkdir()
    other = joint_adapter(
        tmp_path / "other", OWN.replace("word, player", "word", 1).replace("(word, player)", "word"), names=("a",)
    )
    other.feedback("0", "bad")
    assert other.agent.heard == ["bad"]


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("return {0: self.n, 1: -self.n}", "return {0: self.n, 7: 0}", "step() returned something of '7'; the players are 0, 1"),
        ("{0: 1.5, 1: -1}", "{0: 1.5, 'player_1': -1}", "step() returned something of 'player_1'; the players are 0, 1"),
        ("{0: 1.5, 1: -1}", "{0: 'much'}", "step() returned a reward of 0 that is no number: str"),
        ("{0: 1.5, 1: -1}", "{0: 1, 1: float('nan')}", "step() returned a reward of 1 that is not finite"),
        ("{0: 1.5, 1: -1}", "1.5", "step() must return (observations, rewards, terminations, truncations, infos), each of them by player; its rewards are float"),
        ("return {0: self.n, 1: -self.n}, {0: 1.5, 1: -1}, ", "return ", "step() must return (observations, rewards"),
        ("return {0: seed, 1: -seed}, {0: {}, 1: {\"hint\": 5}}", "return seed", "reset() must return observations by player, not int"),
        ("self.n += 1", "self.to_act = lambda: 'x'", "to_act() returned 'x'; the players are 0, 1"),
        ("{}, {}\n", "{}, {0: {'action_mask': [1, 0, 1]}}\n", "action_mask of 0 has 3 values; there are 2 actions"),
    ],
)  # fmt: skip
def test_a_result_that_breaks_the_contract_gets_a_sentence(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in OWN
    adapter = joint_adapter(tmp_path, OWN.replace(old, new), names=("left", "right"))
    with pytest.raises(AgentError) as refused:
        begin_and_step(adapter)
    assert str(refused.value).startswith(said)


def test_an_agent_may_say_who_is_to_act(tmp_path: Path) -> None:
    by_method = joint_adapter(
        tmp_path, OWN + "    def to_act(self):\n        return [self.n % 2]\n", names=("left", "right")
    )
    assert by_method.reset(1)[0].to_act == {"0"}
    assert by_method.step({"0": 1}).to_act == {"1"}
    (tmp_path / "other").mkdir()
    by_info = OWN.replace("{}, {}\n", "{}, {0: {'to_act': self.n % 2 == 0}, 1: {'to_act': self.n % 2 == 1}}\n")
    other = joint_adapter(tmp_path / "other", by_info, names=("left", "right"))
    other.reset(1)
    assert [sorted(other.step({}).to_act) for _ in range(2)] == [["1"], ["0"]]


def test_a_mask_may_be_in_the_info(tmp_path: Path) -> None:
    source = OWN.replace(
        "{}, {}\n", "{}, {0: {'action_mask': numpy.array([0, 1], numpy.int8)}, 1: {'action_mask': [0, 0]}}\n"
    )
    adapter = joint_adapter(tmp_path, source, names=("left", "right"))
    adapter.reset(1)
    assert adapter.step({}).masks == {"0": (False, True)}


def test_trial_players_names_the_players_if_neither_agent_nor_environment_does(tmp_path: Path) -> None:
    """Where neither agent nor environment say who plays, `trial.players` does."""
    source = OWN.replace("possible_agents = [0, 1]", "")
    adapter = joint_adapter(
        tmp_path, source.replace("0:", "'a':").replace("1:", "'b':"), names=("x",), players=("a", "b")
    )
    assert adapter.players == ("a", "b")


# ---- who gets which adapter


def test_a_gymnasium_environment_has_one_player(tmp_path: Path) -> None:
    assert type(start_agent(tmp_path, game="CartPole-v1")) is AgentAdapter
    assert type(start_agent(tmp_path, game="CartPole-v1", players=("player_0",))) is AgentAdapter


SINGLE = """
class Agent:
    def start(self, game):
        from pettingzoo.classic import rps_v2
        self.env = rps_v2.parallel_env(render_mode="rgb_array")
        return self.env
    def step(self, action):
        return 0, 0, False, False, {}
    def reset(self, seed=None):
        return 0, {}
    def render(self):
        return self.env.render()
    def close(self):
        self.env.close()
"""


def test_a_class_with_a_step_of_its_own_may_play_the_others_itself(tmp_path: Path) -> None:
    """As before environments had several players, unless `trial.players` says otherwise."""
    adapter = start_agent(tmp_path, SINGLE, names=("rock", "paper", "scissors"))
    assert type(adapter) is AgentAdapter
    adapter.reset(1)
    assert adapter.step(1).reward == 0
    assert isinstance(start_agent(tmp_path, SINGLE, players=("player_0", "player_1")), JointAdapter)


def test_a_class_may_leave_methods_to_a_gymnasium_environment_too(tmp_path: Path) -> None:
    source = "class Agent:\n    def start(self, game):\n        import gymnasium\n        return gymnasium.make(game, render_mode='rgb_array')\n"
    adapter = start_agent(tmp_path, source, game="CartPole-v1")
    assert type(adapter) is AgentAdapter
    assert adapter.action_space == ("0", "1")
    _, _, seeded = adapter.reset(3)
    assert (seeded, adapter.step(1).reward, adapter.render().shape) == (True, 1.0, (400, 600, 3))
    adapter.close()


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("class Agent:\n    def start(self, game):\n        pass\n", "Agent in agent.py has no step, render, reset, close"),
        ("class Agent:\n    def start(self, game):\n        return {}\n", "Agent in agent.py has no step, render, reset, close, and neither has what start() returned (dict)"),
        ("class Agent:\n    def start(self, game):\n        return 1\n    def rendr(self):\n        pass\n", "Agent in agent.py has no render; is rendr meant to be render?"),
    ],
)  # fmt: skip
def test_missing_methods_are_named(tmp_path: Path, source: str, said: str) -> None:
    with pytest.raises(AgentError) as refused:
        start_agent(tmp_path, source)
    assert str(refused.value) == said


def test_names_of_actions_come_from_config_as_far_as_a_player_has_actions(tmp_path: Path) -> None:
    adapter = joint_adapter(tmp_path, game=PONG, names=("stay", "up"))
    assert adapter.action_spaces["paddle_0"] == ("stay", "up", "2")
    assert joint_adapter(tmp_path, game=PONG, names=("a", "b", "c", "d")).action_spaces["paddle_1"] == ("a", "b", "c")


def test_without_names_of_actions_the_error_asks_for_action_space(tmp_path: Path) -> None:
    with pytest.raises(AgentError, match=r"list the game's actions as trial\.actionSpace in config\.yml"):
        start_agent(tmp_path, OWN)


def test_numbers_of_actions_begin_where_the_players_space_begins(tmp_path: Path) -> None:
    source = """
from gymnasium.spaces import Box, Discrete
class Env:
    possible_agents = agents = ["a"]
    def action_space(self, player): return Discrete(3, start=-1)
    def observation_space(self, player): return Box(0, 1, (2,))
    def reset(self, seed=None, options=None): return {"a": 0}, {"a": {}}
    def step(self, actions):
        self.taken = actions
        return {"a": 0}, {"a": 0}, {"a": False}, {"a": False}, {"a": {}}
    def render(self): pass
    def close(self): pass
class Agent:
    def start(self, game): return Env()
"""
    adapter = joint_adapter(tmp_path, source)
    adapter.reset(1)
    adapter.step({"a": 2})
    assert adapter.env.taken == {"a": 1}


NEW_IN_EACH_EPISODE = """
import numpy
{imported}
class Agent:
    def start(self, game):
        self.env = {made}
    def reset(self, seed=None):
        self.env = {made}
        self.env.reset(seed=seed)
        return dict.fromkeys(self.env.possible_agents, 0), {{}}
    def step(self, actions):
{step}
    def render(self):
        return numpy.zeros((2, 2, 3), numpy.uint8)
    def close(self):
        pass
"""

PARALLEL = """
class Env:
    possible_agents = ["a", "b"]
    def __init__(self):
        self.agents = []
    def reset(self, seed=None):
        self.agents = list(self.possible_agents)
    def step(self, actions):
        self.agents = ["a"]
        return {}, {}, {}, {}, {}
"""


def test_the_players_in_the_game_are_those_of_the_environment_that_reset_has_made(tmp_path: Path) -> None:
    source = NEW_IN_EACH_EPISODE.format(imported=PARALLEL, made="Env()", step="        return self.env.step(actions)")
    adapter = joint_adapter(tmp_path, source, names=("left", "right"), players=("a", "b"))
    for seed in (1, 2):
        assert adapter.reset(seed)[0].to_act == {"a", "b"}
        step = adapter.step({})
        assert (step.over, step.to_act) == (False, {"a"})


def test_agents_that_are_no_names_of_players_do_not_end_the_episode(tmp_path: Path) -> None:
    imported = PARALLEL.replace('self.agents = ["a"]', "self.agents = [object(), object()]")
    source = NEW_IN_EACH_EPISODE.format(imported=imported, made="Env()", step="        return self.env.step(actions)")
    adapter = joint_adapter(tmp_path, source, names=("left", "right"), players=("a", "b"))
    assert not begin_and_step(adapter).over


def test_the_turn_is_that_of_the_environment_that_reset_has_made(tmp_path: Path) -> None:
    source = NEW_IN_EACH_EPISODE.format(
        imported="from pettingzoo.classic import tictactoe_v3",
        made="tictactoe_v3.raw_env()",
        step="        self.env.step(actions[self.env.agent_selection])\n        return {}, {}, {}, {}, {}",
    )
    names = tuple(map(str, range(9)))
    adapter = joint_adapter(tmp_path, source, names=names, players=("player_1", "player_2"))
    assert adapter.reset(1)[0].to_act == {"player_1"}
    assert adapter.step({"player_1": 3}).to_act == {"player_2"}


DICT_SPACES = """
import numpy
from gymnasium import spaces

class Fields:
    possible_agents = ["left", "right"]
    action_space = spaces.Dict({"left": spaces.Discrete(2), "right": spaces.Discrete(3)})
    observation_space = spaces.Dict({"left": spaces.Box(0, 1, (4,)), "right": spaces.Box(0, 1, (5,))})
    def reset(self, seed=None):
        return {"left": 0, "right": 0}, {}
    def step(self, actions):
        return {}, {}, {"__all__": True}, {}, {}
    def render(self):
        return numpy.zeros((2, 2, 3), numpy.uint8)
    def close(self):
        pass

class Agent:
    def start(self, game):
        return Fields()
"""


def test_spaces_may_be_one_dictionary_space_for_all_players(tmp_path: Path) -> None:
    adapter = joint_adapter(tmp_path, DICT_SPACES)
    assert adapter.action_spaces == {"left": ("0", "1"), "right": ("0", "1", "2")}
    assert adapter.observation_spaces["right"].shape == (5,)


# ---- whatever is returned

PART = st.one_of(
    st.none(),
    st.booleans(),
    st.floats(),
    st.text(max_size=3),
    st.lists(st.integers(-1, 2), max_size=3),
    st.builds(np.zeros, st.integers(0, 3)),
    st.dictionaries(
        st.sampled_from(["to_act", "action_mask", "a"]), st.lists(st.integers(0, 1), max_size=3), max_size=2
    ),
)
BY_PLAYER = st.fixed_dictionaries({}, optional={0: PART, 1: PART, "__all__": PART})
PARTS = st.one_of(BY_PLAYER, PART, st.dictionaries(st.sampled_from(["0", "x", None]), PART, max_size=3))
NUMBERS = st.fixed_dictionaries({}, optional={0: st.integers(-9, 9), 1: st.none()})
RETURNED_BY_STEP = st.one_of(
    st.tuples(BY_PLAYER, NUMBERS, BY_PLAYER, BY_PLAYER, BY_PLAYER),
    st.lists(PARTS, min_size=3, max_size=6),
    st.dictionaries(st.sampled_from(["observation", "rewards", "done", "truncated", "infos", "more"]), PARTS),
    PART,
)


@given(results=st.lists(RETURNED_BY_STEP, max_size=4))
def test_whatever_step_returns_is_read_or_refused_with_a_sentence(results: list[Any]) -> None:
    class Returning:
        possible_agents = (0, 1)

        def start(self, _game: str) -> None: ...

        def reset(self) -> Any:
            return {0: 0, 1: 0}, {}

        def step(self, _actions: Any) -> Any:
            return self.result

        def render(self) -> None: ...

        def close(self) -> None: ...

    agent = Returning()
    adapter = AgentAdapter(Path("/nowhere"), "none", ("left", "right"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hippodrome.trial.agent.agent.load", lambda _folder, **_how: agent)
        found = start(adapter)
    assert isinstance(found, JointAdapter)
    now, _ = found.reset(1)
    for result in results:
        agent.result = result
        if now.over:
            return
        try:
            now = found.step(dict.fromkeys(now.to_act, 0))
        except AgentError as error:
            assert str(error).strip()
            continue
        assert set(now.rewards) == set(now.terminated) == set(now.truncated) == {"0", "1"}
        assert now.to_act <= {"0", "1"}
        assert all(len(mask) == 2 and any(mask) for mask in now.masks.values())
        assert now.over == all(now.terminated[name] or now.truncated[name] for name in ("0", "1"))
        assert not (now.over and now.to_act)


def test_a_snapshot_of_an_observation_keeps_its_values() -> None:
    seen = {"grid": np.zeros(2), "order": (1, [2])}
    kept = snapshot(seen)
    seen["grid"][0] = 5
    assert kept["grid"].tolist() == [0, 0]
    assert kept["order"] == (1, [2])
