"""examples/slime-volleyball: its environment, how it is drawn, and whether its policies play well."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from PIL import Image

from hippodrome.trial.pictures.scene import as_scene, images_of
from testing import onnx_files

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "slime-volleyball"
LEFT, RIGHT = "agent_left", "agent_right"
NOOP, TO_LEFT, JUMP, TO_RIGHT = 0, 1, 3, 5


@pytest.fixture
def volleyball(load_module: Callable[[str, str], ModuleType]) -> Any:
    return load_module("slime-volleyball", "volleyball")


@pytest.fixture
def train(load_module: Callable[[str, str], ModuleType]) -> Any:
    return load_module("slime-volleyball", "train")


def match(env: Any, left: Callable[[Any], int], right: Callable[[Any], int], seed: int) -> dict[str, int]:
    """Play a whole match; return the points of both."""
    observations, _ = env.reset(seed=seed)
    while env.agents:
        observations, *_ = env.step({LEFT: left(observations[LEFT]), RIGHT: right(observations[RIGHT])})
    return dict(env.scores)


def random_player(seed: int) -> Callable[[Any], int]:
    chance = np.random.default_rng(seed)
    return lambda observation: int(chance.integers(6))


def test_the_environment_keeps_the_rules_of_pettingzoo(volleyball: Any) -> None:
    from pettingzoo.test import parallel_api_test

    parallel_api_test(volleyball.Volleyball(points=2, seconds=10), num_cycles=1000)


def test_the_same_seed_and_actions_give_the_same_match(volleyball: Any) -> None:
    env = volleyball.Volleyball(points=2, seconds=20)
    ends = [(match(env, random_player(1), random_player(2), seed), env.places()) for seed in (3, 3, 4)]
    assert ends[0] == ends[1] != ends[2]


def test_a_match_ends_with_the_last_point_or_the_time(volleyball: Any) -> None:
    env = volleyball.Volleyball(points=2, seconds=100)
    assert max(match(env, random_player(1), random_player(2), seed=1).values()) == 2
    short = volleyball.Volleyball(points=50, seconds=2)
    short.reset(seed=1)
    ends = [short.step({LEFT: NOOP, RIGHT: NOOP})[3] for _ in range(60)]
    assert ends[58] == {LEFT: False, RIGHT: False}
    assert ends[59] == {LEFT: True, RIGHT: True}


@pytest.mark.parametrize("player", [LEFT, RIGHT])
def test_an_action_moves_both_players_the_same_way_on_the_screen(volleyball: Any, player: str) -> None:
    env = volleyball.Volleyball()
    env.reset(seed=1)
    before = env.places()[player]
    for action, way in ((TO_LEFT, -1), (TO_RIGHT, 1)):
        env.reset(seed=1)
        env.step({LEFT: NOOP, RIGHT: NOOP, player: action})
        assert (env.places()[player][0] - before[0]) * way > 0
    env.step({LEFT: NOOP, RIGHT: NOOP, player: JUMP})
    assert env.places()[player][1] > before[1]


def test_both_see_the_game_from_their_own_side(volleyball: Any) -> None:
    observations, _ = volleyball.Volleyball().reset(seed=1)
    assert np.allclose(observations[LEFT][:4], observations[RIGHT][:4], atol=1e-6)
    assert observations[LEFT][6] == -observations[RIGHT][6], "what the ball flies away from one, it flies to the other"
    assert {each.dtype for each in observations.values()} == {np.dtype("float32")}


def share_of_points(train: Any, file: str, opponent: Any) -> float:
    """Return the share of all points that the policy on the right wins, in 200 games at once."""
    session = onnx_files.session(EXAMPLE / "policies" / file)
    games, won, lost = train.Games(200, np.random.default_rng(1)), 0, 0
    for _ in range(500):
        chosen = session.run(None, {"observation": games.observations(1)})[0].argmax(1)
        points = games.step(opponent(games.observations(0)), chosen)
        won, lost = won + int((points > 0).sum()), lost + int((points < 0).sum())
    assert won + lost > 500
    return won / (won + lost)


def test_the_policy_beats_a_random_player(train: Any) -> None:
    """Each serve falls on a random side, so two random players each win half of the points."""
    chance = np.random.default_rng(2)
    share = share_of_points(train, "right.onnx", lambda seen: chance.integers(6, size=len(seen)))
    assert share >= 0.62, share


def test_the_policy_is_about_as_strong_as_the_packages_opponent(train: Any) -> None:
    """A random player wins three points of ten against it."""
    share = share_of_points(train, "right.onnx", train.Teacher(200))
    assert share >= 0.42, share


def test_the_left_players_policy_mirrors_the_right_players(volleyball: Any) -> None:
    left, right = (onnx_files.session(EXAMPLE / "policies" / f"{side}.onnx") for side in ("left", "right"))
    seen = np.random.default_rng(1).normal(size=(50, 12)).astype(np.float32)
    mirrored = right.run(None, {"observation": seen})[0][:, volleyball.MIRRORED]
    assert np.allclose(left.run(None, {"observation": seen})[0], mirrored, atol=1e-5)


@pytest.mark.parametrize(("file", "player"), [("right.onnx", RIGHT), ("left.onnx", LEFT)])
def test_the_policy_returns_the_ball_in_the_environment(volleyball: Any, file: str, player: str) -> None:
    """It wins a third of the serves to its own half. A player who stands still loses nearly all of them."""
    session = onnx_files.session(EXAMPLE / "policies" / file)
    env, returned, served = volleyball.Volleyball(points=1, seconds=20), 0, 0
    for seed in range(24):
        observations, _ = env.reset(seed=seed)
        if observations[player][6] < 0.3:  # the serve goes to the other half
            continue
        served += 1
        while env.agents:
            chosen = int(session.run(None, {"observation": observations[player][None]})[0].argmax())
            observations, rewards, *_ = env.step({LEFT: NOOP, RIGHT: NOOP, player: chosen})
        returned += rewards[player] > 0
    assert served >= 8
    assert returned >= served / 3, (returned, served)


def test_policies_are_small_and_say_how_they_were_made() -> None:
    import onnx

    for name in ("left.onnx", "right.onnx"):
        file = EXAMPLE / "policies" / name
        assert file.stat().st_size < 200_000
        assert onnx.load(file).doc_string.startswith("train.py --rounds")


def test_training_plays_by_the_packages_own_rules(volleyball: Any, train: Any) -> None:
    """From the same serve, the games that are played as arrays go as in the environment."""
    env = volleyball.Volleyball(points=50, seconds=100)
    observations, _ = env.reset(seed=5)
    games = train.Games(3, np.random.default_rng(1))
    games._ball_speed[:] = np.array([observations[RIGHT][6:8]]).T * 10
    chance = np.random.default_rng(2)
    for _ in range(400):
        left, right = chance.integers(6, size=2)
        seen = games.observations(1)[0], games.observations(0)[0]
        assert np.allclose(seen[0], observations[RIGHT], atol=1e-3)
        assert np.allclose(seen[1], observations[LEFT], atol=1e-3)
        mirrored = volleyball.MIRRORED[left]  # the environment's actions are those of the screen
        reward = games.step(np.full(3, mirrored), np.full(3, right))[0]
        observations, rewards, *_ = env.step({LEFT: int(left), RIGHT: int(right)})
        assert reward == rewards[RIGHT]
        if reward:
            return
    pytest.fail("no point was scored")


def test_a_short_training_already_learns(tmp_path: Path) -> None:
    """After two rounds, the largest of the six values is the teacher's action three times in four."""
    said = subprocess.run(
        [sys.executable, "train.py", "--rounds", "2", "--into", tmp_path / "made"],
        cwd=EXAMPLE,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    share = int(said.partition("round 1: ")[2].partition("%")[0])
    assert share >= 60, said
    assert sorted(file.name for file in (tmp_path / "made").iterdir()) == ["left.onnx", "right.onnx"]


@pytest.fixture
def agent(load_module: Callable[[str, str], ModuleType]) -> Any:
    made = load_module("slime-volleyball", "agent").Agent()
    made.start("slime-volleyball")
    return made


def test_the_scene_has_no_problems_and_shows_players_net_court_and_ball(agent: Any) -> None:
    agent.env.reset(seed=1)
    scene = as_scene(agent.render(LEFT))
    chance = np.random.default_rng(1)
    for _ in range(300):
        assert scene.problems == ()
        assert {LEFT, RIGHT, "net", "court"} <= scene.objects.keys()
        assert "ball" in scene.objects or "above" in scene.objects
        if not agent.env.agents:
            break
        agent.env.step({LEFT: int(chance.integers(6)), RIGHT: int(chance.integers(6))})
        scene = as_scene(agent.render(LEFT), scene)
    assert all((EXAMPLE / "assets" / f"{image}.png").is_file() for image in images_of(scene))
    assert scene.permanent == {"court", "net", "net top"}


def test_the_scene_asks_ready_before_each_point_but_the_first(agent: Any) -> None:
    """Before the first point the page asks."""
    agent.env.reset(seed=1)
    scored = False
    while not scored:
        assert "serve" not in {each["id"] for each in agent.render(LEFT)["objects"]}
        scored = any(agent.env.step({LEFT: 0, RIGHT: 0})[1].values())
    assert "serve" in {each["id"] for each in agent.render(LEFT)["objects"]}


@pytest.mark.parametrize(
    ("right", "said"),
    [("policies/right.onnx", ["Red 0", "Red 0"]), ("human", ["You are red", "You are blue"])],
)
def test_two_people_read_their_colours_above_the_game(
    load_module: Any, monkeypatch: pytest.MonkeyPatch, right: str, said: list[str]
) -> None:
    monkeypatch.setenv("TRIAL", json.dumps({"players": {LEFT: "human", RIGHT: right}}))
    agent = load_module("slime-volleyball", "agent").Agent()
    agent.start("slime-volleyball").reset(seed=1)
    huds = [agent.render(player)["hud"] for player in (LEFT, RIGHT)]
    assert [hud.partition(" · ")[0].partition(" : ")[0] for hud in huds] == said


def test_the_picture_of_the_court_is_as_large_as_the_scene(load_module: Callable[[str, str], ModuleType]) -> None:
    agent, assets = load_module("slime-volleyball", "agent"), load_module("slime-volleyball", "make_assets")
    size = agent.WIDTH, agent.HEIGHT
    assert Image.open(EXAMPLE / "assets" / "court.png").size == size == (assets.WIDTH, assets.HEIGHT)
    assert agent.SAND == assets.GROUND


def test_the_picture_is_made_without_opencv() -> None:
    """`slimevb` brings it for its own drawing; a server has no libGL."""
    code = "import agent, sys; a = agent.Agent(); a.start(''); a.env.reset(); a.render('agent_left'); print('cv2' in sys.modules)"
    ran = subprocess.run([sys.executable, "-c", code], cwd=EXAMPLE, capture_output=True, text=True, check=True)
    assert ran.stdout == "False\n"
