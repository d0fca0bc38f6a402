"""A recording that cannot be stored, or not even be written: answers are kept, and the recording if that is possible."""

import asyncio
import time
from pathlib import Path

from hippodrome.trial.recordings import recording
from tests.trial.conftest import client_of
from tests.trial.far_away import far_away
from tests.trial.sessions import MEMBERS, SID, TRIAL, answer, launch_formed, member, recordings

SECONDS = "RECORDINGS_FIRST_SECONDS"


def refuse_recordings(store: Path) -> Path:
    """The store takes no recording of the session as long as this file is there."""
    in_the_way = store / f"study/sessions/{SID}/trials"
    in_the_way.parent.mkdir(parents=True, exist_ok=True)
    in_the_way.touch()
    return in_the_way


async def play_to_the_end(server):
    """Let both play, and one end the game; return how long it then took until both were told that all is stored."""
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))
        await anna.say(command="stop")
        since = time.monotonic()
        codes = await asyncio.gather(anna.closed(), bert.closed())
        return codes, time.monotonic() - since


def outcomes(store):
    return {each: answer(store, each)["answers"]["outcome"] for each in MEMBERS}


async def test_answers_wait_for_a_recording_that_cannot_be_stored_only_for_a_while(launch, tmp_path):
    """The members go on, and the server stays until the store takes the recording."""
    server = launch_formed(launch, SPOOL=str(tmp_path / "spool"), **{SECONDS: "1.5"})
    in_the_way = refuse_recordings(server.store)
    codes, waited = await play_to_the_end(server)
    assert codes == [1000, 1000], server.log_text()
    assert waited > 1.4
    assert outcomes(server.store) == {"anna": "stopped", "bert": "partnerLeft"}
    time.sleep(1)  # well after LINGER_SECONDS
    assert server.process.poll() is None, "the recording is not stored yet"
    in_the_way.unlink()
    assert server.wait(60) == 0
    (lines,) = recordings(server.store).values()
    assert lines[-1]["kind"] == "end"


async def test_a_server_that_is_told_to_end_keeps_the_answers_without_the_recording(launch, tmp_path):
    server = launch_formed(launch, SPOOL=str(tmp_path / "spool"), STOP_SECONDS="15")
    refuse_recordings(server.store)
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))
        await anna.say(command="stop")
        await asyncio.gather(*(each.until(lambda each=each: "ended" in each.states) for each in (anna, bert)))
        server.terminate()
        await asyncio.gather(anna.closed(), bert.closed())
    server.wait()
    assert outcomes(server.store) == {"anna": "stopped", "bert": "partnerLeft"}
    (left,) = (tmp_path / "spool").rglob("*.part")
    assert recording.read(left.read_bytes())[-1]["kind"] == "end", "on one machine the next process stores it"


async def test_a_participant_alone_keeps_the_answer_too(launch, tmp_path):
    server = launch(trial={"ui": TRIAL["ui"]}, SPOOL=str(tmp_path / "spool"), **{SECONDS: "0.5"})
    in_the_way = server.store / "study/users/P1/trials"
    in_the_way.parent.mkdir(parents=True)
    in_the_way.touch()
    async with client_of(server.address) as client:
        await client.play()
        await client.stop()
    assert server.answer()["answers"]["outcome"] == "stopped"
    in_the_way.unlink()
    assert server.wait(60) == 0
    assert server.recordings()


async def test_answers_are_stored_after_the_recording_if_that_can_be_stored(launch):
    """The usual order: a program that reads the answer finds the recording."""
    server = launch_formed(launch)
    await play_to_the_end(server)
    assert server.wait() == 0
    (recorded,) = (server.store / f"study/sessions/{SID}/trials/pair-1").glob("*.gz")
    answers = [server.store / f"study/users/{each}/answers/3.json" for each in MEMBERS]
    assert all(recorded.stat().st_mtime_ns <= each.stat().st_mtime_ns for each in answers)


# ---- the answer of one member


def refuse_answers_of(store: Path, user_id: str) -> Path:
    """The store takes no answer of this member as long as this file is there."""
    in_the_way = store / "study/users" / user_id
    in_the_way.parent.mkdir(parents=True, exist_ok=True)
    in_the_way.touch()
    return in_the_way


async def seen_by_both(anna, bert):
    await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))


async def test_each_member_goes_on_when_their_own_answer_is_stored(launch):
    """The answer of one member is refused: they wait as a participant who plays alone does, until the store takes it."""
    server = launch_formed(launch)
    in_the_way = refuse_answers_of(server.store, "bert")
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await seen_by_both(anna, bert)
        await bert.say(command="stop")
        assert await anna.closed() == 1000
        assert anna.done["outcome"] == "partnerLeft"
        async with member(server, "anna") as again:
            assert await again.closed() == 1000, "also on another page"
        async with member(server, "bert") as again:
            assert (again.state["state"], again.done) == ("ended", None)
            in_the_way.unlink()
            assert await again.closed() == 1000
            assert again.done["outcome"] == "stopped"
    assert server.wait() == 0
    assert outcomes(server.store) == {"anna": "partnerLeft", "bert": "stopped"}


async def test_an_answer_that_is_refused_for_ever_does_not_keep_the_server_beyond_its_deadline(launch):
    server = launch_formed(launch, DEADLINE=str(time.time() + 8), STOP_SECONDS="15")
    refuse_answers_of(server.store, "bert")
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await seen_by_both(anna, bert)
        await anna.stop()
        assert await bert.closed() == 1001
    assert server.wait(60) == 0
    assert "ending: deadline" in server.log_text()
    assert answer(server.store, "anna")["answers"]["outcome"] == "stopped"


async def test_the_next_game_step_is_played_while_a_members_answer_to_the_one_before_is_refused(launch):
    section = {"gather": 4, "absent": 1, "afterAbsent": "policy", "substitute": "idle"}
    server = launch_formed(launch, trial=section, GAME_STEPS="3,5", LINGER_SECONDS="4")
    in_the_way = refuse_answers_of(server.store, "bert")
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await seen_by_both(anna, bert)
        await anna.say(command="stop")
        await anna.closed()
        async with member(server, "anna", step="5") as later, member(server, "bert") as again:
            await later.until(lambda: len(later.frames) > 5)
            await later.say(command="stop")
            await later.closed()
            assert (again.state["state"], again.done) == ("ended", None)
            in_the_way.unlink()
            assert await again.closed() == 1000
        async with member(server, "bert", step="5") as later:
            assert await later.closed() == 1000
    assert server.wait() == 0
    steps = [{each: answer(server.store, each, step)["answers"]["outcome"] for each in MEMBERS} for step in "35"]
    assert steps == [{"anna": "stopped", "bert": "partnerLeft"}, {"anna": "stopped", "bert": "left"}]


async def test_the_server_stays_for_the_answer_of_a_member_whom_it_has_refused_before_the_game(launch):
    """Their answer is given to the store while the others still play, and may be stored long after their game."""
    section = {"maxPing": 1000, "pingSamples": 3, "afterAbsent": "policy", "substitute": "idle"}
    server = launch_formed(launch, trial=section)
    in_the_way = refuse_answers_of(server.store, "bert")
    async with (
        far_away(server.port, 0.6) as port,
        member(server, "anna") as anna,
        member(server, "bert", port=port) as bert,
    ):
        reading = asyncio.create_task(bert.watch(60))
        await anna.until(lambda: len(anna.frames) > 5)
        await anna.stop()
        reading.cancel()
    await asyncio.sleep(1)  # well after LINGER_SECONDS
    assert server.process.poll() is None, "an answer is not stored yet"
    in_the_way.unlink()
    assert server.wait() == 0
    assert outcomes(server.store) == {"anna": "stopped", "bert": "ping"}
