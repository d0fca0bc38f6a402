"""After a server is lost, nothing that was said is lost, and nothing is said twice."""

from __future__ import annotations

import json
import signal

import pytest

from tests.trial.conftest import grid_agent

AGENT = (
    grid_agent()
    + """
    def reply(self, session, player, text):
        self.said = [*getattr(self, "said", []), text]
        with open(LOG, "a") as log:
            print(text, session.replaying, [line['text'] for line in session.talk], file=log)
        if text == "Wait":
            import time; time.sleep(60)
        return " ".join(self.said)
"""
)


def tape(server, name):
    """The records that a server has stored."""
    pieces = sorted((server.store / "study/users/P1/trials" / name).glob("3-talk-*.json"))
    return [record for piece in pieces for record in json.loads(piece.read_text())["records"]]


async def say(client, number, text):
    await client.say(say={"id": number, "text": text})


@pytest.mark.parametrize("killed", [False, True])
async def test_lines_are_there_again_and_the_agent_remembers_them(launch, open_client, tmp_path, killed):
    agent = AGENT.replace("LOG", repr(str(tmp_path / "asked")))
    trial = {"chat": True, "ui": {"start": True, "stop": True}}
    first = launch(agent=agent, trial=trial, SERVER="a-1")
    async with open_client(first.address) as client:
        await client.play(5)
        await say(client, 1, "Hi")
        await client.read(2)
        await client.see(10)
        await say(client, 2, "You")
        expected = await client.read(4)
        await client.see(5)
        if killed:
            await client.until(lambda: len(tape(first, "a-1")) == 4)
            first.process.send_signal(signal.SIGKILL)
        else:
            await say(client, 3, "Wait")
            expected = [*expected, *(await client.read(5))[4:]]
            first.terminate()
        await client.closed()
    first.process.wait(60)
    (tmp_path / "asked").unlink()
    second = launch(agent=agent.replace("sleep(60)", "sleep(0)"), trial=trial, SERVER="a-2")
    async with open_client(second.address) as client:
        await client.enter()
        await say(client, 2, "You")
        said = await client.read(4 if killed else 6)
        assert said[: len(expected)] == expected
        if not killed:
            assert said[5] == ("ai", "Hi You Wait"), "a line that was not answered is answered now"
        await say(client, 4, "Still there?")
        await client.read(len(said) + 2)
        await client.say(command="start")
        await client.see(3)
        await client.say(command="stop")
        assert await client.closed() == 1000
    asked = (tmp_path / "asked").read_text().splitlines()
    if killed:  # the episode's recording was lost with the server's process, so it begins again
        assert asked == ["Still there? False ['Hi', 'Hi', 'You', 'Hi You', 'Still there?']"]
    else:
        assert asked[:2] == ["Hi True ['Hi']", "You True ['Hi', 'Hi', 'You']"]
        assert asked[2].startswith("Wait False")
    assert second.answer()["answers"]["talk"] == {"lines": 3 if killed else 4, "fallbacks": 0}
    assert {record["kind"] for record in tape(second, "a-2")} == {"line"}
    assert [record["n"] for record in tape(first, "a-1") + tape(second, "a-2")] == list(range(1, len(said) + 3))
