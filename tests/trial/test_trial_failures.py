"""Researchers' code that fails, hangs or is slow, and who is recorded as having chosen an action."""

import re
import time
from pathlib import Path

import pytest

from hippodrome.protocol.exits import LATE_AGENT, NO_AGENT
from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.loading import Agent
from hippodrome.trial.core.trial import TRIAL_FAILED

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
UI = {"stop": True, "left": True}
NAMES = {"actionSpace": ["noop", "left"], "startingFrameRate": 60, "ui": UI}


def agent_source(**methods):
    return BASE + "".join(f"    def {name}:\n        {body}\n" for name, body in methods.items())


async def failed_client(server, open_client):
    async with open_client(server.address) as client:
        await client.hello()
        await client.until(lambda: client.controls or client.errors)
        await client.say(command="start")
        assert await client.closed(20) == 1000
    assert server.wait() == 0
    told = " ".join(client.errors)
    assert "went wrong" in told
    assert "Traceback" not in told
    assert "boom" not in told
    outcome = server.answer()["answers"]["outcome"]
    assert client.done.get("error") == (TRIAL_FAILED if outcome == "failed" else None)
    return client


async def test_a_step_that_raises_ends_the_episode_and_then_the_trial(launch, open_client):
    source = BASE.replace(
        "self.steps += 1", "self.steps += 1\n        if self.steps % 4 == 0: raise ValueError('boom')"
    )
    server = launch(source, NAMES)
    client = await failed_client(server, open_client)
    assert client.done["episodes"] == 3
    assert len(client.errors) == 3
    answers = server.answer()["answers"]
    assert (answers["outcome"], answers["episodes"], answers["score"]) == ("failed", 3, 9)
    assert "ValueError: boom" in server.log_text()
    assert "Traceback" in server.log_text()
    recordings = server.recordings()
    assert len(recordings) == 3
    error, end = recordings["3-episode-0002.jsonl.gz"][-2:]
    assert error["kind"] == "error"
    assert "boom" in error["error"]
    assert end["why"] == "failed"


async def test_one_failure_among_good_episodes_does_not_fail_the_trial(launch, open_client):
    body = 'self.steps += 1; n = self.steps\n        if n == 4: raise ValueError("boom")\n        '
    source = BASE + (
        f"    def step(self, action):\n        {body}return None, 1.0, n % 3 == 0, {{}}\n"  # an old four-tuple
    )
    server = launch(source, {**NAMES, "maxEpisodes": 3})
    await failed_client(server, open_client)
    assert server.answer()["answers"]["outcome"] == "finished"


BROKEN = {
    "syntax": (BASE.replace("def reset(self):", "def reset(self)"), r"agent\.py:7: SyntaxError: expected ':'"),
    "import": ("import boom\n", r"agent\.py:1: ModuleNotFoundError: No module named 'boom'"),
    "class": ("x = 1\n", r"AgentError: agent\.py has no class Agent"),
    "method": ("class Agent:\n    def start(self, game): pass\n", r"AgentError: Agent in agent\.py has no step, .*"),
    "start": (
        BASE.replace("self.steps = 0", "raise RuntimeError('boom of P-start')"),
        r"agent\.py:6: RuntimeError: boom of .*",
    ),
    "lines": (
        BASE.replace("self.steps = 0", "raise RuntimeError('boom\\n  and\\nbust')"),
        r"agent\.py:6: RuntimeError: boom and bust",
    ),
    "exit": (
        BASE.replace("self.steps = 0", "raise SystemExit('boom')"),
        r"agent\.py:6: RuntimeError: SystemExit\('boom'\)",
    ),
    "game": (
        BASE.replace("self.steps = 0", "import gymnasium; gymnasium.make('Nowhere-v1')"),
        r"agent\.py:6: gymnasium\.error\.NameNotFound: Environment `Nowhere` doesn't exist\.",
    ),
    "reset": (
        BASE.replace("        pass\n    def step", "        raise KeyError('boom')\n    def step"),
        r"agent\.py:8: KeyError: 'boom'",
    ),
    "render": (BASE.replace("np.zeros((8, 8, 3), np.uint8)", "None"), r".*"),
}


async def assert_does_not_begin(server, open_client, user, status=NO_AGENT):
    async with open_client(server.address) as client:
        await client.hello(userId=user)
        assert await client.closed(20) == 1011
        (told,) = client.errors
        assert "cannot be started" in told
        assert "boom" not in told
        assert not client.controls
        assert client.done is None
    assert server.wait() == status
    assert not (server.store / f"study/users/{user}/answers").exists()
    assert user not in server.log_text()


@pytest.mark.parametrize("name", BROKEN)
async def test_a_trial_that_cannot_begin_writes_no_answer(launch, open_client, name):
    source, last_line = BROKEN[name]
    server = launch(source, NAMES, USER_ID=f"P-{name}")
    await assert_does_not_begin(server, open_client, f"P-{name}", status=1 if name in ("reset", "render") else NO_AGENT)
    said = server.log_text().splitlines()
    assert said.count("Traceback (most recent call last):") == 1
    (begin,) = [n for n, line in enumerate(said) if line.startswith("Traceback")]
    assert " ERROR the agent " in said[begin - 1]
    # Local mode shows the first line after the frames of the traceback.
    assert re.fullmatch(last_line, next(line for line in said[begin + 1 :] if not line.startswith(" "))), said


async def test_a_trial_does_not_begin_without_names_of_actions_or_with_an_unknown_game(launch, open_client):
    await assert_does_not_begin(launch(BASE, {"ui": UI}, USER_ID="P-names"), open_client, "P-names")
    server = launch("", {"game": "Nowhere-v1"}, USER_ID="P-none")
    await assert_does_not_begin(server, open_client, "P-none")
    (server.log.parent / "agent" / "agent.py").unlink()
    server = launch(None, {"game": "Nowhere-v1"}, USER_ID="P-game")
    await assert_does_not_begin(server, open_client, "P-game")
    assert "\ngymnasium.error.NameNotFound: " in server.log_text()


async def test_the_log_names_the_line_of_a_broken_helper(launch, open_client, tmp_path):
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent" / "my_helper.py").write_text("x = (\n")
    server = launch("import my_helper\n", NAMES, USER_ID="P-help")
    await assert_does_not_begin(server, open_client, "P-help")
    assert "\nmy_helper.py:1: SyntaxError: '(' was never closed\n" in server.log_text()


async def test_a_trial_whose_start_never_returns_does_not_begin(launch, open_client):
    server = launch(BASE.replace("self.steps = 0", "time.sleep(1000)"), NAMES, START_SECONDS="1", USER_ID="P-slow")
    await assert_does_not_begin(server, open_client, "P-slow", status=LATE_AGENT)
    assert "\nagent.py:6: AgentTimeout: no answer within 1 s\n" in server.log_text()


def test_a_broken_agent_ends_a_server_without_clients(launch):
    begun = time.monotonic()
    server = launch("import boom\n", NAMES)
    assert server.wait(10) == NO_AGENT
    assert time.monotonic() - begun > 3
    assert not server.answered()


async def test_an_answered_game_step_stays_done_with_a_broken_agent(launch, open_client):
    server = launch("import boom\n", NAMES)
    path = server.store / "study/users/P1/answers/3.json"
    path.parent.mkdir(parents=True)
    path.write_text('{"answers": {"episodes": 1, "score": 2}}')
    async with open_client(server.address) as client:
        await client.hello()
        assert await client.closed() == 1000
        assert client.done["score"] == 2
    assert server.wait() == 0


async def test_a_failure_in_mid_episode_is_recorded_and_the_log_names_its_line(launch, open_client):
    source = BASE.replace("self.steps += 1", "self.steps += 1\n        if self.steps > 3: raise ValueError('boom')")
    server = launch(source, NAMES)
    await failed_client(server, open_client)
    assert server.answer()["answers"]["outcome"] == "failed"
    assert "\nagent.py:11: ValueError: boom\n" in server.log_text()
    assert server.log_text().count("Traceback") == 1, "the same failure again needs no traceback again"


async def test_a_step_that_never_returns_ends_the_trial(launch, open_client):
    source = BASE.replace("self.steps += 1", "self.steps += 1\n        while self.steps > 5: time.sleep(1)")
    server = launch(source, NAMES, STEP_SECONDS="1")
    await failed_client(server, open_client)
    answers = server.answer()["answers"]
    assert (answers["outcome"], answers["frames"]) == ("failed", 5)
    lines = server.recordings()["3-episode-0001.jsonl.gz"]
    assert [line["kind"] for line in lines] == ["header", "reset"] + ["step"] * 5 + ["error", "end"]
    assert lines[-2]["error"] == "hippodrome.trial.core.effects.AgentTimeout: no answer within 1 s"


async def test_the_log_names_the_line_in_which_a_step_never_returns(launch, open_client, tmp_path):
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent" / "my_helper.py").write_text("def search(user):\n    while True:\n        pass\n")
    source = "import my_helper\n" + BASE.replace("self.steps += 1", "my_helper.search('P1')")
    server = launch(source, NAMES, STEP_SECONDS="1")
    await failed_client(server, open_client)
    said = server.log_text()
    assert re.search(r"\nmy_helper\.py:[23]: AgentTimeout: no answer within 1 s\n", said)
    assert re.search(r'\nTraceback .*\n(  .*\n)*  File ".*agent\.py", line 11, in step\n', said)
    assert "my_helper.search('(participant)')" in said
    assert "P1" not in said


async def test_a_step_that_hangs_does_not_delay_the_end_of_the_server(launch, open_client):
    source = BASE.replace(
        "self.steps += 1",
        "self.steps += 1\n        while self.steps > 5:\n            open('stuck', 'w').close()\n            time.sleep(1)",
    )
    server = launch(source, NAMES)
    stuck = server.log.with_name("stuck")  # the server's folder
    async with open_client(server.address) as client:
        await client.hello()
        await client.say(command="start")
        while not stuck.exists():
            await client.watch(0.02)
        server.terminate()
        assert await client.closed() == 1001
    begun = time.monotonic()
    assert server.wait() == 0
    assert time.monotonic() - begun < 10
    lines = server.recordings()["3-episode-0001.jsonl.gz"]
    assert [line["kind"] for line in lines].count("step") == 5
    assert lines[-1]["why"] == "shutdown"
    assert not server.answered()


async def test_a_slow_step_keeps_the_connection_alive(launch, open_client, tmp_path):
    under_way, go_on = tmp_path / "under_way", tmp_path / "go_on"
    source = BASE.replace(
        "        self.steps += 1\n",
        "        self.steps += 1\n"
        "        if self.steps == 4:\n"
        f"            open({str(under_way)!r}, 'w').close()\n"
        f"            while not os.path.exists({str(go_on)!r}): time.sleep(0.02)\n",
    )
    server = launch("import os\n" + source, NAMES)
    async with open_client(server.address) as client:
        await client.play(3)
        while not under_way.exists():
            await client.watch(0.02)
        for _ in range(3):
            client.controls = {}
            await client.say(command="requestUI")
            await client.until(lambda: client.controls)
        go_on.touch()
        await client.stop()


async def steps_by(launch, open_client, source):
    """Return how the steps of an episode say who chose the action; `left` is held in the later steps."""
    waits = "self.steps += 1\n        while self.steps == 20 and not os.path.exists('go_on'): time.sleep(0.02)"
    server = launch("import os\n" + source.replace("self.steps += 1", waits), {**NAMES, "maxEpisodes": 1})
    async with open_client(server.address) as client:
        await client.hello()
        await client.until(lambda: client.controls or client.errors)
        await client.say(command="start")
        await client.until(lambda: len(client.frames) > 3)
        await client.say(action="left", held=True)
        await client.wait_until_heard()
        server.log.with_name("go_on").touch()
        assert await client.closed() == 1000
    server.wait()
    _, reset, *steps, _ = server.recordings()["3-episode-0001.jsonl.gz"]
    assert reset["seed"] is None
    assert len(steps) == 40
    return {(line["human"], line["action"], line["actionName"], line["by"]) for line in steps}


FORTY = BASE.replace('"done": False', '"done": self.steps == 40')


async def test_a_step_is_by_the_agent_if_it_names_its_action(launch, open_client):
    """Whether or not it is the action that the human asked for."""
    source = FORTY.replace('"info": {}', '"info": {"action": 1}')
    assert await steps_by(launch, open_client, source) == {(None, 1, "left", "agent"), (1, 1, "left", "agent")}


async def test_a_step_is_by_the_agent_if_it_overrides_the_human(launch, open_client):
    source = FORTY.replace('"info": {}', '"info": {}, "action": 0')
    assert await steps_by(launch, open_client, source) == {(None, 0, "noop", "agent"), (1, 0, "noop", "agent")}


async def test_a_step_is_by_the_human_if_the_agent_names_no_action(launch, open_client):
    assert await steps_by(launch, open_client, FORTY) == {(None, 0, "noop", "none"), (1, 1, "left", "human")}


async def test_a_step_is_by_the_human_if_the_environments_info_repeats_their_action(launch, open_client):
    """The info of reset has an action already: then only an action other than the human's is the agent's."""
    echo = FORTY.replace('"info": {}', '"info": {"action": action}').replace(
        "        pass\n    def step", '        return None, {"action": 0}\n    def step'
    )
    assert await steps_by(launch, open_client, echo) == {(None, 0, "noop", "none"), (1, 1, "left", "human")}


async def test_a_step_is_by_the_agent_if_such_an_info_has_another_action(launch, open_client):
    other = FORTY.replace('"info": {}', '"info": {"action": 1 - action}').replace(
        "        pass\n    def step", '        return None, {"action": 0}\n    def step'
    )
    assert await steps_by(launch, open_client, other) == {(None, 1, "left", "agent"), (1, 0, "noop", "agent")}


def test_without_an_agent_only_the_human_chooses():
    class Echo:
        def step(self, action):
            return None, 0.0, False, False, {"action": 5}

    player = AgentAdapter(Path("/nowhere"), "", ("noop", "left"))
    player._agent = Agent()
    player._agent.env = Echo()
    outcome = player.step(1)
    assert (outcome.action, outcome.info) == (None, {"action": 5})
