"""After a server is lost, the game goes on where it was on the next server."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.trial.core.history import RecordedTrial, Word
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.resume import add_lines, load_recorded
from hippodrome.trial.recordings.store import FolderStore

DICE = (
    "\n_step = Grid.step\ndef _lucky(self, action):\n    import random\n    seen, _, *rest = _step(self, action)\n"
    "    return seen, random.random(), *rest\nGrid.step = _lucky\n"
)


async def play(server, open_client, frames, *, stop=False):
    """Play until `frames` pictures were seen, then end the server; return the client."""
    async with open_client(server.address) as client:
        await client.play(frames)
        if stop:
            await client.say(command="stop")
            await client.until(lambda: client.done)
        else:
            server.terminate()
            await client.closed()
    assert server.wait() == 0
    return client


def steps(lines):
    return [line["step"] for line in lines if line["kind"] == "step"]


@pytest.mark.parametrize("data_file", ["episode", "trial"])
async def test_the_game_goes_on_after_the_last_recorded_step(launch, open_client, data_file):
    trial = {"ui": {"stop": True, "start": True}, "dataFile": data_file}
    first = launch(trial=trial, SERVER="a-1")
    await play(first, open_client, 30)
    ((_, before),) = first.recordings(server="a-1").items()
    second = launch(trial=trial, SERVER="a-2")
    client = await play(second, open_client, 10, stop=True)
    ((_, after),) = second.recordings(server="a-2").items()
    assert client.errors == []
    assert [line["kind"] for line in after[:2]] == ["header", "resume"]
    assert after[0]["seed"] == before[0]["seed"]
    assert steps(before) + steps(after) == list(range(1, len(steps(before)) + len(steps(after)) + 1))
    answers = second.answer()["answers"]
    assert answers["frames"] == len(steps(before)) + len(steps(after))
    assert answers["score"] == 1.5 * answers["frames"]
    assert answers["episodes"] == 1
    assert client.done["score"] == answers["score"]


async def test_the_first_picture_is_that_of_the_last_recorded_step(launch, open_client):
    first = launch(SERVER="a-1")
    await play(first, open_client, 30)
    (before,) = first.recordings(server="a-1").values()
    second = launch(SERVER="a-2")
    async with open_client(second.address) as client:
        await client.hello()
        await client.until(lambda: client.frame is not None)
    reached = len(steps(before))
    assert client.frame[reached % 20, reached % 30].tolist() == [255, 255, 255]
    assert client.state["state"] == "ready"
    assert client.state["score"] == 1.5 * reached


async def test_a_third_server_goes_on_after_the_second(launch, open_client):
    total = 0
    for attempt in (1, 2):
        server = launch(SERVER=f"a-{attempt}")
        await play(server, open_client, 20)
        (lines,) = server.recordings(server=f"a-{attempt}").values()
        total += len(steps(lines))
    third = launch(trial={"ui": {"stop": True, "start": True}}, SERVER="a-3")
    await play(third, open_client, 5, stop=True)
    (lines,) = third.recordings(server="a-3").values()
    assert lines[1]["steps"] == total
    assert third.answer()["answers"]["frames"] == total + len(steps(lines))


async def test_finished_episodes_are_not_played_again(launch, open_client, grid):
    trial = {"maxEpisodes": 3, "startingFrameRate": 60}
    waits = (
        "\nimport os, time\nclass Agent(Agent):\n    def step(self, action):\n"
        "        while self.env.t == 6 and os.path.exists('reset') and not os.path.exists('go_on'): time.sleep(0.02)\n"
        "        return super().step(action)\n"
        "    def reset(self, seed=None):\n        os.path.exists('begun') and open('reset', 'w').close()\n"
        "        open('begun', 'w').close()\n        return super().reset(seed)\n"
    )
    first = launch(agent=grid(12) + waits, trial=trial, SERVER="a-1")
    async with open_client(first.address) as client:
        await client.play(1)
        await client.until(lambda: client.state["episode"] == 2)
        first.terminate()
        first.log.with_name("go_on").touch()  # its step is over, and the server ends
        await client.closed()
    assert first.wait() == 0
    assert list(first.recordings(server="a-1")) == ["3-episode-0001.jsonl.gz", "3-episode-0002.jsonl.gz"]
    second = launch(agent=grid(12), trial=trial, SERVER="a-2")
    async with open_client(second.address) as client:
        await client.play(2)
        await client.until(lambda: client.done)
    assert second.wait() == 0
    assert list(second.recordings(server="a-2")) == ["3-episode-0002.jsonl.gz", "3-episode-0003.jsonl.gz"]
    answers = second.answer()["answers"]
    assert (answers["episodes"], answers["frames"], answers["outcome"]) == (3, 36, "finished")
    assert answers["score"] == 54


async def test_the_next_server_stores_the_missing_answer_of_a_finished_game(launch, open_client, grid):
    first = launch(agent=grid(5), trial={"maxEpisodes": 1}, SERVER="a-1")
    await _until_done(first, open_client)
    assert first.wait() == 0
    (first.store / "study/users/P1/answers/3.json").unlink()  # as if the server had been lost just before
    second = launch(agent=grid(5), trial={"maxEpisodes": 1}, SERVER="a-2")
    await _until_done(second, open_client, start=False)
    assert second.answer()["answers"]["outcome"] == "finished"
    assert second.answer()["answers"]["frames"] == 5


async def _until_done(server, open_client, start=True):
    async with open_client(server.address) as client:
        await client.hello()
        if start:
            await client.say(command="start")
        await client.until(lambda: client.done)


async def test_an_episode_whose_replay_differs_begins_again(launch, open_client, grid):
    trial = {"ui": {"stop": True, "start": True}}
    first = launch(agent=grid(None) + DICE, trial=trial, SERVER="a-1")
    await play(first, open_client, 20)
    second = launch(agent=grid(None) + DICE, trial=trial, SERVER="a-2")
    client = await play(second, open_client, 5, stop=True)
    assert [words for words in client.errors if "starts again" in words]
    (lines,) = second.recordings(server="a-2").values()
    assert [line["kind"] for line in lines[:2]] == ["header", "reset"]
    assert lines[1]["episode"] == 1
    assert second.answer()["answers"]["frames"] == len(steps(lines))
    assert "begins again" in second.log_text()


async def test_after_a_damaged_recording_the_next_server_still_plays(launch, open_client):
    first = launch(SERVER="a-1")
    await play(first, open_client, 20)
    (file,) = (first.store / "study/users/P1/trials/a-1").glob("*.gz")
    file.write_bytes(b"no gzip at all")
    second = launch(trial={"ui": {"stop": True, "start": True}}, SERVER="a-2")
    await play(second, open_client, 5, stop=True)
    assert second.answered()


def test_without_earlier_servers_there_is_no_past(tmp_path):
    store = FolderStore(tmp_path)
    assert load_recorded(store, "study/users/P1/trials", "a-1", "3") is None
    assert load_recorded(store, "study/users/P1/trials", "a-9", "3") is None
    assert load_recorded(store, "study/users/P1/trials", "no attempt", "3") is None


LINES = st.lists(
    st.fixed_dictionaries(
        {"kind": st.sampled_from(["header", "reset", "step", "end", "resume", "error", "break", "what"])},
        optional={
            "episode": st.integers(-1, 3) | st.none() | st.text(max_size=2),
            "seed": st.none() | st.integers(0, 5),
            "steps": st.integers(-5, 5) | st.none(),
            "human": st.none() | st.integers(0, 3),
            "action": st.none() | st.integers(0, 3),
            "reward": st.none() | st.floats(-2, 2) | st.text(max_size=2),
            "why": st.sampled_from(["terminated", "shutdown", "stopped", "stop", "over"]),
            "terminated": st.booleans() | st.none(),
            "frameRate": st.none() | st.integers(0, 60),
            "messages": st.just([]) | st.just([{"command": "good"}]) | st.none(),
        },
    ),
    max_size=12,
)


@given(LINES, LINES)
def test_any_lines_of_recordings_become_a_trial_that_can_go_on(one, other):
    together, apart = RecordedTrial(), RecordedTrial()
    text = b"".join(json.dumps(line).encode() + b"\n" for line in one + other)
    add_lines(together, [json.loads(part) for part in text.splitlines()])
    add_lines(apart, one)
    add_lines(apart, other)
    assert (together.ended, together.unfinished) == (apart.ended, apart.unfinished)
    assert all(episode.steps >= 0 for episode in together.ended)
    assert together.seconds >= 0


def test_feedback_is_read_with_the_steps_of_earlier_servers():
    past = RecordedTrial()
    said = [{"command": "good", "ns": 1}, {"command": "pause"}, {"action": "up"}]
    add_lines(past, [json.loads(recording.line("reset", episode=1, seed=7))])
    line = recording.line("step", episode=1, human=2, action=2, reward=1.0, messages=said)
    add_lines(past, [json.loads(line)])
    assert past.unfinished.steps[0].feedback == (Word("good"),)


def test_steps_after_the_one_from_which_a_server_resumed_are_forgotten():
    past = RecordedTrial()
    add_lines(past, [{"kind": "reset", "episode": 1, "seed": 7}])
    step = {"kind": "step", "episode": 1, "human": None, "action": 0}
    add_lines(past, [{**step, "reward": float(number)} for number in range(5)])
    add_lines(past, [{"kind": "resume", "episode": 1, "steps": 3}, {**step, "reward": 10.0}])
    assert [step.reward for step in past.unfinished.steps] == [0.0, 1.0, 2.0, 10.0]


@pytest.mark.parametrize(("by", "given"), [("random", 2), ("none", 2), ("agent", None)])
def test_the_replay_takes_the_actions_that_the_environment_was_given(by, given):
    recorded = RecordedTrial()
    step = {"kind": "step", "episode": 1, "human": None, "action": 2, "by": by, "reward": 1.0}
    add_lines(recorded, [{"kind": "reset", "episode": 1, "seed": 3}, step])
    assert recorded.unfinished.steps[0].advice == given, "by agent: it was asked for another action than it took"


OWN_NUMBERS = """
import gymnasium, numpy
class Env:
    action_space = gymnasium.spaces.Discrete(3, start=5)
    def reset(self, seed=None, options=None): return 0, {}
    def step(self, action): return 0, float(action), False, False, {}
    def render(self): return numpy.zeros((2, 2, 3), numpy.uint8)
    def close(self): pass
class Agent:
    def start(self, game): return Env()
"""


async def test_a_game_whose_actions_begin_with_another_number_is_continued_and_its_recording_says_which(
    launch, open_client
):
    trial = {"ui": {"stop": True, "start": True}}
    await play(launch(agent=OWN_NUMBERS, trial=trial, SERVER="a-1"), open_client, 10)
    second = launch(agent=OWN_NUMBERS, trial=trial, SERVER="a-2")
    await play(second, open_client, 10, stop=True)
    (lines,) = second.recordings(server="a-2").values()
    assert lines[0]["actionStart"] == {"player_0": 5}
    assert lines[1]["kind"] == "resume"
    taken = [(line["action"], line["reward"]) for line in lines if line["kind"] == "step"]
    assert set(taken) == {(0, 5)}, "action 0 of actionSpace, which the environment calls 5"
