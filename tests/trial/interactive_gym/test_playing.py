"""An experiment on a participant's server: its environment, objects, policies and callback; and its run to the end."""

from __future__ import annotations

import asyncio
import contextlib
import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path
from typing import Any

import pytest
import yaml

from hippodrome.trial.interactive_gym import playing
from hippodrome.trial.interactive_gym.options import RemoteConfig, Unplayable
from hippodrome.trial.interactive_gym.playing import RemoteGame
from tests.trial.client_messages import play_to_the_end
from tests.trial.interactive_gym.experiments import ALONE, HELPER, PEOPLE, RUN, TOGETHER, run_experiment
from tests.trial.sessions import SID, answer, form, member, recordings

ROOT = Path(__file__).resolve().parents[3]


def make_project(folder: Path, source: str) -> Path:
    """Run the experiment; return the folder of the project that it makes."""
    folder.mkdir()
    (folder / "experiment.py").write_text(source + RUN)
    (folder / "helper.py").write_text(HELPER)
    (folder / "how.html").write_text("<h1>How</h1>")
    (folder / "brains").mkdir()
    (folder / "brains/two.txt").write_text("2")
    done = run_experiment(folder)
    assert done.returncode == 0, done.stderr
    return folder / "experiment-study"


async def play_project(launch: Any, open_client: Any, made: Path, trial: dict[str, Any]) -> Any:
    """Play the project's game to its end on a server; return the server."""
    section = {"startingFrameRate": 60, "maxFrameRate": 60, "callbackSeconds": 10, **trial}
    server = launch(None, section, AGENT_DIR=str(made))

    await play_to_the_end(server, open_client)
    assert server.wait() == 0, server.log_text()
    return server


SCENE = {"width": 600, "height": 400}


async def test_an_experiment_is_played_and_its_callback_records(tmp_path: Path, launch: Any, open_client: Any) -> None:
    made = make_project(tmp_path / "mine", ALONE)
    trial = {"actionSpace": ["left", "noop", "right"], "idleAction": "noop", "maxEpisodes": 2, "scene": SCENE}
    server = await play_project(launch, open_client, made, trial)
    first, second = server.recordings().values()
    for found in (first, second):
        values = [(line["step"], line["name"], line["value"]) for line in found if line["kind"] == "callback"]
        assert values == [
            *((step, "rewards", [{"human": 1}, {"reward": -1.0}]) for step in range(1, 21)),
            (20, "on_episode_end", {"ticks": 20, "before": 20, "score": -20.0}),
        ]


async def test_a_policy_plays_the_other_player(tmp_path: Path, launch: Any, open_client: Any) -> None:
    made = make_project(tmp_path / "mine", TOGETHER)
    trial = {
        "actionSpace": ["0", "1", "2"],
        "players": {"0": "human", "1": "agent:Policy1"},
        "maxEpisodes": 1,
        "input": "single",
        "scene": SCENE,
    }
    server = await play_project(launch, open_client, made, trial)
    (found,) = server.recordings().values()
    assert found[0]["players"]["1"]["policy"] == "agent:Policy1"
    steps = [line for line in found if line["kind"] == "step"]
    assert len(steps) == 10
    assert {line["players"]["1"]["action"] for line in steps if line["players"]["1"]["by"] == "policy"} == {2}
    told = [line["value"] for line in found if line["kind"] == "callback"]
    assert told == [
        [
            step["step"],
            {"0": step["players"]["0"]["action"], "1": step["players"]["1"]["action"]},
            {"1": "brains/two.txt"},
        ]
        for step in steps
    ]


async def test_by_interactive_gyms_defaults_a_policy_acts_in_one_step_of_four(
    tmp_path: Path, launch: Any, open_client: Any
) -> None:
    """In the other steps, its player takes `default_action`, as in Interactive Gym."""
    single = ",\n              input_mode=configuration_constants.InputModes.SingleKeystroke"
    source = (
        TOGETHER.replace("        frame_skip=1,\n", "").replace(single, "").replace("max_steps = 10", "max_steps = 40")
    )
    made = make_project(tmp_path / "mine", source)
    trial = yaml.safe_load((made / "config.yml").read_text())["trial"]
    assert (trial["frameSkip"], trial["idleAction"], trial.get("input", "held")) == (4, "0", "held")
    server = await play_project(launch, open_client, made, trial)
    (found,) = server.recordings().values()
    taken = [line["value"][1]["1"] for line in found if line["kind"] == "callback"]
    assert (taken.count(2), taken.count(0)) == (10, 30)


async def test_two_people_play_an_experiment(tmp_path: Path, launch: Any, open_client: Any) -> None:
    made = make_project(tmp_path / "mine", PEOPLE)
    told = yaml.safe_load((made / "config.yml").read_text())["trial"]
    told |= {"instructions": None, "countdown": 0, "callbackSeconds": 10}
    members = {"SESSION": SID, "USER_ID": "", "SERVER": "pair-1", "ASSIGNMENT_SECONDS": "60"}
    server = launch(
        None, {key: value for key, value in told.items() if value is not None}, AGENT_DIR=str(made), **members
    )
    form(server.store)
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await anna.say(key="ArrowUp", held=True)
        await asyncio.gather(*(each.until(lambda each=each: each.done) for each in (anna, bert)))
    assert server.wait() == 0, server.log_text()
    assert [answer(server.store, name)["answers"]["outcome"] for name in ("anna", "bert")] == ["finished"] * 2
    (found,) = recordings(server.store).values()
    steps = [line for line in found if line["kind"] == "step"]
    assert len(steps) == 10
    assert {line["players"]["1"]["by"] for line in steps} == {"none"}
    told = [line["value"] for line in found if line["kind"] == "callback" and line["name"] == "tick"]
    assert [value[2] for value in told] == [{}] * 10, "no player is a bot"


def test_in_a_game_of_several_people_a_humans_id_is_the_name_of_their_player(monkeypatch: pytest.MonkeyPatch) -> None:
    """The agent's code sees no id of a participant there."""
    monkeypatch.delenv("USER_ID", raising=False)

    class Env:
        def reset(self, seed: int | None = None) -> Any:
            return {0: 1, 1: 1}, {}

    config = RemoteConfig().environment(env_creator=lambda **_: Env())
    agent = playing.ExperimentAgent(config.policies(policy_mapping={0: "human", 1: "human", 2: "random"}))
    agent.start()
    agent.reset(1)
    assert agent.game is not None
    assert agent.game.human_players == {0: "0", 1: "1"}


def test_running_the_experiments_file_runs_its_study_until_ctrl_c(tmp_path: Path) -> None:
    folder = tmp_path / "mine"
    make_project(folder, ALONE)
    (folder / "experiment.py").write_text(ALONE + RUN)
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    running = subprocess.Popen(
        [sys.executable, "-m", "hippodrome.trial.interactive_gym", "experiment.py"],
        cwd=folder,
        env=env,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert running.stdout is not None
    try:
        link = None
        for line in running.stdout:
            found = re.search(r"http://\S+", line)
            if found:
                link = found[0]
                break
        assert link is not None
        with urllib.request.urlopen(link, timeout=20) as page:
            assert "Mountain car" in page.read().decode()
        os.killpg(running.pid, signal.SIGINT)
        assert running.wait(60) == 0
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(running.pid, signal.SIGKILL)
        running.stdout.close()
    with pytest.raises(OSError, match=r".*"):
        urllib.request.urlopen(link, timeout=5)


# ---- its parts


class Env:
    def __init__(self, **given: Any) -> None:
        self.given = given

    action_space = None

    def reset(self, seed: int | None = None) -> Any:
        return {"a": 0, "b": 0}, {}

    def step(self, actions: Any) -> Any:
        return {}, {"a": 1, "b": -2}, {"__all__": False}, {"__all__": False}, {}


def test_the_game_counts_rewards_ticks_and_episodes_as_interactive_gym() -> None:
    config = RemoteConfig().gameplay(num_episodes=2)
    game = RemoteGame(config, Env(), {"a": "human", "b": "model"}, "P1")
    assert (game.human_players, game.bot_players, game.status) == ({"a": "P1"}, {"b": "model"}, "inactive")
    for episode in (1, 2):
        game.began({})
        assert (game.episode_num, game.tick_num, game.status) == (episode, 0, "active")
        game.stepped({"a": 0, "b": 1}, Env().step({}))
        game.stepped({"a": 0, "b": 1}, ({}, {"a": 3}, {"__all__": True}, {"__all__": False}, {}))
        assert dict(game.episode_rewards) == {"a": 4, "b": -2}
        assert (game.tick_num, game.prev_rewards, game.over) == (2, {"a": 3}, True)
        assert game.status == ("reset" if episode == 1 else "done")
    assert (dict(game.total_rewards), dict(game.total_positive_rewards), dict(game.total_negative_rewards)) == (
        {"a": 8, "b": -4}, {"a": 8, "b": 0}, {"a": 0, "b": -4},
    )  # fmt: skip


@pytest.mark.parametrize(
    ("terminated", "truncated", "over"),
    [
        ({"a": True, "b": False}, {"a": False, "b": True}, True),
        ({"a": True, "b": False, "__all__": False}, {"a": False, "b": True, "__all__": False}, True),
        ({"a": True, "b": False}, {"a": False, "b": False}, False),
        ({"__all__": True}, {"__all__": False}, True),
        ({}, {}, False),
    ],
)
def test_a_game_is_over_when_each_player_is_terminated_or_truncated(
    terminated: dict[str, bool], truncated: dict[str, bool], over: bool
) -> None:
    game = RemoteGame(RemoteConfig(), None, {"a": "human", "b": "model"})
    game.began({})
    game.stepped({"a": 0, "b": 0}, ({}, {"a": 0.0, "b": 0.0}, terminated, truncated, {}))
    assert game.over is over


def test_a_single_players_reward_is_a_number() -> None:
    game = RemoteGame(RemoteConfig(), None, {"human": "human"})
    game.began(0)
    game.stepped({"human": 1}, (0, 2.5, True, False, {}))
    assert (game.prev_rewards, game.episode_rewards[0], game.over) == ({"reward": 2.5}, 2.5, True)


def agent(**options: Any) -> playing.ExperimentAgent:
    config = RemoteConfig().policies(policy_mapping={"human": "human"})
    for name, value in options.items():
        setattr(config, name, value)
    made = playing.ExperimentAgent(config)
    made.start(None)
    made.reset(1)
    return made


def test_objects_of_the_beginning_are_drawn_once_and_stay() -> None:
    fence = {"uuid": "fence", "object_type": "circle"}
    made = agent(
        policy_mapping={"a": "human"},
        env_creator=Env,
        env_to_state_fn=lambda env, config: [{"uuid": "ball"}],
        state_init=[fence],
        hud_text_fn=lambda game: f"Episode {game.episode_num}",
    )
    assert made.render() == {"objects": [{**fence, "permanent": True}, {"uuid": "ball"}], "hud": "Episode 1"}
    assert made.render() == {"objects": [{"uuid": "ball"}], "hud": "Episode 1"}
    made.reset(2)
    assert len(made.render()["objects"]) == 2


def test_environments_are_made_as_interactive_gym_makes_them() -> None:
    assert agent(env_creator=Env, env_config={"size": 3})._raw.given == {"size": 3, "render_mode": "rgb_array"}
    code = "class Env:\n    def reset(self, seed=None): return 7, {}\nenv = Env()"
    made = agent(environment_initialization_code=code)
    assert made.reset(1) == (7, {})
    with pytest.raises(Unplayable, match="there is no environment"):
        agent(environment_initialization_code="x = 1")


@pytest.mark.parametrize(
    "value", ["actions['human']", "actions if actions in (0, 1) else 1 / int(actions)", "[4, 1][actions]"]
)
def test_an_environment_of_one_player_gets_a_map_of_actions_or_if_it_refuses_that_the_action(value: str) -> None:
    """Interactive Gym's Mountain Car takes a map; Gymnasium's environments take the action."""
    code = f"""
class Env:
    def reset(self, seed=None): return {{"human": 7}}, {{}}
    def step(self, actions): return {{"human": {value}}}, 2.5, False, {{"human": True}}, {{}}
env = Env()
"""
    made = agent(environment_initialization_code=code, policy_mapping={"human": "human"})
    assert made.reset(1) == (7, {})
    assert [made.step(1), made.step(1)] == [(1, 2.5, False, True, {})] * 2
    assert made.game is not None
    assert (made.game.prev_actions, made.game.over) == ({"human": 1}, True)


def test_an_error_of_an_environment_that_has_taken_a_step_is_its_own() -> None:
    class Env:
        def reset(self, seed: int | None = None) -> Any:
            self.steps = 0
            return 0, {}

        def step(self, actions: Any) -> Any:
            self.steps += 1
            return 0, {"": 0.0}["reward"] if self.steps > 1 else actions["human"], False, False, {}

    made = agent(env_creator=lambda **_: Env(), policy_mapping={"human": "human"})
    made.step(1)
    with pytest.raises(KeyError, match="reward"):
        made.step(1)
    assert made.game.env.steps == 2
