"""The agent's `reply` and `moderate`: slow, broken and hostile ones."""

from __future__ import annotations

import asyncio
import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest

from hippodrome.trial.agent import replies
from hippodrome.trial.agent.replies import Mouth, NoChat, Replies
from hippodrome.trial.core.effects import AskReply, Moderate
from hippodrome.trial.core.talk import MAX_SAID
from testing.async_tests import pytest_pyfunc_call  # noqa: F401 - a hook
from testing.waiting import PATIENCE


class Heard:
    """Asks `reply` or `moderate`, and keeps what they say."""

    def __init__(self, reply: Any = None, moderate: Any = None, fallback: str | None = None) -> None:
        self.said: list[Any] = []
        self.grown: list[str] = []
        self.failed: list[str] = []
        self.replies = Replies(
            reply,
            moderate,
            lambda name, player, n: name,
            grows=lambda ask_id, text: self.grown.append(text),
            ended=lambda ask_id, text: self.said.append(text),
            moderated=lambda ask_id, result: self.said.append(result),
            failed=lambda name, error: self.failed.append(f"{name} {type(error).__name__}"),
            fallback=fallback,
        )

    async def ask(self, *texts: str, moderate: bool = False) -> list[Any]:
        for text in texts:
            if moderate:
                self.replies.check(Moderate(1, "red", text))
            else:
                self.replies.ask(AskReply(1, "red", text, 1))
        async with asyncio.timeout(PATIENCE):
            while len(self.said) < len(texts):
                await asyncio.sleep(0.01)
        return self.said


def repeats(times: int) -> Any:
    def reply(session: Any, player: str, text: str) -> Any:
        for _ in range(times):
            yield text

    return reply


def fails(session: Any, player: str, text: str) -> Any:
    yield "partly"
    raise SystemExit(text)


async def test_ten_megabytes_and_endless_streams_are_cut_off():
    assert len((await Heard(lambda *_: "x" * 10_000_000).ask("a"))[0]) <= 2 * MAX_SAID
    assert len((await Heard(repeats(10**12)).ask("more"))[0]) == MAX_SAID
    assert len((await Heard(repeats(3)).ask("y" * 10_000_000))[0]) == MAX_SAID


async def test_a_reply_that_raises_or_says_what_is_no_text_gives_the_fallback():
    heard = Heard(lambda *_: 5, fallback="Sorry")
    assert await heard.ask("a", "b") == ["Sorry", "Sorry"]
    assert heard.failed == ["reply TypeError"] * 2
    assert heard.replies.fallbacks == 2
    assert await Heard(lambda *_: 1 / 0).ask("a") == [""]
    assert await Heard(fails, fallback="Sorry").ask("a") == ["partly"], "what was shown stays"
    assert await Heard(lambda *_: [b"bytes"], fallback="Sorry").ask("a") == ["Sorry"]


async def test_a_reply_that_never_returns_is_given_up_and_later_lines_are_answered(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(replies, "REPLY_SECONDS", 0.3)
    for_ever = threading.Event()
    heard = Heard(lambda session, player, text: for_ever.wait() if text == "hang" else text, fallback="Sorry")
    try:
        assert await heard.ask("hang", "Hi") == ["Sorry", "Hi"]
        assert heard.replies.busy
        heard.said.clear()
        assert await heard.ask(*["hang"] * 6) == ["Sorry"] * 6, "five threads that hang are enough"
    finally:
        for_ever.set()


async def test_slow_calls_that_return_do_not_end_replies_for_good(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(replies, "REPLY_SECONDS", 0.2)
    returns = threading.Event()
    heard = Heard(lambda session, player, text: returns.wait() if text == "slow" else text, fallback="Sorry")
    try:
        assert await heard.ask(*["slow"] * 5) == ["Sorry"] * 5
        heard.said.clear()
        assert await heard.ask("Hi") == ["Sorry"]
    finally:
        returns.set()
    async with asyncio.timeout(PATIENCE):
        while heard.replies.busy:
            await asyncio.sleep(0.01)
    heard.said.clear()
    assert await heard.ask("Hi") == ["Hi"]


async def test_a_line_is_held_back_if_moderate_is_slow_or_broken(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(replies, "MODERATE_SECONDS", 0.2)

    def moderate(session: Any, player: str, text: str) -> Any:
        if text == "slow":
            time.sleep(1)
        return {"rude": False, "bad": "***", "odd": 7}.get(text)

    heard = Heard(moderate=moderate)
    assert await heard.ask("fine", "rude", "bad", "odd", "slow", moderate=True) == [None, False, "***", False, False]
    assert heard.failed == ["moderate TypeError", "moderate AgentTimeout"]


async def test_the_agent_speaks_to_those_who_are_there_and_in_no_participants_name():
    said: list[Any] = []
    talk: Any = SimpleNamespace(people=("red", "blue"))
    mouth = Mouth(lambda: talk, lambda *line: said.append(line))
    mouth.say("Hi")
    mouth.say("Psst", to="red", by="guide")
    with pytest.raises(ValueError, match="nobody is called 'green'; there are red, blue"):
        mouth.say("Hi", to=["red", "green"])
    with pytest.raises(ValueError, match="cannot speak as 'red'"):
        mouth.say("I am red", by="red")
    with pytest.raises(TypeError, match="takes a text, not int"):
        mouth.say(5)  # type: ignore[arg-type]
    await asyncio.sleep(0)
    assert said == [("Hi", None, None), ("Psst", ("red",), "guide")]
    talk = None
    with pytest.raises(NoChat, match="write chat: true"):
        mouth.say("Hi")
