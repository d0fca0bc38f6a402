"""Participants and the agent talk, on a real trial server."""

from __future__ import annotations

import asyncio

from tests.trial.conftest import grid_agent
from tests.trial.sessions import answer, launch_formed, member

TALKS = """
    def reply(self, session, player, text):
        return f"{player} says {text}"
"""
STREAMS = """
    def reply(self, session, player, text):
        for word in ("well", ", ", "yes"):
            import time; time.sleep(0.15)
            yield word
"""


async def say(client, number, text):
    await client.say(say={"id": number, "text": text})


async def test_two_participants_talk_also_before_the_game_and_each_line_is_said_once(launch):
    server = launch_formed(launch, trial={"chat": True, "playerNames": {"left": "Red"}})
    async with member(server, "anna") as anna:
        chat = anna.controls["chat"]
        assert (chat["me"], chat["with"], chat["names"], chat["maxLength"]) == ("left", ["right"], {"left": "Red"}, 500)
        await say(anna, 1, "Hello?")
        assert await anna.read(1) == [("left", "Hello?")]
        async with member(server, "bert") as bert:
            await anna.say(typing=True)
            await bert.until(lambda: bert.typing.get("left"))
            await say(anna, 2, "  Are you\x07 there? <b>&amp;</b> ")
            await say(anna, 2, "Are you there?")
            await bert.read(2)
            await say(bert, 1, "Yes\r\nI am")
            expected = [("left", "Hello?"), ("left", "Are you there? <b>&amp;</b>"), ("right", "Yes\nI am")]
            assert await bert.read(3) == expected
            assert await anna.read(3) == expected
            assert not bert.typing["left"]
            assert [line.get("id") for line in anna.lines.values()] == [1, 2, None]
            await anna.say(command="stop")
            await asyncio.gather(anna.closed(), bert.closed())


async def test_the_agent_answers_a_participant(launch, open_client):
    server = launch(agent=grid_agent() + TALKS, trial={"chat": True})
    async with open_client(server.address) as client:
        await client.enter()
        assert client.controls["chat"]["with"] == ["ai"]
        await say(client, 1, "Hi")
        assert await client.read(2) == [("player_0", "Hi"), ("ai", "player_0 says Hi")]
        assert not client.typing.get("ai")
    async with open_client(server.address) as again:
        await again.enter()
        assert await again.read(2) == [("player_0", "Hi"), ("ai", "player_0 says Hi")]


async def test_what_the_agent_yields_grows(launch, open_client):
    server = launch(agent=grid_agent() + STREAMS, trial={"chat": {"first": "ai"}})
    async with open_client(server.address) as client:
        await client.enter()
        await client.until(lambda: client.lines.get(1, {}).get("more"))
        assert await client.read(1) == [("ai", "well, yes")]


TALK_ALONE = """
class Agent:
    def reply(self, session, player, text):
        return f"{session.options['persona']}: {len(session.talk)}"
"""


async def test_a_game_of_words_alone_needs_no_environment_and_no_picture(launch, open_client):
    trial = {"game": "talk", "episodeSeconds": 3, "options": {"persona": "warm"}}
    server = launch(agent=TALK_ALONE, trial=trial)
    async with open_client(server.address) as client:
        await client.start()
        await say(client, 1, "Hi")
        assert await client.read(2) == [("player_0", "Hi"), ("ai", "warm: 1")]
        assert client.controls["chat"]["with"] == ["ai"]
        assert client.controls["frameRate"] == 1
        assert client.controls["UI"] == ["start"]
        assert await client.closed() == 1000
    answers = server.answer()["answers"]
    assert (answers["episodes"], answers["talk"]["lines"]) == (1, 1)
    assert 2 <= answers["frames"] <= 4


async def test_the_second_round_of_two_begins_with_all_its_time(launch):
    players = {"buyer": "human", "seller": "human"}
    trial = {"game": "talk", "episodeSeconds": 2, "maxEpisodes": 2, "betweenEpisodes": 0.5, "players": players}
    server = launch_formed(
        launch, agent="class Agent:\n    def on_episode_end(self, session):\n        pass\n", trial=trial
    )
    async with member(server, "anna") as anna, member(server, "bert"):
        await anna.until(lambda: anna.state.get("episode") == 2 and anna.state["state"] == "playing")
        assert anna.state["timeLeft"] > 1, anna.state
        await anna.say(command="stop")
        await anna.closed()


DEALS = """
class Agent:
    def moderate(self, session, player, text):
        if text == "Deal":
            session.env.end({"buyer": 20, "seller": 30}, success=True)
"""


async def test_an_agent_ends_the_game_when_people_agree(launch):
    players = {"buyer": "human", "seller": "human"}
    trial = {"game": "talk", "episodeSeconds": 600, "maxEpisodes": 5, "until": {"success": 1}, "players": players}
    server = launch_formed(launch, agent=DEALS, trial=trial)
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await anna.until(lambda: anna.state["state"] == "playing")
        await say(anna, 1, "Deal")
        assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]
    scores = {user: answer(server.store, user)["answers"]["score"] for user in ("anna", "bert")}
    assert scores == {"anna": 20, "bert": 30}


async def test_two_participants_talk_without_an_agent(launch):
    players = {"buyer": "human", "seller": "human"}
    trial = {
        "game": "talk",
        "episodeSeconds": 60,
        "players": players,
        "chat": {"turns": "alternate", "first": "seller"},
    }
    server = launch_formed(launch, agent="class Agent:\n    pass\n", trial=trial)
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await anna.until(lambda: anna.turn == "seller")
        await say(anna, 1, "I begin")
        await anna.until(lambda: anna.refused)
        assert anna.refused == [{"id": 1, "why": "notYourTurn"}]
        await say(bert, 1, "100?")
        await anna.until(lambda: anna.turn == "buyer")
        await say(anna, 2, "50")
        await say(anna, 3, "please")
        assert await bert.read(2) == [("seller", "100?"), ("buyer", "50")]
        await anna.until(lambda: len(anna.refused) == 2 and anna.turn == "seller")
        await anna.say(command="stop")
        assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]


NOISY = """
    def on_tick(self, session):
        for number in range(100):
            session.say(f"\\x1b[31m{number} <img src=x onerror=alert(1)> \\ud800 {{{{ 7 * 7 }}}}")

    def reply(self, session, player, text):
        raise ValueError(text)
"""


async def test_an_agent_that_shouts_does_not_slow_the_game_and_what_people_type_is_in_no_log(launch, open_client):
    server = launch(agent=grid_agent() + NOISY, trial={"chat": True, "ui": {"start": True, "stop": True}})
    async with open_client(server.address) as client:
        await client.start()
        await say(client, 1, "a private secret")
        await client.see(60)
        lines = len(client.lines)
        began, ended = client.frames[-50][0], client.frames[-1][0]
        assert ended - began < 10, "50 frames, which take 1.7 s"
        assert 1 < lines < 200
        assert client.lines[max(client.lines)]["text"].startswith("[31m")
        await client.stop()
    assert "too many lines" in server.log_text()
    assert "reply failed: ValueError at agent.py:" in server.log_text()
    assert "secret" not in server.log_text()


async def test_in_two_tabs_the_second_one_talks_on(launch, open_client):
    server = launch(agent=grid_agent() + TALKS, trial={"chat": True})
    async with open_client(server.address) as first, open_client(server.address) as second:
        await first.enter()
        await say(first, 1, "Hi")
        await first.read(2)
        await second.enter()
        assert await first.closed() == 4409
        assert len(await second.read(2)) == 2
        await say(second, 2, "You")
        assert (await second.read(4))[-1] == ("ai", "player_0 says You")
