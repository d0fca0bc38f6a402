"""A program that starts the server itself, with its own `get_env` and `process_step`, as Gymie's documentation has it."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

from hippodrome.cli import main
from hippodrome.trial.gym import override
from hippodrome.trial.gym.settings import Limits
from testing.gym_server import ROOT, GymServerProcess, TextClient, gym_server

PROGRAM = '''
import gymnasium
from hippodrome.trial import gym as gymie
from hippodrome.trial.gym import EnvironmentNotFound, override
from hippodrome.trial.gym.settings import Limits


@override("get_env")
def own_get_env(file_name, seed=None, worker_id=0):
    """With names of its own, as Unity's in Gymie's tests."""
    if file_name == "missing":
        raise EnvironmentNotFound
    made = gymnasium.make(file_name)
    made.unwrapped.length = 0.5 + worker_id
    return made


@override("process_step")
def own_process_step(step):
    observation, reward, done, info = step
    cut = {"cut": info["TimeLimit.truncated"]} if "TimeLimit.truncated" in info else {}
    return [round(float(number)) for number in observation], 10 * float(reward), done, {"processed": True, **cut}


gymie.start("127.0.0.1", 0, limits=Limits(seconds=5))
'''


@pytest.fixture(scope="module")
def program(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GymServerProcess]:
    file = tmp_path_factory.mktemp("program") / "serve.py"
    file.write_text(PROGRAM)
    with gym_server(program=(str(file),)) as found:
        yield found


def test_the_answer_of_a_step_is_the_result_of_process_step(program: GymServerProcess) -> None:
    with TextClient(program.url) as client:
        made = client.make("CartPole-v1")
        client.ask("reset", instance_id=made)
        assert client.ask("step", instance_id=made, action=1) == [[0, 0, 0, 0], 10.0, False, {"processed": True}]


def test_process_step_gets_the_time_limit_and_its_info_is_answered(program: GymServerProcess) -> None:
    with TextClient(program.url) as client:
        made = client.make("MountainCar-v0")
        client.ask("reset", instance_id=made)
        for _ in range(200):
            *_, done, info = client.ask("step", instance_id=made, action=1)
        assert (done, info) == (True, {"processed": True, "cut": True})


def test_steps_of_one_request_are_processed_too(program: GymServerProcess) -> None:
    with TextClient(program.url + "?form=gymnasium") as client:
        made = client.make("CartPole-v1", worker_id=2)
        client.ask("reset", instance_id=made, seed=1)
        assert client.ask("step_many", instance_id=made, actions=[1, 1])[1] == [10.0, 10.0]


def test_errors_of_the_program_have_gymies_sentence(program: GymServerProcess) -> None:
    with TextClient(program.url) as client, pytest.raises(ConnectionClosed, match="not found"):
        client.make("missing")


def test_parameters_that_get_env_does_not_take_get_a_sentence(program: GymServerProcess) -> None:
    with TextClient(program.url + "?form=gymnasium") as client:
        said = client.ask("make", env_id="CartPole-v1", no_graphics=True)
        assert "unexpected keyword argument 'no_graphics'" in said["error"]["message"]


def test_the_program_of_the_documentation_runs(tmp_path: Path) -> None:
    (text,) = [
        found
        for found in re.findall(r"```python\n(.*?)```", (ROOT / "docs/gym.md").read_text(), re.DOTALL)
        if "gymie.start" in found
    ]
    (tmp_path / "serve.py").write_text(text.replace('"127.0.0.1", 5000', '"127.0.0.1", 0'))
    with gym_server(program=(str(tmp_path / "serve.py"),)) as found, TextClient(found.url) as client:
        made = client.make("CartPole-v1", seed=1)
        client.ask("reset", instance_id=made)
        assert client.ask("step", instance_id=made, action=1)[1:] == [1.0, False, {}]


def test_the_documentation_has_every_limit_with_its_default() -> None:
    table = (ROOT / "docs/gym.md").read_text().partition("## Limits")[2].partition("\n## ")[0]
    rows = dict(re.findall(r"^\| `--([a-z-]+)`[^|]*\| ([^|]*) \|", table, re.MULTILINE))
    assert rows == {field.name.replace("_", "-"): f"{field.default:g}" for field in fields(Limits)}


@pytest.mark.parametrize(
    ("arguments", "command"),
    [
        ([], "-m hippodrome gym"),
        (["PORT=5001"], '-m hippodrome gym --port "5001"'),
        (["HOST=0.0.0.0"], '-m hippodrome gym --host "0.0.0.0"'),
        (["ARGS=--seconds 10"], "-m hippodrome gym --seconds 10"),
    ],
)
def test_make_gym_starts_a_server(arguments: list[str], command: str) -> None:
    done = subprocess.run(["make", "-n", "gym", *arguments], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.split()[-len(command.split()) :] == command.split()


def test_only_two_functions_can_be_replaced() -> None:
    with pytest.raises(AssertionError, match="Functions available: `get_env`, `process_step`"):
        override("reset")


def test_a_port_that_is_taken_is_reported(program: GymServerProcess) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "hippodrome", "gym", "--port", str(program.port)],
        cwd=ROOT, stderr=subprocess.PIPE, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    said = f"Cannot listen at 127.0.0.1:{program.port}: Address already in use. Take another port: --port 5001.\n"
    assert done.stderr == said


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--processes", "0"], "Invalid value for '--processes'"),
        (["--idle-seconds", "-1"], "Invalid value for '--idle-seconds'"),
        (["--port", "70000"], "Invalid value for '--port'"),
        (["--host", "192.0.2.1"], "Cannot listen at 192.0.2.1:5000: Cannot assign requested address."),
    ],
)
def test_wrong_arguments_are_reported_before_anything_starts(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["gym", *arguments]) != 0
    assert words in capsys.readouterr().err


@pytest.mark.parametrize("host", [".".join(["name" * 15] * 6), "a..b"])
def test_a_host_that_does_not_exist_is_reported(host: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gym", "--host", host]) == 1
    assert f"Cannot listen at {host}:5000: there is no such host." in capsys.readouterr().err


def test_a_start_outside_of_the_main_thread_is_refused(tmp_path: Path) -> None:
    program = """
import threading
from hippodrome.trial import gym as gymie

thread = threading.Thread(target=gymie.start, args=("127.0.0.1", 0))
thread.start()
thread.join()
"""
    (tmp_path / "serve.py").write_text(program)
    done = subprocess.run(
        [sys.executable, str(tmp_path / "serve.py")],
        env={"PYTHONPATH": str(ROOT)}, stderr=subprocess.PIPE, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert "RuntimeError: The server must be started in the main thread of the program" in done.stderr


def test_a_module_that_cannot_be_imported_is_reported(tmp_path: Path) -> None:
    (tmp_path / "broken.py").write_text("raise RuntimeError('no')")
    done = subprocess.run(
        [sys.executable, "-m", "hippodrome", "gym", "--port", "0", "--import", "broken"],
        cwd=tmp_path, env={"PYTHONPATH": f"{ROOT}:{tmp_path}"}, stderr=subprocess.PIPE, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (1, "broken cannot be imported: RuntimeError: no\n")


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
@pytest.mark.parametrize("recorded", [False, True])
def test_the_server_says_in_a_line_that_it_has_ended(tmp_path: Path, number: int, recorded: bool) -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "hippodrome", "gym", "--port", "0", *(["--record", str(tmp_path)] if recorded else [])],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stdout is not None
        process.stdout.readline()
        process.send_signal(number)
        assert process.communicate(timeout=40) == (
            "",
            f"Ended. Recordings are in {tmp_path}.\n" if recorded else "Ended.\n",
        )
        assert process.returncode == 0


def test_other_processes_of_the_program_stay(tmp_path: Path) -> None:
    (tmp_path / "serve.py").write_text(
        "import subprocess\nfrom hippodrome.trial import gym as gymie\nchild = subprocess.Popen(['sleep', '300'])\n"
        "gymie.start('localhost', 0)\nassert child.poll() is None\nchild.kill()\nprint('it ran')\n"
    )
    with subprocess.Popen(
        [sys.executable, "serve.py"], cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, text=True
    ) as process:
        assert process.stdout is not None
        port = int(process.stdout.readline().split("/gym")[0].rpartition(":")[2])
        with TextClient(f"ws://localhost:{port}/gym") as client:
            client.make("CartPole-v1")
        process.terminate()
        assert process.communicate(timeout=40)[0] == "it ran\n"


def test_a_host_that_others_can_reach_gets_a_warning() -> None:
    with subprocess.Popen(
        [sys.executable, "-m", "hippodrome", "gym", "--port", "0", "--host", "0.0.0.0"],
        cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    ) as process:  # fmt: skip
        assert process.stderr is not None
        assert "whoever can reach 0.0.0.0 may make environments here" in process.stderr.readline()
        assert process.stdout is not None
        process.stdout.readline()
        process.terminate()
