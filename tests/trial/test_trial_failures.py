"""Researchers' code that fails, hangs or dawdles."""

import asyncio
import time

BASE = """
import time
import numpy as np
class Agent:
    def start(self, game):
        self.steps = 0
    def reset(self):
        pass
    def step(self, action):
        self.steps += 1
        return {"observation": None, "reward": 1, "done": False, "info": {}}
    def render(self):
        return np.zeros((8, 8, 3), np.uint8)
    def close(self):
        pass
"""
UI = {"stop": True}
NAMES = {"actionSpace": ["noop", "left"], "startingFrameRate": 60, "ui": UI}


def agent(**methods):
    return BASE + "".join(f"    def {name}:\n        {body}\n" for name, body in methods.items())


def end_of(server, open_client):
    async def play():
        async with open_client(server.address) as client:
            await client.hello()
            await client.until(lambda: client.controls or client.errors)
            await client.say(command="start")
            assert await client.closed(20) == 1000
            return client

    client = asyncio.run(play())
    assert server.wait() == 0
    told = " ".join(client.errors)
    assert "went wrong" in told
    assert "Traceback" not in told
    assert "boom" not in told
    return client


def test_a_step_that_raises_ends_the_episode_and_then_the_trial(launch, open_client):
    source = BASE.replace(
        "self.steps += 1", "self.steps += 1\n        if self.steps % 4 == 0: raise ValueError('boom')"
    )
    server = launch(source, NAMES)
    client = end_of(server, open_client)
    assert client.done["episodes"] == 3
    assert len(client.errors) == 3
    answers = server.answer()["answers"]
    assert (answers["outcome"], answers["episodes"], answers["score"]) == ("failed", 3, 9)
    assert "ValueError: boom" in server.said()
    assert "Traceback" in server.said()
    recordings = server.recordings()
    assert len(recordings) == 3
    error, end = recordings["3-episode-0002.jsonl.gz"][-2:]
    assert error["kind"] == "error"
    assert "boom" in error["error"]
    assert end["why"] == "failed"


def test_one_failure_among_good_episodes_does_not_fail_the_trial(launch, open_client):
    body = 'self.steps += 1; n = self.steps\n        if n == 4: raise ValueError("boom")\n        '
    source = BASE + (
        f"    def step(self, action):\n        {body}return None, 1.0, n % 3 == 0, {{}}\n"  # an old four-tuple
    )
    server = launch(source, {**NAMES, "maxEpisodes": 3})
    end_of(server, open_client)
    assert server.answer()["answers"]["outcome"] == "finished"


def test_failing_start_reset_render_and_import(launch, open_client):
    sources = {
        "start": BASE.replace("self.steps = 0", "raise RuntimeError('boom')"),
        "reset": BASE.replace("        pass\n    def step", "        raise KeyError('boom')\n    def step"),
        "render": BASE.replace("np.zeros((8, 8, 3), np.uint8)", "None"),
        "import": "import boom\n",
        "class": "x = 1\n",
        "exit": BASE.replace("self.steps = 0", "raise SystemExit('boom')"),
    }
    for name, source in sources.items():
        server = launch(source, NAMES, USER_ID=f"P-{name}")

        async def play(server=server, name=name):
            async with open_client(server.address) as client:
                await client.hello(userId=f"P-{name}")
                assert await client.closed(20) == 1000
                assert "went wrong" in client.errors[0]
                assert client.done["episodes"] == 0

        asyncio.run(play())
        assert server.wait() == 0
        import json

        answer = json.loads((server.store / f"study/users/P-{name}/answers/3.json").read_text())
        assert answer["answers"]["outcome"] == "failed"
        assert "Traceback" in server.said()


def test_a_step_that_never_returns(launch, open_client):
    source = BASE.replace("self.steps += 1", "self.steps += 1\n        while self.steps > 5: time.sleep(1)")
    server = launch(source, NAMES, STEP_SECONDS="1")
    end_of(server, open_client)
    answers = server.answer()["answers"]
    assert (answers["outcome"], answers["frames"]) == ("failed", 5)
    lines = server.recordings()["3-episode-0001.jsonl.gz"]
    assert [line["kind"] for line in lines] == ["header", "reset"] + ["step"] * 5 + ["error", "end"]


def test_a_stuck_step_does_not_hold_up_the_end(launch, open_client):
    source = BASE.replace("self.steps += 1", "self.steps += 1\n        while self.steps > 5: time.sleep(1)")
    server = launch(source, NAMES)

    async def play():
        async with open_client(server.address) as client:
            await client.hello()
            await client.say(command="start")
            await client.watch(1)
            server.terminate()
            assert await client.closed() == 1001

    asyncio.run(play())
    begun = time.monotonic()
    assert server.wait() == 0
    assert time.monotonic() - begun < 10
    lines = server.recordings()["3-episode-0001.jsonl.gz"]
    assert [line["kind"] for line in lines].count("step") == 5
    assert lines[-1]["why"] == "shutdown"
    assert not server.answered()


def test_a_slow_step_leaves_the_connection_alive(launch, open_client):
    source = BASE.replace("self.steps += 1", "self.steps += 1; time.sleep(0.4)")
    server = launch(source, NAMES)

    async def play():
        async with open_client(server.address) as client:
            await client.play(3)
            for _ in range(3):
                begun = time.monotonic()
                client.controls = {}
                await client.say(command="requestUI")
                await client.until(lambda: client.controls)
                assert time.monotonic() - begun < 0.3
            await client.say(command="stop")
            assert await client.closed() == 1000

    asyncio.run(play())


def test_an_agent_that_takes_another_action(launch, open_client):
    source = BASE.replace('"info": {}', '"info": {"action": 1}').replace('"done": False', '"done": self.steps == 5')
    server = launch(source, {**NAMES, "maxEpisodes": 1})

    async def play():
        async with open_client(server.address) as client:
            await client.hello()
            await client.say(command="start")
            assert await client.closed() == 1000

    asyncio.run(play())
    server.wait()
    steps = [line for line in server.recordings()["3-episode-0001.jsonl.gz"] if line["kind"] == "step"]
    assert {(line["action"], line["actionName"], line["by"]) for line in steps} == {(1, "left", "agent")}
    assert server.recordings()["3-episode-0001.jsonl.gz"][1]["seed"] is None
