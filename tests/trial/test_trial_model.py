"""A game whose agent asks a language model: real servers, and a stand-in for the model on this machine."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Iterator
from typing import Any

import pytest

from hippodrome.local.fake_model import FakeModel, reply_to
from hippodrome.protocol.session import assignment_key
from hippodrome.trial.llm.ledger import text_hash
from tests.trial.two_players import two_players

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
        await client.say(command="stop")
        await client.until(lambda: client.done)
    talk = server.answer()["answers"]["talk"]
    assert talk["tokens"]["input"] > talk["tokens"]["output"] > 0
    assert {**talk, "tokens": None} == {
        "lines": 2,
        "fallbacks": 0,
        "calls": 2,
        "tokens": None,
        "model": "small",
        "prompt": text_hash("Be warm.\nAlways."),
    }
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
    assert "reply failed: ModelRefused: the model's API answers with status 400" in server.log_text()
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


# ---- after a server is lost

TICKS = """
    def on_tick(self, session):
        if session.ticks % 4 == 0:
            session.record("hint", session.ask(f"Tick {session.ticks}.", temperature=0))
"""


def asked(model: FakeModel) -> Counter[str]:
    """Return how often the model was asked each question."""
    return Counter(request["messages"][-1]["content"] for _, request, _ in model.requests)


@pytest.mark.parametrize("delay", [0.0, 0.4])
async def test_a_server_that_is_taken_back_repeats_no_call(
    launch: Any, open_client: Any, grid: Any, model: FakeModel, delay: float
) -> None:
    model.behaviour = {"delay": delay}
    agent = grid() + TICKS + ASKS
    first = launch(agent=agent, trial=trial_of(model), SERVER="a-1")
    async with open_client(first.address) as client:
        await client.start()
        await client.until(lambda: len(model.requests) >= 5)
        first.terminate()  # with a delay: in the middle of a call
        await client.closed()
    assert first.wait() == 0
    assert max(asked(model).values()) == 1
    model.behaviour = {}
    second = launch(agent=agent, trial=trial_of(model), SERVER="a-2")
    async with open_client(second.address) as client:
        await client.play(40)
        await client.stop()
    assert client.errors == []
    assert max(asked(model).values()) == 1
    before, after = (lines_of(one, "step", name) for one, name in ((first, "a-1"), (second, "a-2")))
    assert lines_of(second, "resume", "a-2")[0]["steps"] == len(before)
    said = [step["info"]["said"] for step in (*before, *after) if "said" in step["info"]]
    assert said == [reply_to(f"Step {5 * number}.") for number in range(1, len(said) + 1)]


@pytest.mark.parametrize("rescued", [False, True])  # `run` rescues the recording of a server that was killed
async def test_a_server_that_is_killed_repeats_only_what_was_not_stored(
    launch: Any, open_client: Any, grid: Any, model: FakeModel, rescued: bool
) -> None:
    agent = grid() + TICKS + ASKS
    trial = {**trial_of(model), "startingFrameRate": 10}
    first = launch(agent=agent, trial=trial, SERVER="a-1")
    async with open_client(first.address) as client:
        await client.start()
        await client.until(lambda: len(model.requests) >= 24)  # about five seconds
        first.process.kill()
        killed = time.monotonic()
        await client.closed()
    first.wait()
    recent = sum(killed - when < 2.5 for when in model.times)  # two seconds, and some for a busy machine
    assert recent < len(model.requests)
    for part in first.store.rglob("*.part") if rescued else ():
        part.rename(part.with_suffix(""))
    second = launch(agent=agent, trial=trial, SERVER="a-2")
    async with open_client(second.address) as client:
        await client.play(20)
        await client.stop()
    assert client.errors == []
    assert sum(count - 1 for count in asked(model).values()) <= recent
    assert max(asked(model).values()) <= 2
    (lines,) = second.recordings(server="a-2").values()
    assert lines[1]["kind"] == ("resume" if rescued else "reset")


async def test_the_next_server_has_the_talk_and_the_cap(
    launch: Any, open_client: Any, grid: Any, model: FakeModel
) -> None:
    trial = {**trial_of(model, maxCalls=2), "chat": True}
    first = launch(agent=grid(), trial=trial, SERVER="a-1")
    async with open_client(first.address) as client:
        await client.play(5)
        await say(client, 1, "One")
        await client.read(2)
        await say(client, 2, "Two")
        await client.read(4)
        first.terminate()
        await client.closed()
    first.wait()
    second = launch(agent=grid(), trial=trial, SERVER="a-2")
    async with open_client(second.address) as client:
        await client.enter()
        talk = await client.read(4)
        assert talk[1::2] == [("ai", reply_to("One")), ("ai", reply_to("Two"))]
        await say(client, 3, "Three")
        assert (await client.read(6))[-1] == ("ai", "Sorry, I cannot answer right now.")
    assert len(model.requests) == 2
    assert "CapReached" in second.log_text()


async def test_an_answer_under_way_when_a_server_is_taken_back_is_paid_for_once(
    launch: Any, open_client: Any, grid: Any, model: FakeModel
) -> None:
    model.behaviour = {"pace": 0.2}
    trial = {**trial_of(model), "chat": True}
    first = launch(agent=grid(), trial=trial, SERVER="a-1")
    async with open_client(first.address) as client:
        await client.play(5)
        await say(client, 1, "One")
        await client.until(lambda: client.lines.get(2, {}).get("more"))
        await say(client, 2, "Two")  # waits for the answer to the first
        await client.read(3)
        first.terminate()
        await client.closed()
    assert first.wait() == 0
    model.behaviour = {}
    second = launch(agent=grid(), trial=trial, SERVER="a-2")
    async with open_client(second.address) as client:
        await client.enter()
        assert [text for by, text in await client.read(4) if by == "ai"] == [reply_to("One"), reply_to("Two")]
    assert asked(model) == {"One": 1, "Two": 1}


POLICY = """
from hippodrome.llm import ask

class Asks:
    def act(self, observation, info):
        ask(f"I see {list(map(int, observation))}.")
        return 0
"""


async def test_what_policies_asked_is_not_asked_again(launch: Any, open_client: Any, model: FakeModel) -> None:
    agent = two_players() + POLICY
    trial = {**trial_of(model), "players": {"left": "human", "right": "agent:Asks"}, "actionSpace": ["a", "b", "c"]}
    first = launch(agent=agent, trial=trial, SERVER="a-1")
    async with open_client(first.address) as client:
        await client.start()
        await client.until(lambda: len(model.requests) >= 10)
        first.terminate()
        await client.closed()
    first.wait()
    before = len(model.requests)
    second = launch(agent=agent, trial=trial, SERVER="a-2")
    async with open_client(second.address) as client:
        await client.start()
        await client.until(lambda: len(model.requests) >= before + 5)
    assert max(asked(model).values()) == 1


async def test_a_game_may_have_a_model_of_its_own(launch: Any, open_client: Any, grid: Any, model: FakeModel) -> None:
    own = {"chat": {"first": "ai"}, "llm": {"url": model.url, "model": "small", "system": "Be firm."}}
    server = launch(agent=grid(), trial={}, ASSIGNMENT="on")
    place = server.store / assignment_key("study", "P1")
    place.parent.mkdir(parents=True, exist_ok=True)
    place.write_text(json.dumps({"games": {"3": {"step": "3", "trial": own}}}))
    async with open_client(server.address) as client:
        await client.enter()
        await client.read(1)
    assert model.requests[0][1]["messages"][0] == {"role": "system", "content": "Be firm."}
