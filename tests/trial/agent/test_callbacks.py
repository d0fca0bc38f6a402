"""Callbacks of the agent: when they are called, what they record, and that none of them ends the game."""

import dataclasses
import json
import logging
import threading
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from hippodrome.protocol import exits
from hippodrome.trial.agent import callbacks as callbacks_module
from hippodrome.trial.agent.agent import AgentAdapter
from hippodrome.trial.agent.callbacks import MAX_VALUES, Callbacks, Session, TrialFacts, listening
from hippodrome.trial.agent.joint import start
from hippodrome.trial.agent.signatures import NAMES
from hippodrome.trial.recordings import recording
from testing.waiting import until
from tests.trial.client_messages import play_to_the_end

FACTS = TrialFacts("trial-1", "3", 1)


def callbacks_of(agent, seconds=5.0, facts=FACTS, **more):
    """Return the callbacks of an agent, and the list of those that raised, with their errors."""
    raised = []
    callbacks = Callbacks(
        listening(agent),
        facts,
        lambda: "the environment",
        seconds=seconds,
        stamp=dict,
        failed=lambda name, error: raised.append((name, error)),
        **more,
    )
    return callbacks, raised


def recorded_lines(callbacks):
    return [json.loads(line) for line in callbacks.take()]


def play(callbacks, steps=2, why="terminated"):
    callbacks.session_begins()
    callbacks.episode_began(4, {"player_0": "first"}, {"player_0": {}})
    for step in range(1, steps + 1):
        callbacks.stepped({"player_0": 2}, {"player_0": 1.5}, {"player_0": step}, {"player_0": {"t": step}})
    callbacks.episode_ended(why)
    callbacks.session_ended()


class Noting:
    def __init__(self):
        self.sessions = []

    def on_session_start(self, session):
        self.sessions.append(("start", session))

    def on_episode_start(self, session):
        self.sessions.append(("episode", session))

    def on_tick(self, session):
        self.sessions.append(("tick", session))

    def on_episode_end(self, session):
        self.sessions.append(("over", session))

    def on_session_end(self, session):
        self.sessions.append(("end", session))


def test_callbacks_are_told_the_state_of_the_session():
    agent = Noting()
    callbacks, raised = callbacks_of(agent)
    play(callbacks)
    assert [name for name, _ in agent.sessions] == ["start", "episode", "tick", "tick", "over", "end"]
    tick = agent.sessions[2][1]
    assert (tick.trial, tick.step, tick.group, tick.players, tick.humans) == (
        "trial-1",
        "3",
        1,
        ("player_0",),
        ("player_0",),
    )
    assert (tick.episode, tick.ticks, tick.actions, tick.rewards) == (4, 1, {"player_0": 2}, {"player_0": 1.5})
    assert (tick.observations, tick.infos) == ({"player_0": 1}, {"player_0": {"t": 1}})
    assert (tick.scores, tick.why, tick.env) == ({"player_0": 1.5}, None, "the environment")
    over = agent.sessions[4][1]
    assert (over.ticks, over.scores, over.why) == (2, {"player_0": 3.0}, "terminated")
    assert not raised
    assert not recorded_lines(callbacks), "what returns nothing leaves no line"
    callbacks.close()


def test_values_that_callbacks_return_or_record_become_lines():
    class Agent:
        def on_tick(self, session):
            session.record("lean", session.ticks / 2)
            return {"seen": session.observations["player_0"]}

    callbacks, _ = callbacks_of(Agent())
    play(callbacks, steps=1)
    assert recorded_lines(callbacks) == [
        {"kind": "callback", "episode": 4, "step": 1, "name": "lean", "callback": "on_tick", "value": 0.5},
        {"kind": "callback", "episode": 4, "step": 1, "name": "on_tick", "callback": "on_tick", "value": {"seen": 1}},
    ]
    callbacks.close()


def test_the_lines_of_a_later_step_are_not_written_with_those_of_an_earlier_one():
    """The agent's thread may be at the next step when the event loop writes the lines of the last one."""

    class Agent:
        def on_tick(self, session):
            session.record("t", session.ticks)

    callbacks, _ = callbacks_of(Agent())
    callbacks.episode_began(1, {}, {})
    callbacks.stepped(*[{"player_0": 0}] * 4)
    recorded = callbacks.recorded
    callbacks.stepped(*[{"player_0": 0}] * 4)
    values = [[json.loads(line)["value"] for line in callbacks.take(*until)] for until in ([recorded], [recorded], [])]
    assert values == [[1], [], [2]]
    callbacks.close()


def test_a_callback_that_changes_its_session_changes_no_record():
    class Agent:
        def on_tick(self, session):
            for given in (session.actions, session.rewards, session.observations, session.infos, session.scores):
                given.clear()

    callbacks, raised = callbacks_of(Agent())
    values = [{"player_0": value} for value in (2, 1.5, "seen", {"t": 1})]
    callbacks.episode_began(1, {}, {})
    callbacks.stepped(*values)
    assert values == [{"player_0": value} for value in (2, 1.5, "seen", {"t": 1})]
    assert raised == []
    callbacks.close()


def test_a_callback_whose_attribute_raises_is_an_error_of_the_agents_start(launch, grid):
    server = launch(grid(5) + "\nclass Agent(Agent):\n    on_join = property(lambda self: 1 / 0)\n")
    assert server.wait() == exits.NO_AGENT
    assert "the agent cannot be started" in server.log_text()


def test_callbacks_of_feedback_joining_and_leaving_are_told_the_player():
    class Agent:
        def on_feedback(self, session, player, word):
            return [player, word]

        def on_join(self, session, player):
            return player

        on_leave = on_return = on_join

        def on_form(self, session, player, fields):
            return fields

    callbacks, _ = callbacks_of(Agent())
    callbacks.fed_back("player_0", "good")
    callbacks.of_player("on_form", "player_0", {"belief": "7"})
    for name in ("on_join", "on_leave", "on_return"):
        callbacks.of_player(name, "player_0")
    found = recorded_lines(callbacks)
    assert [(line["name"], line["value"]) for line in found] == [
        ("on_feedback", ["player_0", "good"]),
        ("on_form", {"belief": "7"}),
        ("on_join", "player_0"),
        ("on_leave", "player_0"),
        ("on_return", "player_0"),
    ]
    assert not [line for line in found if "player" in line]
    callbacks.close()


def test_with_several_humans_a_line_names_the_player_that_it_is_about():
    class Agent:
        def on_feedback(self, session, player, word):
            session.record("heard", word)
            raise ValueError(word)

        on_join = on_leave = lambda self, session, player: None

        def on_tick(self, session):
            return "tick"

    callbacks, _ = callbacks_of(
        Agent(), facts=TrialFacts("t-1", "3", players=("left", "right"), humans=("left", "right"))
    )
    callbacks.fed_back("right", "good")
    callbacks.stepped({}, {}, {}, {})
    found = [(line["callback"], line["name"], line.get("player")) for line in recorded_lines(callbacks)]
    assert found == [
        ("on_feedback", "heard", "right"),
        ("on_feedback", "on_feedback", "right"),
        ("on_tick", "on_tick", None),
    ]
    callbacks.close()


class ErrorWithoutText(Exception):
    def __str__(self):
        raise SystemExit


@pytest.mark.parametrize(
    "error", [ZeroDivisionError("by zero"), SystemExit(3), KeyboardInterrupt(), ErrorWithoutText()]
)
def test_a_callback_that_raises_is_reported_once_and_called_again(error):
    calls = []

    class Agent:
        def on_tick(self, session):
            calls.append(session.ticks)
            raise error

    callbacks, raised = callbacks_of(Agent())
    play(callbacks, steps=3)
    assert calls == [1, 2, 3]
    assert raised == [("on_tick", error)]
    (line,) = recorded_lines(callbacks)
    assert (line["name"], line["step"]) == ("on_tick", 1)
    assert line["error"].startswith(type(error).__name__)
    callbacks.close()


def test_the_game_does_not_wait_for_a_slow_callback_and_skips_others(caplog):
    go = threading.Event()
    came = threading.Event()

    class Agent:
        def on_tick(self, session):
            if session.ticks == 1:
                go.wait(20)
            return session.ticks

    callbacks, _ = callbacks_of(Agent(), seconds=0.05, late=lambda recorded: came.set())
    callbacks.episode_began(1, {}, {})
    with caplog.at_level(logging.WARNING, "trial"):
        began = time.monotonic()
        for _ in range(5):
            callbacks.stepped({}, {}, {}, {})
        assert time.monotonic() - began < 2
    assert len([r for r in caplog.records if "on_tick has not returned within callbackSeconds" in r.message]) == 1
    assert callbacks.busy
    assert not recorded_lines(callbacks)
    go.set()
    assert came.wait(60), "lines that come late are announced"
    assert [(line["step"], line.get("value"), line.get("skipped")) for line in recorded_lines(callbacks)] == [
        (1, 1, None),
        (1, None, 4),
    ]
    callbacks.stepped({}, {}, {}, {})
    until(lambda: not callbacks.busy)
    assert [(line["step"], line["value"]) for line in recorded_lines(callbacks)] == [(6, 6)]
    callbacks.close()


def test_a_callback_that_returns_just_as_its_time_ends_is_on_time_or_reported_as_late(monkeypatch):
    before = {*threading.enumerate()}

    class Returned(threading.Event):
        def wait(self, timeout=None):
            """The time is over; before the agent's thread can say so, the callback returns, and its thread goes on."""
            callbacks.close()
            for thread in {*threading.enumerate()} - before:
                thread.join(60)
            assert self.is_set()
            return False

    monkeypatch.setattr(callbacks_module, "threading", SimpleNamespace(**{**vars(threading), "Event": Returned}))
    announced = []
    callbacks, _ = callbacks_of(Noting(), late=announced.append)
    callbacks.episode_began(1, {}, {})
    assert (callbacks.first_late is not None) == bool(announced)


def test_the_amount_that_callbacks_record_is_limited():
    class Agent:
        def on_tick(self, session):
            session.record("small", 1)
            session.record("large", "x" * recording.MAX_EXTRA_BYTES)
            session.record("n" * 1_000, float("nan"))
            session.record("object", object)
            for _ in range(2 * MAX_VALUES):
                session.record("many", 0)

    callbacks, raised = callbacks_of(Agent())
    callbacks.stepped({}, {}, {}, {})
    found = recorded_lines(callbacks)
    assert not raised
    assert len(found) == MAX_VALUES
    assert found[0]["value"] == 1
    assert found[1]["value"] == {"tooLarge": recording.MAX_EXTRA_BYTES + 2}
    assert len(found[2]["name"]) == 200
    assert found[2]["value"] is None
    assert found[3]["value"] == "<class 'object'>"
    callbacks.close()


def test_lines_that_an_earlier_server_recorded_are_not_recorded_again():
    seen = []

    class Agent:
        def on_tick(self, session):
            session.record("a", 1)
            seen.append(session.replaying)
            return 2

    callbacks, _ = callbacks_of(Agent())
    callbacks.replaying = True
    callbacks.stepped({}, {}, {}, {})
    callbacks.replaying = False
    callbacks.stepped({}, {}, {}, {})
    assert seen == [True, False]
    assert [line["step"] for line in recorded_lines(callbacks)] == [2, 2]
    callbacks.close()


def test_an_agent_without_callbacks_has_none():
    assert not listening(object())
    callbacks, _ = callbacks_of(object())
    assert not callbacks
    play(callbacks)
    assert not callbacks.busy


# ---- on a real server

CALLBACKS = """
class Agent(Agent):
    on_session_start = lambda self, session: "begun"
    on_session_end = lambda self, session: "ended"
    on_episode_start = lambda self, session: session.episode
    on_episode_end = lambda self, session: [session.why, session.scores]
    on_join = lambda self, session, player: player
    on_leave = on_return = on_join
    on_feedback = lambda self, session, player, word: word
    def on_tick(self, session):
        session.record("t", session.env.t)
"""

TRIAL = {"maxEpisodes": 2, "startingFrameRate": 60, "maxFrameRate": 60, "ui": {"start": True, "good": True}}


WAITS = """
import os, time
class Agent(Agent):
    def step(self, action):
        while self.env.t == 20 and not os.path.exists("go_on"): time.sleep(0.02)
        return super().step(action)
"""


def recorded_values(found):
    return [(line["name"], line["value"]) for line in found if line["kind"] == "callback" and line["name"] != "t"]


async def test_a_real_recording_holds_the_values_that_callbacks_recorded(launch, grid, open_client):
    agent = grid(30) + CALLBACKS + WAITS
    server = launch(agent, {**TRIAL, "callbackSeconds": 10})  # the game waits, however busy the machine
    async with open_client(server.address) as client:
        await client.start()
        await client.say(command="good")
        await client.until(lambda: client.frames and client.state.get("episode") == 1 and len(client.frames) > 5)
    server.log.with_name("go_on").touch()
    await play_to_the_end(server, open_client)
    assert server.wait() == 0
    first, second = server.recordings().values()
    assert recorded_values(first) == [
        ("on_session_start", "begun"),
        ("on_episode_start", 1),
        ("on_join", "player_0"),
        ("on_feedback", "good"),
        ("on_leave", "player_0"),
        ("on_return", "player_0"),
        ("on_episode_end", ["terminated", {"player_0": 45.0}]),
    ]
    assert recorded_values(second) == [
        ("on_episode_start", 2),
        ("on_episode_end", ["terminated", {"player_0": 45.0}]),
        ("on_session_end", "ended"),
    ]
    for found in (first, second):
        assert [line["value"] for line in found if line.get("name") == "t"] == list(range(1, 31))
        assert found[-1]["kind"] == "end"
        steps = [(line["kind"], line["step"]) for line in found if line["kind"] == "step" or line.get("name") == "t"]
        assert steps == [(kind, step) for step in range(1, 31) for kind in ("step", "callback")]


async def test_a_callback_that_hangs_or_raises_does_not_end_the_game(launch, grid, open_client):
    agent = grid(20) + (
        "\nimport time\nclass Agent(Agent):\n"
        "    def on_tick(self, session):\n        raise ValueError('no such thing')\n"
        "    def on_episode_end(self, session):\n        while True: time.sleep(1)\n"
    )
    server = launch(agent, {**TRIAL, "callbackSeconds": 2})  # which on_tick does not need, even on a busy machine
    await play_to_the_end(server, open_client)
    assert server.wait() == 0
    assert server.answer()["answers"]["outcome"] == "finished"
    assert server.answer()["answers"]["frames"] == 40
    said = server.log_text()
    assert "agent.py:" in said
    assert said.count("ValueError: no such thing") == 1
    assert said.count("on_episode_end has not returned within callbackSeconds") == 1


async def test_slow_callbacks_do_not_hold_up_the_game_of_a_page_that_connects_again_and_again(
    launch, grid, open_client
):
    slow = "\nimport time\nclass Agent(Agent):\n    def on_join(self, session, player):\n        time.sleep(2)\n"
    agent = grid(20) + slow + "        return True\n    on_leave = on_return = on_join\n"
    server = launch(agent, {**TRIAL, "maxEpisodes": 1, "callbackSeconds": 10})
    for _ in range(40):
        async with open_client(server.address) as client:
            await client.hello()
            await client.until(lambda: client.controls)
    async with open_client(server.address) as client:
        await client.start()
        began = time.monotonic()
        await client.until(lambda: client.done)
        assert time.monotonic() - began < 60, "81 calls would take more than two minutes"
    assert server.wait() == 0
    (found,) = server.recordings().values()
    moves = [line["name"] for line in found if line["kind"] == "callback"]
    assert moves[:3] == ["on_join", "on_leave", "on_return"]
    assert moves[1:] == ["on_leave", "on_return"] * (len(moves) // 2), "each who is back has left"


RESUMED = """
class Agent(Agent):
    def on_session_start(self, session):
        self.seen = []
    def on_tick(self, session):
        self.seen.append(session.ticks)
        return len(self.seen)
"""


async def test_a_server_that_takes_over_rebuilds_what_callbacks_have_seen(launch, grid, open_client):
    deterministic = grid(60) + RESUMED + WAITS

    async def play_a_little(server):
        async with open_client(server.address) as client:
            await client.start()
            await client.until(lambda: len(client.frames) > 10)

    trial = {**TRIAL, "maxEpisodes": 1, "callbackSeconds": 10}  # the game waits, however busy the machine
    first = launch(deterministic, trial, SERVER="a-1")
    await play_a_little(first)
    first.terminate()
    first.log.with_name("go_on").touch()
    first.wait()
    second = launch(deterministic, trial, SERVER="a-2")
    await play_to_the_end(second, open_client)
    assert second.wait() == 0
    (early,), (late,) = (list(second.recordings(server=name).values()) for name in ("a-1", "a-2"))
    recorded = [[line["value"] for line in found if line["kind"] == "callback"] for found in (early, late)]
    assert recorded[0]
    assert recorded[0] + recorded[1] == list(range(1, 61))


def test_the_callbacks_of_the_documentation_run(tmp_path):
    text = (Path(__file__).parents[3] / "docs/callbacks.md").read_text()
    (tmp_path / "agent.py").write_text(text.split("```python\n")[1].split("```")[0])
    agent = AgentAdapter(tmp_path, "CartPole-v1", None)
    start(agent)
    callbacks, raised = callbacks_of(agent._agent)
    first, info, _ = agent.reset(1)
    callbacks.episode_began(1, {"player_0": first}, {"player_0": info})
    result = agent.step(1)
    callbacks.stepped({"player_0": 1}, {"player_0": 1.0}, {"player_0": result.observation}, {})
    callbacks.episode_ended("terminated")
    assert not raised
    assert [line["name"] for line in recorded_lines(callbacks)] == ["furthest", "on_episode_end"]
    for name in NAMES:
        assert f"`{name}(session" in text
    for name in (*(field.name for field in dataclasses.fields(Session) if field.name[0] != "_"), "talk"):
        assert f"`{name}" in text
    callbacks.close()
