"""What a session's server stores: each member's answers, the session's recordings, and the recordings of a lost server."""

import asyncio
import json

import pytest

from hippodrome.protocol.session import Member, SessionDocument
from hippodrome.trial.core.session import PARTNER_STOPPED
from hippodrome.trial.recordings.recorder import Recorder, Spool
from hippodrome.trial.recordings.store import FolderStore
from hippodrome.trial.server import assignment
from hippodrome.trial.settings import TrialSettings
from testing.waiting import until
from tests.trial.sessions import (
    ENV,
    MEMBERS,
    SID,
    TRIAL,
    answer,
    both_play,
    document,
    form,
    hello_of,
    launch_formed,
    launch_session,
    member,
    put,
    recordings,
    refused,
    wait_for_pictures,
)
from tests.trial.two_players import two_players

# ---- two game steps


async def test_a_session_plays_its_game_steps_one_after_the_other(launch, open_client):
    server = launch_formed(launch, GAME_STEPS="3,5")
    await both_play(server)
    async with member(server, "anna", step="5") as anna, member(server, "bert", step="5") as bert:
        assert "another step's game" in await refused(server, open_client, 4404, **hello_of("bert", step="3"))
        await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))
        await bert.say(command="stop")
        assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]
    assert server.wait() == 0
    assert all(answer(server.store, each, step)["answers"]["session"] == SID for each in MEMBERS for step in "35")


async def test_a_member_cannot_open_a_later_game_step_before_their_answer_to_the_one_before(launch, open_client):
    """Else a member whose client names another step could keep the others out of their own."""
    server = launch_formed(launch, GAME_STEPS="3,5")
    early = hello_of("bert", step="5")
    assert "an earlier game step" in await refused(server, open_client, 4404, **early)
    await both_play(server)
    async with member(server, "bert", step="5"):
        pass


async def test_the_next_server_knows_which_members_have_answered_an_earlier_game_step(launch, open_client):
    server = launch_formed(launch, GAME_STEPS="3,5", SERVER="pair-2")
    put(server.store, "study/users/anna/answers/3.json", b'{"answers": {}}')
    assert "an earlier game step" in await refused(server, open_client, 4404, **hello_of("bert", step="5"))
    async with member(server, "anna", step="5"):
        pass


# ---- what it leaves behind


async def test_each_member_has_an_answer_and_the_recording_is_the_sessions(launch):
    server = launch_session(launch, trial={"seed": 3})
    form(server.store, document(group=1))
    await both_play(server)
    assert server.wait() == 0
    anna, bert = (answer(server.store, each) for each in MEMBERS)
    for found in (anna, bert):
        assert (found["step"], found["page"], found["group"], found["schema"]) == ("3", "game", 1, 1)
        assert found["answers"]["session"] == SID
    assert (anna["answers"]["outcome"], bert["answers"]["outcome"]) == ("stopped", "partnerLeft")
    assert anna["answers"]["player"] == "left"
    assert bert["answers"]["player"] == "right"
    assert bert["answers"]["score"] == bert["answers"]["scores"]["right"]
    assert anna["answers"]["score"] == anna["answers"]["scores"]["left"]
    (lines,) = recordings(server.store).values()
    assert (lines[0]["session"], lines[0]["server"], lines[0]["group"]) == (SID, "pair-1", 1)
    assert "userId" not in lines[0]


async def test_recordings_and_log_hold_no_members_id(launch):
    """If the researcher's code raises an error that contains an id, the error is recorded without the id."""
    members, said = ("Participant-One", "Participant-Two"), "no Participant-Two here"
    broken = two_players(act="pass").replace(
        "self.t += 1", f"self.t += 1\n        if self.t == 3: raise ValueError('{said}')", 1
    )
    broken += f"\n\nclass Agent(Agent):\n    def on_join(self, session, player):\n        raise KeyError('{said}')\n"
    server = launch_session(launch, agent=broken, trial={"maxEpisodes": 2})
    form(server.store, document(members))
    async with member(server, members[0]) as one, member(server, members[1]) as two:
        await one.say(command="start")
        await two.until(lambda: two.errors)
        await two.say(command="pause")
        server.terminate()
        await one.closed()
    server.wait()
    written = json.dumps(recordings(server.store))
    assert "ValueError" in server.log_text()
    for each in members:
        assert each not in server.log_text()
        assert each not in written
    assert "(participant)" in server.log_text()
    hidden = said.replace(members[1], "(participant)")
    assert f"ValueError: {hidden}" in written
    assert f"KeyError: '{hidden}'" in written


async def test_a_members_folder_holds_only_their_answer(launch):
    server = launch_formed(launch)
    await both_play(server)
    server.wait()
    found = {path.relative_to(server.store).as_posix() for path in server.store.rglob("*") if path.is_file()}
    assert found == {
        "study/users/anna/answers/3.json",
        "study/users/bert/answers/3.json",
        f"study/sessions/{SID}/session.json",
        f"study/sessions/{SID}/trials/pair-1/3-episode-0001.jsonl.gz",
    }


async def test_a_game_step_that_all_members_have_answered_is_not_played_again(launch):
    server = launch_formed(launch)
    await both_play(server)
    assert server.wait() == 0
    kept = {each: answer(server.store, each) for each in MEMBERS}
    again = launch_session(launch, SERVER="pair-2", LINGER_SECONDS="4")  # the second member has come by then
    async with member(again, "anna") as anna, member(again, "bert") as bert:
        assert await asyncio.gather(anna.closed(), bert.closed()) == [1000, 1000]
        assert anna.done["score"] == kept["anna"]["answers"]["score"]
        assert bert.done["score"] == kept["bert"]["answers"]["score"]
        assert not anna.frames
    assert again.wait() == 0
    assert {each: answer(server.store, each) for each in MEMBERS} == kept
    assert not recordings(server.store, "pair-2")


async def test_an_answer_that_an_interrupted_server_did_not_store_is_stored_by_the_next_one(launch):
    """The server was lost between two answers: the stored answer stays, the missing one is stored."""
    server = launch_formed(launch)
    await both_play(server)
    assert server.wait() == 0
    anna, bert = (answer(server.store, each) for each in MEMBERS)
    (server.store / "study/users/bert/answers/3.json").unlink()
    again = launch_session(launch, SERVER="pair-2")
    async with member(again, "bert") as client:
        assert await client.closed() == 1000
        assert client.done["score"] == bert["answers"]["score"]
    assert again.wait() == 0
    assert answer(server.store, "anna") == anna, "an answer that exists is not written again"
    again_bert = answer(server.store, "bert")["answers"]
    for key in ("score", "player", "session", "outcome", "frames"):
        assert again_bert[key] == bert["answers"][key]


def recorder_of(tmp_path, *members):
    settings = TrialSettings.from_env({**ENV, "STORE": str(tmp_path), "TRIAL": json.dumps(TRIAL)})
    formed = assignment.with_members(settings, SessionDocument(SID, len(members), members))
    store = FolderStore(tmp_path)
    return Recorder(formed, "3", "the-trial", store, Spool(formed, store)), store


async def save_answers(recorder, answers):
    for each, said in answers.items():
        await recorder.save_member(each, said)


async def test_each_answer_is_created_once_with_the_members_own_group(tmp_path):
    recorder, _ = recorder_of(tmp_path, Member("anna", 0, 0), Member("bert", 1, 1))
    given = {"anna": {"score": 1, "player": "left"}, "bert": {"score": 2, "player": "right"}}
    await save_answers(recorder, given)
    found = {each: answer(tmp_path, each) for each in MEMBERS}
    assert [found[each]["group"] for each in MEMBERS] == [0, 1]
    assert {each: found[each]["answers"] for each in MEMBERS} == {
        each: {**said, "session": SID} for each, said in given.items()
    }
    await save_answers(recorder, {each: {"score": 9} for each in MEMBERS})
    assert {each: answer(tmp_path, each) for each in MEMBERS} == found


async def test_a_game_step_is_over_when_each_member_has_an_answer_and_not_before(tmp_path):
    recorder, _ = recorder_of(tmp_path, Member("anna", None, 0), Member("", None, 1), Member("bert", None, 2))
    assert await recorder.members_answers() == {}
    bert = {"bert": {"score": 2, "session": SID}}
    await recorder.save_member("bert", {"score": 2})
    assert await recorder.members_answers() == bert
    await recorder.save_member("anna", {"score": 1})
    assert await recorder.members_answers() == bert | {"anna": {"score": 1, "session": SID}}


# ---- a lost server


def steps(lines):
    return [line["step"] for line in lines if line["kind"] == "step"]


async def test_after_a_kill_the_game_goes_on_for_both_at_the_last_recorded_step(launch, tmp_path):
    """A process that is killed leaves its recording in the spool, and the next process of that server stores it."""
    first = launch_session(launch, trial={"seed": 3})
    form(first.store)
    async with member(first, "anna") as anna, member(first, "bert") as bert:
        await anna.say(command="start")
        await anna.say(action="up", lasts=None)
        await wait_for_pictures(40, anna, bert)
        first.process.kill()
        await asyncio.gather(anna.closed(), bert.closed())
    folder = first.store / f"study/sessions/{SID}/trials/pair-1"
    (left,) = folder.glob("*.part")
    left.rename(left.with_suffix(""))  # as local mode does, and the next process with this server name
    (before,) = recordings(first.store).values()
    assert len(steps(before)) >= 10
    second = launch_session(launch, trial={"seed": 3}, SERVER="pair-2")
    anna, bert = await both_play(second, 15)
    assert second.wait() == 0
    (after,) = recordings(second.store, "pair-2").values()
    assert [line["kind"] for line in after[:2]] == ["header", "resume"]
    assert steps(before) + steps(after) == list(range(1, len(steps(before)) + len(steps(after)) + 1))
    total = [sum(line["players"][name]["reward"] for line in before + after if line["kind"] == "step") for name in PLAY]
    assert [answer(first.store, each)["answers"]["score"] for each in MEMBERS] == total
    assert (anna.errors, bert.errors) == ([], [PARTNER_STOPPED])


PLAY = ("left", "right")


async def test_a_killed_process_of_the_same_server_leaves_a_recording_that_the_next_process_stores(launch):
    first = launch_session(launch)
    form(first.store)
    async with member(first, "anna") as anna, member(first, "bert") as bert:
        await anna.say(command="start")
        await wait_for_pictures(30, anna, bert)
        first.process.kill()
    again = launch_session(launch)
    folder = first.store / f"study/sessions/{SID}/trials/pair-1"
    until(lambda: list(folder.glob("*.gz")) and not list(folder.glob("*.part")))
    (lines,) = recordings(again.store).values()
    assert steps(lines)


# ---- what the researcher's code sees


REPORTING = """
import os, json
NAMES = ("USER_ID", "GROUP", "SESSION", "TOKEN")
def variables():
    return {name: os.environ.get(name) for name in NAMES}
_first = variables()
class Reporting(Agent):
    def reset(self, seed=None):
        seen, infos = super().reset(seed)
        return seen, {"left": {"first": _first, "now": variables()}, "right": {}}
Agent = Reporting
"""


@pytest.mark.parametrize("group", [None, 2])
async def test_the_agent_sees_the_session_and_its_group_and_no_participants_id(launch, group):
    agent = two_players() + REPORTING
    server = launch_session(launch, agent=agent, trial={})
    form(server.store, document(group=group))
    await both_play(server)
    server.wait()
    (lines,) = recordings(server.store).values()
    reset = next(line for line in lines if line["kind"] == "reset")
    found = json.dumps(reset)
    now = {"USER_ID": None, "GROUP": "" if group is None else str(group), "SESSION": SID, "TOKEN": None}
    assert json.dumps(now, separators=(",", ":")) in found.replace(", ", ",").replace(": ", ":")
    assert '"USER_ID": "' not in found
