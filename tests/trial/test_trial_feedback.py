"""The agent hears feedback at the same step of the same episode as the recording says."""

import asyncio
import json

import pytest

from hippodrome.trial.core.history import RecordedTrial, Word
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.resume import add_lines

HISTORY = '''
"""Each reward depends on everything that happened in the episode before it, feedback included."""
import time
import zlib
import numpy as np

FAIL_AT = {fail_at}

class Agent:
    env = None

    def start(self, game):
        self.history, self.heard, self.episodes = b"", [], 0

    def reset(self, seed=None):
        heard, self.heard = self.heard, []
        self.history = str(seed).encode()
        self.t, self.episodes = 0, self.episodes + 1
        return np.zeros(2), {{"heard": heard}}

    def feedback(self, word):
        self.heard.append(word)
        self.history += word.encode()

    def step(self, action):
        time.sleep(0.015)
        self.t += 1
        if self.t == FAIL_AT and self.episodes % 2:  # the third failure in a row would end the game
            raise ValueError("a mistake of the agent")
        heard, self.heard = self.heard, []
        self.history += bytes([action])
        return np.zeros(2), zlib.crc32(self.history) % 100, self.t == {length}, False, {{"heard": heard}}

    def render(self):
        return np.full((8, 8, 3), self.t % 256, np.uint8)

    def close(self):
        pass
'''

TRIAL = {
    "actionSpace": ["noop", "up", "left"],
    "maxEpisodes": 4,
    "startingFrameRate": 40,
    "ui": dict.fromkeys(("start", "pause", "reset", "stop", "good", "bad", "up", "left"), True),
}


def agent_source(length=0, fail_at=0):
    return HISTORY.format(length=length, fail_at=fail_at)


def words_in(line):
    return [m["command"] for m in line.get("messages", []) if m.get("command") in ("good", "bad")]


def words_heard_as_recorded(lines):
    """Return the words of the recording in order; assert that each was heard at the step, or the end, that has it."""
    said, at_the_end = [], []
    for line in lines:
        if line["kind"] == "reset":
            assert line["info"]["heard"] == at_the_end
            at_the_end = []
        elif line["kind"] == "step":
            assert line["info"]["heard"] == words_in(line)
        elif line["kind"] in ("end", "break") and line.get("why") != "shutdown":
            at_the_end += words_in(line)
        if line.get("why") != "shutdown":  # the agent has not heard it: the next server repeats it
            said += words_in(line)
    return said


def all_lines(server, name="a-1"):
    return [line for lines in server.recordings(server=name).values() for line in lines]


def killed(server):
    """Kill the server, and store its recordings, as local mode does."""
    server.process.kill()
    server.wait()
    for part in server.store.rglob("*.part"):
        part.rename(part.with_suffix(""))


async def pause(client):
    await client.say(command="pause")
    await client.until(lambda: client.state["state"] == "paused")


async def wait_for_frames(client, frames):
    seen = len(client.frames)
    await client.until(lambda: len(client.frames) >= seen + frames)


async def reset_while_held(client):
    """Pause, say good, reset, and go on."""
    await pause(client)
    await client.say(command="good")
    await client.say(command="reset")
    await client.until(lambda: client.state["episode"] == 2)
    await client.say(command="start")
    await wait_for_frames(client, 5)


async def test_feedback_between_a_pause_and_a_reset_belongs_to_the_episode_that_ends(launch, open_client):
    server = launch(agent_source(), {**TRIAL, "dataFile": "trial"}, SERVER="a-1")
    async with open_client(server.address) as client:
        await client.play(5)
        await reset_while_held(client)
        await client.say(command="bad")
        await wait_for_frames(client, 5)
        await client.say(command="stop")
        await client.closed()
    assert server.wait() == 0
    lines = all_lines(server)
    assert words_heard_as_recorded(lines) == ["good", "bad"]
    (end,) = (line for line in lines if line["kind"] == "end" and line["episode"] == 1)
    assert words_in(end) == ["good"]


async def test_after_a_kill_the_game_goes_on_although_feedback_came_before_a_reset(launch, open_client):
    first = launch(agent_source(), TRIAL, SERVER="a-1")
    async with open_client(first.address) as client:
        await client.play(5)
        await reset_while_held(client)
        await client.say(command="bad")
        await wait_for_frames(client, 50)
    killed(first)
    second = launch(agent_source(), TRIAL, SERVER="a-2")
    async with open_client(second.address) as client:
        await client.play(5)
        await client.say(command="stop")
        await client.closed()
    assert client.errors == []
    after = all_lines(second, "a-2")
    assert [line["kind"] for line in after[:2]] == ["header", "resume"]
    assert words_heard_as_recorded(all_lines(first)) == ["good", "bad"]
    assert second.answer()["answers"]["frames"] == sum(line["kind"] == "step" for line in all_lines(first) + after)


@pytest.mark.parametrize("fail_at", [0, 7])
async def test_the_agent_hears_every_word_at_the_step_where_the_recording_has_it(launch, open_client, fail_at):
    trial = {**TRIAL, "dataFile": "trial", "maxEpisodes": 1000}
    server = launch(agent_source(length=12, fail_at=fail_at), trial, SERVER="a-1")
    said = []

    async def talk(client):
        while True:
            seen = len(client.frames)
            for word in ("good", "bad") * 3:
                await client.say(command=word)
                said.append(word)
                await asyncio.sleep(0.01)
            while len(client.frames) == seen:  # a server that stood still would take all waiting messages for a flood
                await asyncio.sleep(0.01)

    async with open_client(server.address) as client:
        await client.play(1)
        talking = asyncio.create_task(talk(client))
        await client.until(lambda: len(said) > 40 and client.state["episode"] > 4)
        talking.cancel()
        await client.say(command="stop")
        await client.until(lambda: client.done)
    assert server.wait() == 0
    lines = all_lines(server)
    assert len(words_heard_as_recorded(lines)) > 20
    assert any(line["kind"] == "error" for line in lines) == bool(fail_at)


@pytest.mark.parametrize("steps", [0, 5])
async def test_the_next_server_gives_the_agent_the_feedback_that_it_has_not_heard(launch, open_client, steps):
    first = launch(agent_source(), TRIAL, SERVER="a-1")
    async with open_client(first.address) as client:
        if steps:
            await client.play(steps)
            await pause(client)
        else:
            await client.hello()
            await client.until(lambda: client.frame is not None)
        await client.say(command="good")
        await client.say(command="requestUI")
        await client.until(lambda: "UI" in client.state)
        first.terminate()
        await client.closed()
    assert first.wait() == 0
    assert words_in(all_lines(first)[-1]) == ["good"]
    for attempt in (2, 3):
        server = launch(agent_source(), TRIAL, SERVER=f"a-{attempt}")
        async with open_client(server.address) as client:
            await client.play(5)
        server.terminate()
        server.wait()
        assert client.errors == []
        assert words_heard_as_recorded(all_lines(server, f"a-{attempt}")) == (["good"] if attempt == 2 else [])


def test_the_recorded_trial_keeps_words_until_a_step_has_heard_them():
    past = RecordedTrial()

    def happen(kind, **fields):
        add_lines(past, [json.loads(recording.line(kind, episode=1, **fields))])

    happen("reset", seed=7)
    happen("end", why="shutdown", messages=[{"command": "good"}, {"command": "pause"}])
    assert past.unfinished.unheard == [Word("good")]
    happen("resume", steps=0)
    assert past.unfinished.unheard == [Word("good")]
    happen("step", human=None, action=0, reward=1.0)
    assert past.unfinished.unheard == []
