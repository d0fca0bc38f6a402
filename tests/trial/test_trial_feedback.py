"""What the agent hears and what the recording says of it are the same step of the same episode."""

import asyncio
import json

import pytest

from trial.core.message_log import Word
from trial.core.unfinished import RecordedTrial
from trial.recordings import recording
from trial.recordings.resume import add_lines

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


def agent(length=0, fail_at=0):
    return HISTORY.format(length=length, fail_at=fail_at)


def words(line):
    return [m["command"] for m in line.get("messages", []) if m.get("command") in ("good", "bad")]


def heard_as_recorded(lines):
    """Every word of the recording in order; each was heard at the step, or at the end, that the recording says."""
    said, at_the_end = [], []
    for line in lines:
        if line["kind"] == "reset":
            assert line["info"]["heard"] == at_the_end
            at_the_end = []
        elif line["kind"] == "step":
            assert line["info"]["heard"] == words(line)
        elif line["kind"] in ("end", "break") and line.get("why") != "shutdown":
            at_the_end += words(line)
        if line.get("why") != "shutdown":  # not heard before the server ended: the next server repeats it
            said += words(line)
    return said


def all_lines(server, name="a-1"):
    return [line for lines in server.recordings(server=name).values() for line in lines]


def killed(server):
    """Kill the server, and store its recordings as whoever started it does."""
    server.process.kill()
    server.wait()
    for part in server.store.rglob("*.part"):
        part.rename(part.with_suffix(""))


async def held(client):
    await client.say(command="pause")
    await client.until(lambda: client.state["state"] == "paused")


async def more(client, frames):
    seen = len(client.frames)
    await client.until(lambda: len(client.frames) >= seen + frames)


async def reset_while_held(client):
    """Pause, praise, begin again, go on."""
    await held(client)
    await client.say(command="good")
    await client.say(command="reset")
    await client.until(lambda: client.state["episode"] == 2)
    await client.say(command="start")
    await more(client, 5)


def test_feedback_between_a_pause_and_a_reset_belongs_to_the_episode_that_ends(launch, open_client):
    server = launch(agent(), {**TRIAL, "dataFile": "trial"}, SERVER="a-1")

    async def play():
        async with open_client(server.address) as client:
            await client.play(5)
            await reset_while_held(client)
            await client.say(command="bad")
            await more(client, 5)
            await client.say(command="stop")
            await client.closed()

    asyncio.run(play())
    assert server.wait() == 0
    lines = all_lines(server)
    assert heard_as_recorded(lines) == ["good", "bad"]
    (end,) = (line for line in lines if line["kind"] == "end" and line["episode"] == 1)
    assert words(end) == ["good"]


def test_after_a_kill_the_game_goes_on_although_feedback_came_before_a_reset(launch, open_client):
    first = launch(agent(), TRIAL, SERVER="a-1")

    async def play():
        async with open_client(first.address) as client:
            await client.play(5)
            await reset_while_held(client)
            await client.say(command="bad")
            await more(client, 50)

    asyncio.run(play())
    killed(first)
    second = launch(agent(), TRIAL, SERVER="a-2")

    async def go_on():
        async with open_client(second.address) as client:
            await client.play(5)
            await client.say(command="stop")
            await client.closed()
            return client

    client = asyncio.run(go_on())
    assert client.errors == []
    after = all_lines(second, "a-2")
    assert [line["kind"] for line in after[:2]] == ["header", "resume"]
    assert heard_as_recorded(all_lines(first)) == ["good", "bad"]
    assert second.answer()["answers"]["frames"] == sum(line["kind"] == "step" for line in all_lines(first) + after)


@pytest.mark.parametrize("fail_at", [0, 7])
def test_every_word_is_heard_where_the_recording_has_it_whenever_it_is_said(launch, open_client, fail_at):
    trial = {**TRIAL, "dataFile": "trial", "maxEpisodes": 1000}
    server = launch(agent(length=12, fail_at=fail_at), trial, SERVER="a-1")
    said = []

    async def talk(client):
        while True:
            seen = len(client.frames)
            for word in ("good", "bad") * 3:
                await client.say(command=word)
                said.append(word)
                await asyncio.sleep(0.01)
            while len(client.frames) == seen:  # a server that stands still would take what waits for it for a flood
                await asyncio.sleep(0.01)

    async def play():
        async with open_client(server.address) as client:
            await client.play(1)
            talking = asyncio.create_task(talk(client))
            await client.until(lambda: len(said) > 40 and client.state["episode"] > 4)
            talking.cancel()
            await client.say(command="stop")
            await client.until(lambda: client.done)

    asyncio.run(play())
    assert server.wait() == 0
    lines = all_lines(server)
    assert len(heard_as_recorded(lines)) > 20
    assert any(line["kind"] == "error" for line in lines) == bool(fail_at)


@pytest.mark.parametrize("steps", [0, 5])
def test_feedback_that_a_server_took_with_it_is_heard_on_the_next(launch, open_client, steps):
    first = launch(agent(), TRIAL, SERVER="a-1")

    async def play():
        async with open_client(first.address) as client:
            if steps:
                await client.play(steps)
                await held(client)
            else:
                await client.hello()
                await client.until(lambda: client.frame is not None)
            await client.say(command="good")
            await client.say(command="requestUI")
            await client.until(lambda: "UI" in client.state)
            first.terminate()
            await client.closed()

    asyncio.run(play())
    assert first.wait() == 0
    assert words(all_lines(first)[-1]) == ["good"]
    for attempt in (2, 3):
        server = launch(agent(), TRIAL, SERVER=f"a-{attempt}")

        async def go_on(address=server.address):
            async with open_client(address) as client:
                await client.play(5)
                return client

        client = asyncio.run(go_on())
        server.terminate()
        server.wait()
        assert client.errors == []
        assert heard_as_recorded(all_lines(server, f"a-{attempt}")) == (["good"] if attempt == 2 else [])


def test_the_past_keeps_what_nobody_heard():
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
