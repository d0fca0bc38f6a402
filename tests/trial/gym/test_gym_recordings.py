"""`--record FOLDER`: the recordings, and the datasets that `make data` makes of them."""

from __future__ import annotations

import re
import shlex
import time
from pathlib import Path
from typing import Any

import gymnasium
import minari
import numpy as np
import psutil
import pytest

from hippodrome.cli import main
from hippodrome.console.problem import Exit
from hippodrome.trial.gym.recordings import ConnectionRecorder
from hippodrome.trial.recordings import recording
from testing.gym_server import ROOT, TextClient, gym_server
from testing.waiting import until

HERE = Path(__file__).parent
ODD = ("--import", "odd_environments")


def recordings_in(folder: Path) -> list[list[dict[str, Any]]]:
    return [recording.read(file.read_bytes()) for file in sorted(folder.glob("gym/users/*/trials/*/*.jsonl.gz"))]


def test_recorded_episodes_load_in_minari(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with gym_server("--record", str(tmp_path / "data")) as server, TextClient(server.url + "?form=gymnasium") as client:
        made = client.make("CartPole-v1", seed=5)
        first, _ = client.ask("reset", instance_id=made)
        observations, rewards, terminated, *_ = client.ask("step_many", instance_id=made, actions=[1] * 30)
        client.ask("close", instance_id=made)
    out = tmp_path / "out"
    formats = ("--format", "csv,parquet,minari", "--json")
    assert main(["data", "gym", "--to", str(out), "--from", str(tmp_path / "data"), *formats]) == Exit.DONE
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(out / "minari"))
    dataset = minari.load_dataset("gym-CartPole-v1-v0")
    episode = dataset[0]
    length = terminated.index(True) + 1
    assert dataset.total_episodes >= 2
    assert episode.rewards.tolist() == rewards[:length]
    assert episode.actions.tolist() == [1] * length
    assert episode.observations.dtype == np.float32
    assert episode.observations.tolist() == [first, *observations[:length]]
    assert episode.terminations.tolist() == [False] * (length - 1) + [True]


def test_an_environment_without_whole_numbers_as_actions_is_not_named_as_a_dataset(tmp_path: Path, capsys: Any) -> None:
    with gym_server("--record", str(tmp_path / "data")) as server, TextClient(server.url + "?form=gymnasium") as client:
        made = client.make("Pendulum-v1", seed=5)
        client.ask("reset", instance_id=made)
        client.ask("step_many", instance_id=made, actions=[[0.5]] * 200)
        client.ask("close", instance_id=made)
    command = [
        "data",
        "gym",
        "--to",
        str(tmp_path / "out"),
        "--from",
        str(tmp_path / "data"),
        "--format",
        "minari",
    ]
    assert main(command) == Exit.DONE
    said = capsys.readouterr().err
    assert "gym-Pendulum-v1-v0: 1 episodes were left out" in said
    assert "MINARI_DATASETS_PATH" not in said


def test_the_command_of_the_documentation_converts_the_recordings() -> None:
    (command,) = re.findall(r"^hippodrome data .*$", (ROOT / "docs/gym.md").read_text(), re.M)
    assert shlex.split(command)[2:] == ["gym", "--from", "recordings", "--format", "parquet,minari"]


def test_each_environment_of_a_connection_is_recorded(tmp_path: Path) -> None:
    with (
        gym_server("--record", str(tmp_path), *ODD, cwd=HERE) as server,
        TextClient(server.url + "?form=gymnasium") as client,
    ):
        for action in ([0.5, 0], [1, 0]):
            made = client.make("Odd/Continuous-v0")
            client.ask("reset", instance_id=made)
            client.ask("step", instance_id=made, action=action)
            client.ask("close", instance_id=made)
    files = recordings_in(tmp_path)
    assert [[line["kind"] for line in lines] for lines in files] == [["header", "reset", "step", "end"]] * 2
    assert sorted(lines[2]["action"] for lines in files) == [[0.5, 0], [1, 0]]
    assert {lines[3]["why"] for lines in files} == {"closed"}


def test_an_environment_of_gyms_old_kind_is_recorded(tmp_path: Path) -> None:
    with (
        gym_server("--record", str(tmp_path), *ODD, cwd=HERE) as server,
        TextClient(server.url) as client,
    ):
        made = client.make("Odd/Old-v0")
        client.ask("reset", instance_id=made)
        for _ in range(5):
            client.ask("step", instance_id=made, action=2)
        client.ask("close", instance_id=made)
    ((*_, last, end),) = recordings_in(tmp_path)
    assert (last["terminated"], end["why"], end["steps"], end["score"]) == (True, "terminated", 5, 15.0)


def test_a_reward_may_be_an_array_of_one_number(tmp_path: Path) -> None:
    class Env(gymnasium.Env[Any, Any]):
        action_space = observation_space = gymnasium.spaces.Discrete(2)

        def reset(self, **_: Any) -> Any:
            return 0, {}

        def step(self, action: Any) -> Any:
            return 0, np.array([2.5]), True, False, {}

    env = ConnectionRecorder(tmp_path).record(Env(), "Env-v0", None)
    env.reset()
    assert env.step(1)[1] == np.array([2.5])
    env.close()
    ((*_, step, end),) = recordings_in(tmp_path)
    assert (step["reward"], end["score"]) == (2.5, 2.5)


def test_a_recording_is_whole_after_the_client_leaves_and_lacks_a_second_after_a_kill(tmp_path: Path) -> None:
    with gym_server("--record", str(tmp_path)) as server:
        with TextClient(server.url) as client:
            made = client.make("CartPole-v1")
            client.ask("reset", instance_id=made)
            client.ask("step", instance_id=made, action=1)
        worker = TextClient(server.url)
        made = worker.make("CartPole-v1")
        worker.ask("reset", instance_id=made)
        time.sleep(1.1)
        worker.ask("step", instance_id=made, action=1)
        until(lambda: len(psutil.Process(server.pid).children()) == 1)  # the first client's has ended
        psutil.Process(server.pid).children()[0].kill()
        worker.websocket.socket.close()
    kinds = [[line["kind"] for line in lines] for lines in recordings_in(tmp_path)]
    assert sorted(kinds) == [["header", "reset", "step"], ["header", "reset", "step", "end"]]


def test_a_folder_that_cannot_be_written_is_reported(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with (
        gym_server("--record", str(tmp_path / "file")) as server,
        TextClient(server.url + "?form=gymnasium") as client,
    ):
        said = client.ask("make", env_id="CartPole-v1")
        assert said["error"]["message"] == "The recording cannot be written: Not a directory."
