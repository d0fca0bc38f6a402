"""examples/overcooked: its environment, how it is drawn, and whether its policy cooks, alone and with others."""

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

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "overcooked"
STEPS = 300
"""Steps of a round in these tests: half a minute."""


Chef = Callable[[Any, int, Any], int]
"""A function that chooses an action by the kitchen's state, the chef's number and the chef's observation."""


@pytest.fixture
def kitchen(load_module: Callable[[str, str], ModuleType]) -> Any:
    return load_module("overcooked", "kitchen")


@pytest.fixture
def cook(load_module: Callable[[str, str], ModuleType]) -> Any:
    return load_module("overcooked", "cook")


@pytest.fixture
def policy() -> Chef:
    session = onnx_files.session(EXAMPLE / "policies" / "cook.onnx")
    return lambda _, __, seen: int(session.run(None, {"observation": seen[None]})[0][0].argmax())


def random_chef(seed: int) -> Chef:
    chance = np.random.default_rng(seed)
    return lambda *_: int(chance.integers(6))


def soups(env: Any, chefs: tuple[Chef, Chef], seed: int) -> int:
    """Play a round; return how many soups the chefs delivered."""
    observations, _ = env.reset(seed=seed)
    while env.agents:
        stands = env.kitchen()
        observations, *_ = env.step({number: chefs[number](stands, number, observations[number]) for number in (0, 1)})
    return int(env.soups)


def test_the_environment_keeps_the_rules_of_pettingzoo(kitchen: Any) -> None:
    from pettingzoo.test import parallel_api_test

    parallel_api_test(kitchen.Overcooked(max_steps=60), num_cycles=100)


def test_the_same_seed_and_actions_give_the_same_round(kitchen: Any) -> None:
    env = kitchen.Overcooked(max_steps=80)
    ends = [(soups(env, (random_chef(1), random_chef(2)), seed), env.kitchen()) for seed in (3, 3, 4)]
    assert ends[0] == ends[1] != ends[2]


def test_rounds_without_a_seed_differ(kitchen: Any) -> None:
    """The package itself would take the same seed each time."""
    env = kitchen.Overcooked(max_steps=10)
    places = set()
    for _ in range(20):
        env.reset()
        places.add(tuple((chef.cell, chef.facing) for chef in env.kitchen().chefs))
    assert len(places) > 1


def test_one_chef_alone_delivers_a_soup(kitchen: Any, cook: Any) -> None:
    """From the first onion to the hatch: the state of the kitchen and the rewards show it, and both chefs get the rewards."""
    env = kitchen.Overcooked(max_steps=STEPS)
    env.reset(seed=0)
    while env.kitchen().chefs[1].cell == (1, 2):  # who stands there keeps chef 0 from the pot
        env.step({0: kitchen.NOOP, 1: kitchen.LEFT})
    earned: list[float] = []
    held: list[str | None] = []
    while env.soups == 0:
        _, rewards, *_ = env.step({0: cook.act(env.kitchen(), 0), 1: kitchen.NOOP})
        assert rewards[0] == rewards[1]
        earned += [rewards[0]] if rewards[0] else []
        holds = env.kitchen().chefs[0].holds
        if not held or held[-1] != holds:
            held.append(holds)
    assert earned == [3, 3, 3, 5, 20]
    assert held == [None, *["onion", None] * 3, "plate", "onion_soup", None]


def test_a_round_ends_after_its_steps(kitchen: Any) -> None:
    env = kitchen.Overcooked(max_steps=5)
    env.reset(seed=1)
    ends = [env.step({0: kitchen.NOOP, 1: kitchen.NOOP})[3] for _ in range(5)]
    assert ends == [{0: False, 1: False}] * 4 + [{0: True, 1: True}]
    assert env.steps_left == 0
    assert env.agents == []


@pytest.mark.parametrize("number", [0, 1])
def test_the_policy_cooks_with_a_partner_who_stands_still(kitchen: Any, policy: Chef, number: int) -> None:
    """A chef who acts at random in its place delivers nothing."""
    env = kitchen.Overcooked(max_steps=STEPS)
    seed = next(seed for seed in range(50) if leaves_all_reachable(env, seed, 1 - number))
    for chef, wanted in ((policy, range(4, 8)), (random_chef(1), range(1))):
        pair = (chef, idle) if number == 0 else (idle, chef)
        assert soups(env, pair, seed) in wanted


def idle(*_: Any) -> int:
    return 5


def leaves_all_reachable(env: Any, seed: int, number: int) -> bool:
    """Return whether pot, plates and hatch stay reachable.

    Each is reached from one place, and the chef begins on none of them.
    """
    env.reset(seed=seed)
    return env.kitchen().chefs[number].cell not in {(1, 2), (2, 1), (2, 3)}


def test_the_policy_cooks_with_the_cook_by_rules_and_with_itself(kitchen: Any, cook: Any, policy: Chef) -> None:
    env = kitchen.Overcooked(max_steps=STEPS)
    assert soups(env, (lambda stands, chef, _: cook.act(stands, chef), policy), seed=1) >= 5
    assert soups(env, (policy, policy), seed=2) >= 5


def test_the_policy_cooks_with_a_partner_who_acts_at_random(kitchen: Any, policy: Chef) -> None:
    assert soups(kitchen.Overcooked(max_steps=STEPS), (random_chef(1), policy), seed=1) >= 2


def test_the_policy_is_small_and_says_how_it_was_made() -> None:
    import onnx

    file = EXAMPLE / "policies" / "cook.onnx"
    assert file.stat().st_size < 200_000
    assert onnx.load(file).doc_string.startswith("train.py --rounds")


def test_a_short_training_already_learns(tmp_path: Path) -> None:
    """After one round, most actions are those of the cook by rules."""
    said = subprocess.run(
        [sys.executable, "-W", "ignore", "train.py", "--rounds", "1", "--steps", "150", "--into", tmp_path / "made"],
        cwd=EXAMPLE,
        capture_output=True,
        text=True,
        check=True,
    ).stdout
    assert float(said.partition("round 1: ")[2].partition("%")[0]) >= 80, said
    assert (tmp_path / "made" / "cook.onnx").is_file()


@pytest.fixture
def agent(load_module: Callable[[str, str], ModuleType]) -> Any:
    made = load_module("overcooked", "agent").Agent()
    made.start("overcooked")
    return made


def test_the_scene_has_no_problems_and_the_atlas_has_all_its_frames(agent: Any, cook: Any) -> None:
    frames = set(frames_of_atlas(EXAMPLE / "assets" / "kitchen.json"))
    agent.env.reset(seed=1)
    scene, shown = as_scene(agent.render("0")), set()
    for _ in range(200):
        assert scene.problems == ()
        shown |= {each["frame"] for each in scene.objects.values() if each["type"] == "sprite"}
        stands = agent.env.kitchen()
        agent.env.step({number: cook.act(stands, number) for number in (0, 1)})
        scene = as_scene(agent.render("0"), scene)
    assert images_of(scene) == {"kitchen"}
    assert shown <= frames
    assert {"pot-0", "pot-1", "pot-2", "pot-3", "pot-ready", "onion", "plate", "onion_soup", "chef-blue-up"} <= shown
    assert scene.permanent == {name for name in scene.objects if name.startswith(("floor", "table"))}


def frames_of_atlas(file: Path) -> dict[str, Any]:
    import json

    return dict(json.loads(file.read_text())["frames"])


def test_every_frame_lies_in_the_atlas() -> None:
    wide, high = Image.open(EXAMPLE / "assets" / "kitchen.png").size
    for name, entry in frames_of_atlas(EXAMPLE / "assets" / "kitchen.json").items():
        frame = entry["frame"]
        assert 0 <= frame["x"] <= wide - frame["w"], name
        assert 0 <= frame["y"] <= high - frame["h"], name


def test_config_yml_fits_the_kitchen(agent: Any, load_module: Callable[[str, str], ModuleType]) -> None:
    import yaml

    section = yaml.safe_load((EXAMPLE / "config.yml").read_text())["trial"]
    agent.env.reset(seed=1)
    rows, columns = agent.env.kitchen().size
    tile = load_module("overcooked", "agent").TILE
    assert (section["scene"]["width"], section["scene"]["height"]) == (columns * tile, rows * tile)
    assert section["startingFrameRate"] == load_module("overcooked", "agent").STEPS_PER_SECOND
    assert section["actionSpace"] == list(load_module("overcooked", "kitchen").ACTIONS)


@pytest.mark.parametrize(
    ("plays", "said"),
    [
        ({"0": "human", "1": "policies/cook.onnx"}, ["Soups", "Soups"]),
        ({"0": "human", "1": "human"}, ["You are blue", "You are green"]),
    ],
)
def test_two_people_read_their_colours_above_the_game(
    load_module: Any, monkeypatch: pytest.MonkeyPatch, plays: dict[str, str], said: list[str]
) -> None:
    monkeypatch.setenv("TRIAL", json.dumps({"players": plays}))
    agent = load_module("overcooked", "agent").Agent()
    agent.start("overcooked").reset(seed=1)
    assert [agent.render(player)["hud"].partition(": ")[0].partition(" · ")[0] for player in ("0", "1")] == said
