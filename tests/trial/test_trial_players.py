"""A participant and a policy on a real server: who acts, what is shown and recorded, and policies that fail."""

from __future__ import annotations

import hashlib
import itertools
import re
import statistics
import time

import pytest

from testing import onnx_files
from tests.trial.two_players import TRIAL, two_players


async def play_and_end(server, open_client, *, frames=8, keys=(), stop=False):
    """Play until `frames` pictures have come, with these keys held; end the server; return the client."""
    async with open_client(server.address) as client:
        await client.start()
        for key in keys:
            await client.say(action=key, held=True)
        seen = len(client.frames)
        await client.until(lambda: len(client.frames) >= seen + frames or client.done)
        server.terminate()
        await client.closed()
    assert server.wait() == 0
    return client


def steps(server, name="a1"):
    lines = [line for found in server.recordings(server=name).values() for line in found]
    return [line for line in lines if line["kind"] == "step"]


async def test_a_partner_of_agent_py_plays_beside_the_participant(launch, open_client):
    server = launch(two_players(), trial=TRIAL | {"startingFrameRate": 5})
    client = await play_and_end(server, open_client, frames=6, keys=["up"])
    assert client.errors == [], server.log_text()
    assert (client.controls["player"], client.controls["players"]) == ("left", ["left", "right"])
    lines = steps(server)
    parts = [line["players"] for line in lines]
    partners = [part["right"] for part in parts]
    prompt = [part for part in partners if part["by"] == "policy"]
    assert len(prompt) > len(partners) / 2
    assert [part["action"] for part in prompt] == [number % 3 for number in range(1, len(prompt) + 1)]
    for step, (before, part) in enumerate(itertools.pairwise(partners), 1):
        if (before["by"], part["by"]) == ("policy", "policy"):
            assert part["observed"] == step, "asked after each step"
    assert parts[-1]["left"] == {"action": 1, "actionName": "up", "by": "human", "reward": 1.0}
    assert (lines[-1]["action"], lines[-1]["by"], lines[-1]["reward"]) == (1, "human", 1.0), "as with one player"
    assert lines[-1]["human"] == 1
    total = sum(line["reward"] for line in lines)
    assert client.state["score"] in (total, total - lines[-1]["reward"]), "their own; the last step may end unseen"


async def test_the_head_of_a_recording_says_who_plays(launch, open_client):
    server = launch(two_players(), trial=TRIAL)
    await play_and_end(server, open_client, frames=2)
    head, reset = next(iter(server.recordings().values()))[:2]
    assert head["players"] == {"left": {"kind": "human"}, "right": {"kind": "policy", "policy": "agent:Partner"}}
    assert reset["toAct"] == ["left", "right"]


async def test_the_head_of_a_recording_says_by_which_rules_players_act(launch, open_client):
    rules = {"frameSkip": 3, "input": "single", "idleAction": {"right": "down"}, "seed": 4}
    server = launch(two_players(), trial=TRIAL | rules)
    await play_and_end(server, open_client, frames=2)
    head, reset = next(iter(server.recordings().values()))[:2]
    assert (head["frameSkip"], head["input"], head["pace"]) == (3, "single", "realtime")
    assert head["idleActions"] == {"left": 0, "right": 2}
    seed = int.from_bytes(hashlib.sha256(b"4\0right").digest()[:8], "big") % 2**31
    assert reset["players"] == {"left": {}, "right": {"seed": seed}}


async def test_a_recording_with_several_players_ends_with_all_scores(launch, open_client):
    server = launch(two_players(length=4), trial=TRIAL | {"seed": 14, "maxEpisodes": 2, "startingFrameRate": 60})
    async with open_client(server.address) as client:
        await client.play(1)
        await client.until(lambda: client.done)
    assert server.wait() == 0
    episodes = list(server.recordings().values())
    paid = [[line["players"]["right"]["reward"] for line in lines if line["kind"] == "step"] for lines in episodes]
    ends = [line["scores"] for lines in episodes for line in lines if line["kind"] == "end"]
    assert [len(rewards) for rewards in paid] == [4, 4]
    assert ends == [{"left": 0, "right": sum(rewards)} for rewards in paid]
    assert server.answer()["answers"]["scores"] == {"left": 0, "right": sum(map(sum, paid))}
    assert client.done["score"] == 0
    heads = [found[0] for found in server.recordings().values()]
    assert [head["seed"] for head in heads] == [14, 15], "seed: the first; each after it has the next"


async def test_a_slow_policy_is_late_and_delays_no_step(launch, open_client):
    server = launch(two_players(act="time.sleep(0.2)"), trial=TRIAL | {"startingFrameRate": 20})
    await play_and_end(server, open_client, frames=30)
    lines = steps(server)
    parts = [line["players"]["right"] for line in lines]
    assert "late" in {part["by"] for part in parts}
    fresh = [number for number, part in enumerate(parts) if part["by"] == "policy"]
    assert fresh, "what comes late is used after all"
    for before, late in itertools.pairwise(parts):
        if late["by"] == "late":
            assert late["action"] == before["action"], "its last action goes on"
    times = [line["ns"] / 1e9 for line in lines]
    gaps = [later - earlier for earlier, later in itertools.pairwise(times)]
    assert statistics.median(gaps) < 0.1, "a step takes 0.05 s, and the policy 0.2 s"


@pytest.mark.parametrize(
    ("act", "said"),
    [
        ("raise ValueError('no idea')", "ValueError: no idea"),
        ("return 7", "7"),
        ("return float('nan')", "nan"),
        ("return None", "None"),
    ],
)
async def test_a_policy_that_fails_is_logged_once_and_the_game_goes_on(launch, open_client, act, said):
    server = launch(two_players(act=act), trial=TRIAL | {"startingFrameRate": 10})
    client = await play_and_end(server, open_client, frames=8)
    assert client.errors == [], "the participant can do nothing about it"
    parts = [line["players"]["right"] for line in steps(server)]
    assert len(parts) >= 6
    assert {part["action"] for part in parts} == {0}, "it idles"
    assert {part["by"] for part in parts} <= {"none", "late"}
    assert parts[-1]["by"] == "none"
    (told,) = [
        line for line in server.log_text().splitlines() if "the policy of right (agent:Partner) failed: " in line
    ]
    assert said in told
    assert "it idles until the episode is over" in server.log_text()
    lines = [line for found in server.recordings().values() for line in found]
    assert any(line["kind"] == "error" and line.get("player") == "right" for line in lines)


async def test_the_log_of_a_policy_that_fails_does_not_hold_the_participants_id(launch, open_client):
    server = launch(two_players(act="raise ValueError('not for ' + __import__('os').environ['USER_ID'])"), trial=TRIAL)
    await play_and_end(server, open_client)
    assert "ValueError: not for (participant)" in server.log_text()
    assert "P1" not in server.log_text()


async def test_a_policy_that_hangs_delays_no_step(launch, open_client):
    server = launch(two_players(act="time.sleep(3600)"), trial=TRIAL | {"startingFrameRate": 30})
    began = time.monotonic()
    await play_and_end(server, open_client, frames=15)
    assert time.monotonic() - began < 12
    assert {line["players"]["right"]["by"] for line in steps(server)} == {"late"}


async def test_a_server_ends_well_although_a_policys_file_takes_hours(launch, open_client, tmp_path):
    onnx_files.endless(tmp_path / "agent/policies/p.onnx")
    players = {"left": "human", "right": "policies/p.onnx"}
    server = launch(two_players(length=5), trial=TRIAL | {"players": players, "maxEpisodes": 1})
    async with open_client(server.address) as client:
        await client.play(1)
        await client.until(lambda: client.done)
    assert server.wait() == 0, server.log_text()
    assert {line["players"]["right"]["by"] for line in steps(server)} == {"late"}


@pytest.mark.parametrize(
    ("players", "said"),
    [
        ({"left": "human"}, 'trial.players must say who plays "right"; the environment has "left", "right"'),
        ({"left": "human", "rihgt": "random"}, 'trial.players names "rihgt", but the environment has "left", "right"'),
        ({"left": "human", "right": "agent:Nobody"}, "Nobody"),
        ({"left": "human", "right": "policies/gone.onnx"}, "there is no file policies/gone.onnx"),
    ],
)
async def test_players_that_do_not_fit_are_named_before_the_game(launch, open_client, players, said):
    server = launch(two_players(), trial={**TRIAL, "players": players})
    async with open_client(server.address) as client:
        await client.hello()
        assert await client.closed() == 1011
    assert server.wait() == 3, "the agent cannot be started"
    assert said in server.log_text()
    assert "Traceback" not in server.log_text()


async def test_the_next_game_step_of_the_study_has_policies_of_its_own(launch, open_client):
    trial = TRIAL | {"maxEpisodes": 1, "startingFrameRate": 10}
    server = launch(two_players(length=3), trial=trial, GAME_STEPS="2,3")

    async def run(step):
        async with open_client(server.address) as client:
            await client.start(step=step)
            await client.until(lambda: client.done)

    for step in ("2", "3"):
        await run(step)
    assert server.wait() == 0
    for step in ("2", "3"):
        (lines,) = server.recordings(f"{step}-*.gz").values()
        asked = [line["players"]["right"]["by"] for line in lines if line["kind"] == "step"]
        assert len(asked) == 3
        assert "policy" in asked, server.log_text()


# ---- an interrupted game


async def test_an_interrupted_game_of_two_players_goes_on_where_it_was(launch, open_client):
    trial = TRIAL | {"startingFrameRate": 20, "frameSkip": 2}
    first = launch(two_players(), trial=trial, SERVER="a-1")
    await play_and_end(first, open_client, frames=9, keys=["down"])
    before = steps(first, "a-1")
    second = launch(two_players(), trial=trial, SERVER="a-2")
    await play_and_end(second, open_client, frames=6)
    after = steps(second, "a-2")
    assert [line["step"] for line in before + after] == list(range(1, len(before + after) + 1)), second.log_text()
    parts = [line["players"]["right"] for line in before + after]
    fresh = [part for part in parts if "observed" in part]
    asked = [part["action"] for part in fresh]
    assert asked == [number % 3 for number in range(1, len(asked) + 1)], "the partner remembers what it saw"
    observed = [part["observed"] for part in fresh]
    earlier = [(part["observed"], part["action"]) for part in parts[: len(before)] if "observed" in part]
    _, told, later = second.log_text().partition(f"told of {earlier}\n")
    assert told, second.log_text()
    questions = [int(step) for step in re.findall(r"asked at (\d+)", later)]
    assert (len(questions), min(questions)) >= (2, len(before)), "no question is put twice"
    every_second = range(0, len(parts), 2)
    # A partner that is late is not asked again meanwhile, and an answer after a server's last step counts nowhere.
    lasting = [
        *range(steps_until_the_last_answer(before)),
        *range(len(before), len(before) + steps_until_the_last_answer(after)),
    ]
    prompt = [step for step in every_second if step in lasting and (not step or parts[step - 1]["by"] != "late")]
    assert observed == sorted(set(prompt) | set(observed) & set(every_second)), "every second step"


def steps_until_the_last_answer(lines):
    """Return the number of steps until the last one at which the partner was not late."""
    return max((number for number, line in enumerate(lines, 1) if line["players"]["right"]["by"] != "late"), default=0)


# ---- turn by turn


async def test_the_game_waits_for_the_participant_and_then_shows_the_partners_move(launch, open_client):
    server = launch(two_players(turns=True), trial=TRIAL | {"pace": "turns", "startingFrameRate": 10})
    async with open_client(server.address) as client:
        await client.hello()
        await client.until(lambda: client.controls)
        assert client.controls["pace"] == "turns"
        await client.say(command="start")
        await client.until(lambda: client.state.get("toAct"))
        waiting = len(client.frames)
        await client.watch(0.5)
        assert len(client.frames) == waiting, "no step for a participant who pressed nothing"
        await client.say(action="up", held=True)
        await client.until(lambda: len(client.frames) >= waiting + 2)
        await client.until(lambda: client.state.get("toAct"))
        await client.watch(0.4)
        assert len(client.frames) == waiting + 2, "a key that is held acts once"
        server.terminate()
        await client.closed()
    assert server.wait() == 0
    mine, theirs = steps(server)
    assert theirs["ns"] - mine["ns"] > 50_000_000, "the participant sees each move"
    assert mine["players"]["left"] == {"action": 1, "actionName": "up", "by": "human", "reward": 1.0}
    assert (mine["players"]["right"]["action"], mine["players"]["right"]["by"]) == (None, None)
    assert (theirs["players"]["right"]["action"], theirs["players"]["right"]["by"]) == (1, "policy")
    assert (theirs["players"]["left"]["action"], theirs["toAct"]) == (None, ["left"])


async def test_a_turn_of_limited_time_ends_without_a_press(launch, open_client):
    keys = {"pace": "turns", "startingFrameRate": 60, "turnSeconds": 0.2, "turnEnds": "random", "seed": 5}
    server = launch(two_players(turns=True), trial=TRIAL | keys)
    await play_and_end(server, open_client, frames=6)
    mine = [line["players"]["left"] for line in steps(server)[::2]]
    assert {part["by"] for part in mine} == {"random"}


async def test_a_policy_has_policy_seconds_in_its_turn(launch, open_client):
    keys = {"pace": "turns", "startingFrameRate": 60, "turnSeconds": 0.1, "policySeconds": 0.3}
    server = launch(two_players(turns=True, act="time.sleep(3600)"), trial=TRIAL | keys)
    await play_and_end(server, open_client, frames=5)
    assert [line["players"]["right"]["by"] for line in steps(server)[1::2]][:2] == ["late", "late"]


async def test_seeds_of_policies_follow_from_the_episodes(launch, open_client):
    act = "return (self.seed + self.asked) % 3\n\n    def reset(self, seed):\n        self.seed, self.asked = seed, 0"
    server = launch(two_players(act=act), trial=TRIAL | {"seed": 4})
    await play_and_end(server, open_client, frames=3)
    expected = int.from_bytes(hashlib.sha256(b"4\0right").digest()[:8], "big") % 2**31
    assert steps(server)[0]["players"]["right"]["action"] == (expected + 1) % 3
