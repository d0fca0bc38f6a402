"""Playing on a real server process over real WebSockets."""

import asyncio
import importlib.util
import itertools
import json
import os
import re
import signal
import statistics
import time
from pathlib import Path

import pytest

from hippodrome.protocol.section_keys import keys
from hippodrome.protocol.trial_sections import Ui
from hippodrome.trial.settings import STALLED_SECONDS
from testing.waiting import until
from tests.trial.client_messages import play_to_the_end

EXAMPLE = Path(__file__).parents[2] / "agent.py"

TIME = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{6}Z")
UI = {"left": True, "start": True, "pause": True, "reset": True, "stop": True, "good": True}


async def test_a_participant_plays_from_the_hello_to_the_answer(launch, open_client, grid):
    server = launch(grid(20), {"maxEpisodes": 2, "startingFrameRate": 60, "ui": UI}, GROUP="1")
    async with open_client(server.address) as client:
        await client.enter()
        assert client.controls["state"] == "ready"
        assert client.controls["actionSpace"] == ["noop", "up", "right", "left", "down", "upright"]
        assert client.controls["UI"] == [key.name for key in keys(Ui) if key.name in UI]
        assert client.controls["maxEpisodes"] == 2
        assert client.frame.shape == (20, 30, 3)
        await client.watch(0.3)
        assert len(client.frames) == 1, "nothing moves before start"
        await client.say(command="start")
        code = await client.closed()
    assert code == 1000
    assert client.done == {"done": True, "episodes": 2, "score": 60}
    assert "ended" in client.states
    assert server.wait() == 0
    answer = server.answer()
    assert {k: answer[k] for k in ("schema", "step", "page", "group")} == {
        "schema": 1,
        "step": "3",
        "page": "game",
        "group": 1,
    }
    assert TIME.fullmatch(answer["answered"])
    told = answer["answers"]
    assert (told["episodes"], told["score"], told["frames"], told["outcome"]) == (2, 60, 40, "finished")
    assert 0.3 < told["seconds"] < 10
    assert list(server.recordings()) == ["3-episode-0001.jsonl.gz", "3-episode-0002.jsonl.gz"]
    assert "the-secret-token" not in server.log_text()
    assert "P1" not in server.log_text()


async def test_the_recording_says_what_happened(launch, open_client, grid, tmp_path):
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent/requirements.txt").write_text("pillow\n")
    server = launch(grid(None), {"ui": UI, "recordObservations": True, "startingFrameRate": 40})
    async with open_client(server.address) as client:
        await client.play()
        await client.say(action="left", held=True)
        await client.say(command="good")
        seen = len(client.frames)
        await client.until(lambda: len(client.frames) > seen + 8)
        await client.say(action="left", held=False)
        await client.say(command="reset")
        await client.until(lambda: client.state.get("episode") == 2)
        await client.stop()
    assert server.wait() == 0
    lines = server.recordings()["3-episode-0001.jsonl.gz"]
    header, reset, *steps, end = lines
    assert header["kind"] == "header"
    assert (header["project"], header["userId"], header["server"], header["step"]) == ("study", "P1", "a1", "3")
    assert header["actionSpace"][3] == "left"
    assert {"trial", "pillow"} <= header["versions"].keys()
    assert reset["kind"] == "reset"
    assert reset["seed"] == header["seed"]
    assert isinstance(reset["info"]["start"], int)
    assert [line["step"] for line in steps] == list(range(1, len(steps) + 1))
    assert all(line["server"] == "a1" and line["trial"] == header["trial"] and line["v"] == 1 for line in lines)
    assert [line["ns"] for line in steps] == sorted(line["ns"] for line in steps)
    left = [line for line in steps if line["actionName"] == "left"]
    assert len(left) >= 5
    assert all(line["action"] == line["human"] == 3 for line in left)
    assert all(line["by"] == "human" and line["reward"] == 1.5 for line in left)
    assert (steps[0]["by"], steps[0]["human"]) == ("none", None)
    assert all(TIME.fullmatch(line["time"]) for line in lines)
    assert steps[0]["info"] == {"t": 1, "nan": None}
    said = [message for line in steps for message in line.get("messages", [])]
    assert [message.get("event", message.get("command")) for message in said[:2]] == ["connected", "start"]
    assert any(message.get("command") == "good" for message in said)
    assert any(message.get("action") == "left" and message.get("held") is True for message in said)
    assert not any("ack" in message or "token" in message for message in said)
    assert end["kind"] == "end"
    assert end["why"] == "reset"
    assert end["steps"] == len(steps)
    from hippodrome.trial.recordings.recording import read_observation

    assert read_observation(left[0]["observation"]).tolist() == [left[0]["step"], 3]
    assert server.answer()["answers"]["outcome"] == "stopped"
    assert server.answer()["group"] is None


async def test_with_data_file_trial_a_trial_has_one_file(launch, open_client, grid):
    server = launch(grid(5), {"maxEpisodes": 3, "dataFile": "trial", "startingFrameRate": 60})
    await play_to_the_end(server, open_client)
    assert server.wait() == 0
    recordings = server.recordings()
    assert list(recordings) == ["3-trial.jsonl.gz"]
    kinds = [line["kind"] for line in recordings["3-trial.jsonl.gz"]]
    assert kinds == ["header"] + (["reset"] + ["step"] * 5 + ["end"]) * 3
    seeds = [line["seed"] for line in recordings["3-trial.jsonl.gz"] if line["kind"] == "reset"]
    assert len(set(seeds)) == 3


async def test_pause_holds_the_game_and_start_goes_on(launch, open_client):
    server = launch()
    async with open_client(server.address) as client:
        await client.play()
        await client.say(command="pause")
        await client.until(lambda: client.state["state"] == "paused")

        def shown() -> bool:
            taken = round(client.state["score"] / 1.5)
            return client.frame[taken % 20, taken % 30, 0] == 255

        await client.until(shown)
        seen = client.frames[-1]
        await client.watch(0.4)
        assert client.frames[-1][1] <= seen[1] + 1, "the step that was under way is the last"
        await client.say(command="start")
        await client.until(lambda: client.state["state"] == "playing")
        await client.until(lambda: client.frames[-1][1] > seen[1] + 3)


async def test_the_frame_rate_stays_within_its_limits(launch, open_client):
    limits = {"minFrameRate": 5, "maxFrameRate": 40, "frameRateStepSize": 10, "allowFrameRateChange": True}
    controls = {"fpsUp": True, "fpsDown": True, "fpsSet": True}
    server = launch(trial={**limits, "startingFrameRate": 30, "ui": controls})
    async with open_client(server.address) as client:
        await client.play()
        for wish, rate in (("faster", 40), ("slower", 30), (1, 5), (1e9, 40), (12, 12)):
            await client.say(changeFrameRate=wish)
            await client.until(lambda rate=rate: client.state["frameRate"] == rate)
        await client.see(18)
        server.terminate()
        await client.closed()
    server.wait()
    (lines,) = server.recordings().values()
    times = [line["ns"] / 1e9 for line in lines if line["kind"] == "step"][-16:]  # the first picture may be older
    gap = statistics.median(later - earlier for earlier, later in itertools.pairwise(times))
    assert 1 / 16 < gap < 1 / 8, "a step that comes late changes no other"


async def test_changing_a_fixed_frame_rate_is_refused_with_a_sentence(launch, open_client):
    server = launch()
    async with open_client(server.address) as client:
        await client.enter()
        await client.say(changeFrameRate="faster")
        await client.say(command="stop")
        await client.say(command="good")
        await client.say(action="jump")
        await client.until(lambda: len(client.errors) == 4)
        await client.say(command="requestUI")
        client.controls = {}
        await client.until(lambda: client.controls)
        errors = client.errors
    assert "fixed" in errors[0]
    assert "stop" in errors[1]
    assert "good" in errors[2]
    assert "actionSpace" in errors[3]


async def test_controls_that_are_missing_in_ui_are_refused_and_do_nothing(launch, open_client):
    server = launch(trial={"allowFrameRateChange": True, "startingFrameRate": 60, "ui": {"up": True, "pause": False}})
    off = [
        ("pause", {"command": "pause"}),
        ("reset", {"command": "reset"}),
        ("trainOnline", {"command": "trainOnline"}),
        ("left", {"action": "left", "held": True}),
        ("right", {"action": "upright"}),
        ("fpsUp", {"changeFrameRate": "faster"}),
        ("fpsDown", {"changeFrameRate": "slower"}),
        ("fpsSet", {"changeFrameRate": 10}),
    ]
    async with open_client(server.address) as client:
        await client.play()
        for _, message in off:
            await client.say(**message)
        await client.until(lambda: len(client.errors) == len(off))
        seen = len(client.frames)
        await client.until(lambda: len(client.frames) > seen + 5)
        assert (client.state["state"], client.state["episode"], client.state["frameRate"]) == ("playing", 1, 60)
        errors = client.errors
    async with open_client(server.address) as client:  # a client that leaves pauses the game in any case
        await client.hello()
        await client.until(lambda: client.controls)
        assert client.controls["state"] == "paused"
        await client.say(command="start")
        await client.until(lambda: client.state["state"] == "playing")
    assert errors == [f"{name} is not offered in this game" for name, _ in off]
    server.terminate()
    server.wait()
    (lines,) = server.recordings().values()
    assert {line["actionName"] for line in lines if line["kind"] == "step"} == {"noop"}


async def test_a_reloaded_page_comes_back_to_the_same_trial(launch, open_client, grid):
    server = launch(grid(None), {"ui": UI})
    async with open_client(server.address) as client:
        await client.play(10)
        score = client.state["score"]
    await asyncio.sleep(0.3)
    async with open_client(server.address) as client:
        await client.enter()
        assert client.controls["state"] == "paused"
        assert client.controls["score"] >= score > 0
        await client.watch(0.3)
        assert len(client.frames) <= 2, "the step that was under way may still bring its picture"
        await client.say(command="start")
        await client.until(lambda: len(client.frames) > 5)
        await client.stop()
    assert server.wait() == 0
    (lines,) = server.recordings().values()
    events = [said.get("event") for line in lines for said in line.get("messages", [])]
    assert events.count("connected") == 2
    assert events.count("disconnected") == 1
    steps = [line["step"] for line in lines if line["kind"] == "step"]
    assert steps == list(range(1, len(steps) + 1))


async def test_a_second_tab_takes_over(launch, open_client):
    server = launch()
    async with open_client(server.address) as first, open_client(server.address) as second:
        await first.play()
        await second.enter()
        assert second.controls["state"] == "paused"
        assert await first.closed() == 4409
        assert "another tab" in first.errors[-1]
        await second.say(command="start")
        await second.until(lambda: len(second.frames) > 5)


async def test_a_slow_client_gets_fewer_frames_and_no_late_ones(launch, open_client):
    server = launch(trial={"startingFrameRate": 60})
    async with open_client(server.address) as client:
        await client.play(20)
        client.acks = False
        for _ in range(8):  # a client that needs a quarter of a second for each frame
            await client.say(ack=client.frames[-1][1])
            seen, began = len(client.frames), time.monotonic()
            await client.watch(0.25)
            assert len(client.frames) - seen <= 6 + (time.monotonic() - began), "one a second comes in any case"
        ids = [frame_id for _, frame_id in client.frames]
    assert ids == sorted(set(ids))
    assert ids[-1] - ids[20] > len(ids[21:]), "the game went on at its own pace"


async def test_the_game_of_a_page_that_stops_answering_is_paused(launch, open_client):
    server = launch(STALLED_SECONDS=str(STALLED_SECONDS))
    async with open_client(server.address) as client:
        await client.play(10)
        client.acks = False
        await client.until(lambda: client.state["state"] == "paused", 8)


async def test_a_server_that_could_not_run_for_some_seconds_does_not_take_a_page_that_has_answered_for_gone(
    launch, open_client
):
    server = launch(trial={"startingFrameRate": 60}, STALLED_SECONDS=str(STALLED_SECONDS))
    async with open_client(server.address) as client:
        await client.play(10)
        client.acks = False
        await client.see(1)
        server.process.send_signal(signal.SIGSTOP)
        await client.watch(0.5)  # what was under way
        client.acks = True
        await client.say(ack=client.frames[-1][1])
        await client.watch(STALLED_SECONDS)
        server.process.send_signal(signal.SIGCONT)
        await client.see(30)
        assert "paused" not in client.states


async def test_a_client_that_never_acknowledges_gets_frames(launch, open_client):
    server = launch(trial={"startingFrameRate": 60})
    async with open_client(server.address) as client:
        client.acks = False
        await client.play(60)
        assert client.state["state"] == "playing"


async def test_a_client_without_a_subprotocol_gets_jpegs_in_json(launch, open_client, grid):
    """HIPPO's own pages: no subprotocol, JPEG in JSON, and the text `done`."""
    server = launch(grid(None), {"maxEpisodes": 1, "ui": UI})
    async with open_client(f"{server.address}?token=the-secret-token", subprotocols=None) as client:
        await client.say(userId="P1", projectId="study")
        await client.until(lambda: client.jpegs)
        await client.say(command="start")
        await client.say(action="left")
        await client.wait_until_heard()
        seen = len(client.jpegs)
        await client.until(lambda: len(client.jpegs) >= seen + 15)
        await client.stop()
    import base64
    import io

    from PIL import Image

    picture = Image.open(io.BytesIO(base64.b64decode(client.jpegs[-1]["frame"])))
    assert picture.format == "JPEG"
    assert picture.size == (30, 20)
    ids = [message["frameId"] for message in client.jpegs]
    assert ids == sorted(set(ids))
    assert client.done == "done"
    assert client.frames == []
    assert server.wait() == 0
    steps = [line for line in server.recordings()["3-episode-0001.jsonl.gz"] if line["kind"] == "step"]
    names = [line["actionName"] for line in steps]
    assert len(names) >= 14
    assert set(names[names.index("left") :]) == {"left"}, "it acts until the next action"


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
async def test_ms_pacman_with_the_example_agent(launch, open_client):
    server = launch(
        EXAMPLE.read_text(), {"game": "MsPacman-v0", "maxEpisodes": 1, "ui": {**UI, "up": True, "right": True}}
    )
    async with open_client(server.address) as client:
        await client.play(15)
        assert client.frame.shape == (210, 160, 3)
        assert len({tuple(pixel) for row in client.frame for pixel in row}) > 3
        assert "upleft" in client.controls["actionSpace"]
        for key in ("left", "up", "right"):
            await client.say(action=key, held=True)
            await client.wait_until_heard()
            await client.see(5)
        await client.stop()
    assert server.wait() == 0
    assert server.answer()["answers"]["outcome"] == "stopped"
    # The recording is enough to play the episode again.
    spec = importlib.util.spec_from_file_location("example_agent", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    agent = module.Agent()
    agent.start("MsPacman-v0")
    _, reset, *steps, _ = server.recordings()["3-episode-0001.jsonl.gz"]
    agent.reset(seed=reset["seed"])
    assert {line["actionName"] for line in steps} >= {"noop", "left", "upleft", "upright"}
    for line in steps:
        _, reward, _, _, info = agent.step(line["action"])
        assert (reward, info["frame_number"]) == (line["reward"], line["info"]["frame_number"])
        assert info["lives"] == line["info"]["lives"]


async def test_without_agent_py_any_game_of_gymnasium_is_played(launch, open_client):
    server = launch(None, {"game": "ALE/Freeway-v5", "ui": UI})
    async with open_client(server.address) as client:
        await client.play(3)
        assert client.controls["actionSpace"] == ["noop", "up", "down"]


async def test_an_answered_game_step_is_not_played_again(launch, open_client):
    answer = {"schema": 1, "answers": {"episodes": 4, "score": 12}}

    server = launch()
    path = server.store / "study/users/P1/answers/3.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(answer))
    async with open_client(server.address) as client:
        await client.hello()
        assert await client.closed() == 1000
        assert client.done == {"done": True, "episodes": 4, "score": 12}
    assert server.wait() == 0
    assert server.answer() == answer


async def test_one_server_plays_two_game_steps(launch, open_client, grid):
    server = launch(grid(5), {"maxEpisodes": 1, "startingFrameRate": 60}, GAME_STEPS="2,4")

    async def play(step):
        async with open_client(server.address) as client:
            await client.hello(step=step)
            await client.say(command="start")
            assert await client.closed() == 1000

    await play("2")
    assert server.answered("2")
    assert not server.answered("4")
    await play("4")
    assert server.wait() == 0
    assert server.answered("4")
    assert list(server.recordings()) == ["2-episode-0001.jsonl.gz", "4-episode-0001.jsonl.gz"]


def test_a_change_of_agent_py_within_a_second_is_loaded(launch, grid, tmp_path):
    """Python takes stored bytecode for current if size and second of the source are the same (PEP 552)."""
    file = tmp_path / "agent" / "agent.py"
    file.parent.mkdir()
    for word in ("older", "newer"):
        file.write_text(f"import sys\nsys.stderr.write('the {word} agent\\n')\n" + grid())
        os.utime(file, (1_000_000_000, 1_000_000_000))
        server = launch(None, PYTHONDONTWRITEBYTECODE="")
        until(lambda server=server: "agent\n" in server.log_text())
        assert f"the {word} agent" in server.log_text()
        server.process.kill()
        server.process.wait()
        server.log.unlink()
    assert not [*tmp_path.rglob("__pycache__")], "the researcher's folder gets no files of ours"
