"""A game whose agent asks a language model: real servers, and a stand-in for the model on this machine."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from hippodrome.local.fake_model import FakeModel, reply_to

KEY = "sk-the-key-of-the-study"
ASKS = """
import os, sys
from hippodrome.llm import ask, ModelError

# What is there when agent.py is imported
IMPORTED = {name: os.environ.get(name) for name in ("OPENAI_BASE_URL", "OPENAI_API_KEY", "LLM_KEY")}
_step, _reset = Grid.step, Grid.reset

def _reset_and_ask(self, *, seed=None, options=None):
    observation, info = _reset(self, seed=seed, options=options)
    return observation, {**info, "said": ask(f"A game begins at {self.start}.", temperature=0)}

def _step_and_ask(self, action):
    observation, reward, terminated, truncated, info = _step(self, action)
    if self.t % 5 == 0:
        try:
            info["said"] = ask(f"Step {self.t}.")
            reward = float(len(info["said"]))
        except ModelError as error:
            info["error"] = type(error).__name__
    return observation, reward, terminated, truncated, {**info, "imported": {**IMPORTED, "LLM_KEY": os.environ.get("LLM_KEY")}}

Grid.reset, Grid.step = _reset_and_ask, _step_and_ask
"""


@pytest.fixture
def model() -> Iterator[FakeModel]:
    made = FakeModel({})
    yield made
    made.stop()


def trial_of(model: FakeModel, **keys: Any) -> dict[str, Any]:
    llm = {"url": model.url, "model": "small", **keys}
    return {"ui": {"stop": True, "start": True}, "llm": llm, "startingFrameRate": 60}


def lines_of(server: Any, kind: str, name: str = "a1") -> list[dict[str, Any]]:
    return [line for lines in server.recordings(server=name).values() for line in lines if line["kind"] == kind]


async def test_the_agent_asks_in_reset_and_step(launch: Any, open_client: Any, grid: Any, model: FakeModel) -> None:
    server = launch(agent=grid() + ASKS, trial=trial_of(model), LLM_KEY=KEY)
    async with open_client(server.address) as client:
        await client.play(30)
        await client.stop()
    assert server.wait() == 0
    (reset,), steps = lines_of(server, "reset"), lines_of(server, "step")
    assert reset["info"]["said"] == reply_to(f"A game begins at {reset['info']['start']}.")
    assert steps[4]["info"]["said"] == reply_to("Step 5.")
    assert model.requests[0][2]["Authorization"] == f"Bearer {KEY}"
    assert steps[0]["info"]["imported"]["OPENAI_BASE_URL"].startswith("http://127.0.0.1:")
    assert steps[0]["info"]["imported"]["LLM_KEY"] is None
    assert steps[0]["info"]["imported"]["OPENAI_API_KEY"] not in ("", KEY)
    stored = [path.read_bytes() for path in server.store.rglob("*") if path.is_file()]
    assert not any(KEY.encode() in data for data in (*stored, server.log.read_bytes()))


async def test_an_agent_that_fails_does_not_write_the_key(
    launch: Any, open_client: Any, grid: Any, model: FakeModel
) -> None:
    fails = "\ndef _fail(self, action):\n    raise ValueError({**os.environ})\nGrid.step = _fail\n"
    server = launch(agent=grid() + ASKS + fails, trial=trial_of(model), LLM_KEY=KEY)
    async with open_client(server.address) as client:
        await client.start()
        await client.until(lambda: client.errors)
    server.terminate()
    server.wait()
    assert "ValueError" in server.log_text()
    assert KEY not in server.log_text()


async def test_calls_beyond_the_cap_are_refused_and_the_game_goes_on(
    launch: Any, open_client: Any, grid: Any, model: FakeModel
) -> None:
    server = launch(agent=grid() + ASKS, trial=trial_of(model, maxCalls=2), LLM_KEY=KEY)
    async with open_client(server.address) as client:
        await client.play(30)
        await client.stop()
    steps = lines_of(server, "step")
    assert (steps[4]["info"].get("error"), steps[9]["info"].get("error")) == (None, "CapReached")
    assert len(model.requests) == 2


async def test_a_study_without_a_model_leaves_the_agents_own_variables_alone(
    launch: Any, open_client: Any, grid: Any
) -> None:
    agent = grid() + ASKS.replace('ask(f"A game begins at {self.start}.", temperature=0)', "''")
    server = launch(agent=agent, trial={"ui": {"stop": True, "start": True}}, LLM_KEY=KEY, OPENAI_API_KEY="own")
    async with open_client(server.address) as client:
        await client.play(10)
        await client.stop()
    (first, *_) = lines_of(server, "step")
    assert first["info"]["imported"]["OPENAI_API_KEY"] == "own"


async def say(client: Any, number: int, text: str) -> None:
    await client.say(say={"id": number, "text": text})


async def test_a_model_answers_by_itself_with_the_prompt_and_all_lines(
    launch: Any, open_client: Any, grid: Any, model: FakeModel, tmp_path: Any
) -> None:
    (tmp_path / "agent" / "prompts").mkdir(parents=True)
    (tmp_path / "agent" / "prompts" / "warm.txt").write_text("Be warm.\nAlways.\n")
    llm = {"system": "prompts/warm.txt", "parameters": {"temperature": 0.2}}
    server = launch(agent=grid(), trial={**trial_of(model, **llm), "chat": True})
    async with open_client(server.address) as client:
        await client.enter()
        await say(client, 1, "Hi")
        assert await client.read(2) == [("player_0", "Hi"), ("ai", reply_to("Hi"))]
        await say(client, 2, "And now?")
        await client.read(4)
    _, request, _ = model.requests[1]
    assert request["messages"] == [
        {"role": "system", "content": "Be warm.\nAlways."},
        {"role": "user", "content": "Hi"},
        {"role": "assistant", "content": reply_to("Hi")},
        {"role": "user", "content": "And now?"},
    ]
    assert (request["temperature"], request["stream"]) == (0.2, True)


async def test_a_model_speaks_first(launch: Any, open_client: Any, grid: Any, model: FakeModel) -> None:
    server = launch(agent=grid(), trial={**trial_of(model), "chat": {"first": "ai"}})
    async with open_client(server.address) as client:
        await client.enter()
        ((by, _),) = await client.read(1)
    assert by == "ai"


async def test_a_model_that_cannot_answer_says_the_fallback(
    launch: Any, open_client: Any, grid: Any, model: FakeModel
) -> None:
    model.behaviour = {"refuse": 1}
    server = launch(agent=grid(), trial={**trial_of(model, fallback="One moment."), "chat": True}, LLM_KEY=KEY)
    async with open_client(server.address) as client:
        await client.enter()
        await say(client, 1, "something private")
        assert await client.read(2) == [("player_0", "something private"), ("ai", "One moment.")]
    assert "ModelRefused" in server.log_text()
    assert "something private" not in server.log_text()
    assert KEY not in server.log_text()


async def test_a_callback_asks_the_model_also_in_a_game_without_talk(
    launch: Any, open_client: Any, grid: Any, model: FakeModel
) -> None:
    hears = "\n    def on_episode_start(self, session):\n        return session.ask('A hint?', temperature=1)\n"
    server = launch(agent=grid() + hears, trial=trial_of(model, system="Be brief."))
    async with open_client(server.address) as client:
        await client.play(3)
        await client.stop()
    (line,) = lines_of(server, "callback")
    assert line["value"] == reply_to("A hint?")
    assert model.requests[0][1]["messages"][0] == {"role": "system", "content": "Be brief."}
    assert model.requests[0][1]["temperature"] == 1


async def test_without_its_prompt_no_game_begins(launch: Any, open_client: Any, grid: Any, model: FakeModel) -> None:
    server = launch(agent=grid(), trial=trial_of(model, system="prompts/none.txt"))
    async with open_client(server.address) as client:
        await client.hello()
        await client.closed()
    assert server.wait() != 0
    assert "the prompt prompts/none.txt cannot be read (FileNotFoundError)" in server.log_text()
