"""The break between two episodes: the score is shown, no key acts, and the agent is not called."""

import time
from itertools import groupby

import pytest

from hippodrome.trial.core.history import Break, Episode, RecordedTrial
from hippodrome.trial.core.players import PLAYER, alone
from hippodrome.trial.core.progress import PlayState, TrialProgress
from hippodrome.trial.recordings import recording
from hippodrome.trial.recordings.resume import add_lines
from hippodrome.trial.settings import trial_section

SPACE = ("noop", "up", "right", "left", "down", "upright")
UI = dict.fromkeys(("left", "right", "up", "start", "pause", "reset", "stop", "good"), True)
LONG = {"maxEpisodes": 2, "startingFrameRate": 60, "betweenEpisodes": 600, "ui": UI}


def game_in_a_break(**keys):
    game = TrialProgress(trial_section({"maxEpisodes": 3, **keys}), alone(SPACE))
    game.start()
    game.began()
    game.act("left", True)
    game.stepped({PLAYER: 2.0}, True, False)
    return game


def test_the_break_shows_the_episode_that_is_over_and_then_the_next_begins():
    game = game_in_a_break()
    assert (game.state, game.episode, game.episode_score) == (PlayState.BREAK, 1, 2.0)
    assert not game.playing
    assert not game.needs_reset, "the environment is left alone"
    game.go_on()
    assert (game.state, game.episode, game.episode_score, game.score) == (PlayState.PLAYING, 2, 0.0, 2.0)
    assert game.needs_reset
    assert game.ended == [Episode(1, 1, 2.0, "terminated"), Break(1, "over")]


def test_keys_held_when_an_episode_ends_do_nothing_in_the_next():
    game = game_in_a_break()
    game.go_on()
    assert not game.next_actions()[PLAYER].human


def test_keys_tapped_in_a_break_do_nothing_and_those_held_at_its_end_act():
    game = game_in_a_break()
    game.act("up", True)
    game.act("up", False)
    game.act("left", None)
    game.act("right", True)
    game.go_on()
    assert [game.next_actions()[PLAYER].name for _ in range(2)] == ["right", "right"]


@pytest.mark.parametrize(
    ("command", "state", "why"),
    [("start", PlayState.PLAYING, "start"), ("pause", PlayState.PAUSED, "pause"), ("leave", PlayState.PAUSED, "left")],
)
def test_start_pause_and_leaving_end_a_break_early(command, state, why):
    game = game_in_a_break()
    getattr(game, command)()
    assert (game.state, game.episode, game.needs_reset) == (state, 2, True)
    assert game.ended[-1] == Break(1, why)


def test_a_stop_in_a_break_ends_no_episode_twice():
    game = game_in_a_break()
    game.stop()
    assert game.outcome == "stopped"
    assert game.ended == [Episode(1, 1, 2.0, "terminated"), Break(1, "stop")]
    assert game.episodes_played == 1


def test_a_reset_in_a_break_changes_nothing():
    game = game_in_a_break()
    game.reset()
    assert (game.state, game.episode) == (PlayState.BREAK, 1)


def test_there_is_no_break_after_the_last_episode_in_a_held_game_or_of_zero_seconds():
    assert game_in_a_break(maxEpisodes=1).over
    assert game_in_a_break(betweenEpisodes=0).playing
    game = TrialProgress(trial_section({}), alone(SPACE))
    game.start()
    game.began()
    game.stepped({PLAYER: 1.0}, False, False)
    game.pause()
    game.reset()
    assert (game.state, game.episode) == (PlayState.PAUSED, 2)


def test_a_break_follows_a_participants_reset_too():
    game = TrialProgress(trial_section({}), alone(SPACE))
    game.start()
    game.began()
    game.stepped({PLAYER: 1.0}, False, False)
    game.reset()
    assert game.on_break


# ---- on a real server


def kinds(lines):
    return [line["kind"] for line in lines if line["kind"] != "step"]


async def play_until_the_break(client):
    """Play until the first break; return when the start was sent (monotonic seconds)."""
    await client.enter()
    began = time.monotonic()
    await client.say(command="start")
    await client.until(lambda: client.state["state"] == "break")
    return began


async def test_a_client_is_told_of_a_break_that_lasts_its_time(launch, open_client, grid):
    server = launch(grid(8), {"maxEpisodes": 3, "startingFrameRate": 60, "betweenEpisodes": 0.5})
    launched = time.monotonic()
    async with open_client(server.address) as client:
        began = await play_until_the_break(client)
        told = client.state
        await client.until(lambda: client.state["state"] == "playing")
        lasted = time.monotonic() - began
        await client.until(lambda: client.done)
        elapsed = time.monotonic() - launched
    assert (told["episode"], told["score"], told["episodeScore"]) == (1, 12, 12)
    assert 0.3 < told["nextIn"] <= 0.5
    assert lasted > 0.5
    states = [state for state, _ in groupby(client.states)]
    assert states == ["playing", "break", "playing", "break", "playing", "ended"]
    assert server.wait() == 0
    answers = server.answer()["answers"]
    assert (answers["episodes"], answers["frames"], answers["score"]) == (3, 24, 36)
    assert answers["seconds"] < elapsed - 0.9, "the time of breaks is not time of play"
    recorded = server.recordings()
    assert [kinds(lines) for lines in recorded.values()] == [
        ["header", "reset", "end", "break"],
        ["header", "reset", "end", "break"],
        ["header", "reset", "end"],
    ]
    assert [lines[-1]["why"] for lines in recorded.values()] == ["over", "over", "terminated"]


async def test_the_game_stands_still_in_a_break_and_feedback_belongs_to_the_episode_before(
    launch, open_client, grid, tmp_path
):
    calls = tmp_path / "calls.txt"
    spy = (
        f"\n_f = open({str(calls)!r}, 'a', buffering=1)\n"
        "def _spied(name, method):\n"
        "    def call(self, *args, **kwargs):\n        _f.write(name + '\\n')\n        return method(self, *args, **kwargs)\n"
        "    return call\n"
        "for _name in ('step', 'reset', 'render', 'feedback'):\n"
        "    setattr(Agent, _name, _spied(_name, getattr(Agent, _name)))\n"
    )
    server = launch(grid(8) + spy, LONG)
    async with open_client(server.address) as client:
        await play_until_the_break(client)
        await client.until(lambda: client.frame[8, 8, 0] == 255)  # the picture of the last step
        before, frames = calls.read_text(), len(client.frames)
        await client.say(action="left", held=True)
        await client.say(action="up")
        await client.say(command="good")
        await client.watch(0.4)
        assert calls.read_text() == before
        assert len(client.frames) == frames
        await client.say(command="requestUI")
        await client.until(lambda: "UI" in client.state)
        assert 590 < client.state["nextIn"] < 600
        await client.say(command="start")
        await client.until(lambda: client.done)
    assert client.errors == []
    server.wait()
    assert calls.read_text().split().count("feedback") == 1
    first, second = server.recordings().values()
    assert [m.get("command") for m in first[-1]["messages"] if "command" in m] == ["good", "start"]
    steps = [line for line in second if line["kind"] == "step"]
    assert {line["actionName"] for line in steps} == {"left"}, "the key that is held when it goes on acts"
    words = calls.read_text().split()
    assert words[words.index("feedback") + 1] == "reset"


@pytest.mark.parametrize("how", ["pause", "disconnect"])
async def test_after_leaving_in_a_break_the_next_episode_waits(launch, open_client, grid, how):
    server = launch(grid(8), LONG)
    async with open_client(server.address) as client:
        await play_until_the_break(client)
        if how == "pause":
            await client.say(command="pause")
            await client.until(lambda: client.state["state"] == "paused")
            assert client.state["episode"] == 2
    async with open_client(server.address) as client:
        await client.enter()
        if client.state["state"] != "paused" or client.state["episode"] != 2:
            await client.until(lambda: client.state["state"] == "paused" and client.state["episode"] == 2)
        await client.say(command="start")
        await client.until(lambda: client.done)
        assert client.done["episodes"] == 2


@pytest.mark.parametrize("kill", [True, False])
async def test_a_game_whose_server_is_lost_in_a_break_goes_on_with_the_next_episode(launch, open_client, grid, kill):
    first = launch(grid(8), LONG, SERVER="a-1")
    async with open_client(first.address) as client:
        await play_until_the_break(client)
        await client.say(command="good")
        if kill:
            (part,) = first.store.rglob("*.part")
            while kinds(recording.read(part.read_bytes()))[-1:] != ["end"]:  # it is written every half second
                await client.watch(0.05)
            first.process.kill()
        else:
            first.terminate()
            assert await client.closed() == 1001
    first.wait()
    for part in first.store.rglob("*.part"):
        part.rename(part.with_suffix(""))
    (lines,) = first.recordings(server="a-1").values()
    assert kinds(lines) == ["header", "reset", "end"] + ([] if kill else ["break"])
    if not kill:
        assert lines[-1]["why"] == "shutdown"
        assert any(message.get("command") == "good" for message in lines[-1]["messages"])
    second = launch(grid(8), LONG, SERVER="a-2")
    async with open_client(second.address) as client:
        await client.enter()
        assert (client.state["state"], client.state["episode"], client.state["score"]) == ("ready", 2, 12)
        await client.say(command="start")
        await client.until(lambda: client.done)
    assert client.errors == []
    assert client.done == {"done": True, "episodes": 2, "score": 24}


async def test_a_stop_in_a_break_is_remembered_by_the_next_server(launch, open_client, grid):
    first = launch(grid(8), LONG, SERVER="a-1")

    async def play(server, start):
        async with open_client(server.address) as client:
            if start:
                await play_until_the_break(client)
                await client.say(command="stop")
            else:
                await client.hello()
            await client.until(lambda: client.done)

    await play(first, True)
    first.wait()
    assert first.answer()["answers"]["outcome"] == "stopped"
    (first.store / "study/users/P1/answers/3.json").unlink()  # as if the server had been lost just before
    second = launch(grid(8), LONG, SERVER="a-2")
    await play(second, False)
    assert second.answer()["answers"]["outcome"] == "stopped"
    assert second.answer()["answers"]["score"] == 12


async def test_the_deadline_ends_a_break(launch, open_client, grid):
    server = launch(grid(8), LONG, DEADLINE=str(time.time() + 10))
    async with open_client(server.address) as client:
        await play_until_the_break(client)
        assert await client.closed() == 1001
    assert server.wait() == 0
    assert not server.answered()


async def test_a_client_without_the_subprotocol_plays_through_a_break(launch, open_client, grid):
    server = launch(grid(8), {"maxEpisodes": 2, "startingFrameRate": 60, "betweenEpisodes": 0.3})
    async with open_client(server.address, subprotocols=None) as client:
        await client.hello()
        await client.say(command="start")
        assert await client.closed() == 1000
        assert client.done == "done"


def test_an_episode_is_over_if_its_last_step_is_recorded_but_not_its_end():
    past = RecordedTrial()
    add_lines(past, [{"kind": "reset", "episode": 1, "seed": 7}])
    step = {"kind": "step", "episode": 1, "human": None, "action": 0, "reward": 2.0}
    add_lines(
        past, [{**step, "terminated": False, "truncated": False}, {**step, "terminated": False, "truncated": True}]
    )
    assert past.unfinished is None
    assert past.ended == [Episode(1, 2, 4.0, "truncated")]
    add_lines(past, [{"kind": "end", "episode": 1, "why": "truncated"}])
    assert len(past.ended) == 1
