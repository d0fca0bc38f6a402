"""A recording that cannot be stored, or not even be written: the answers are kept, and the recording if it can be."""

import asyncio
import time
from pathlib import Path

from tests.trial.conftest import client_of
from tests.trial.sessions import MEMBERS, SID, TRIAL, answer, form, launch_session, member, recordings
from trial.recordings import recording

SECONDS = "RECORDINGS_FIRST_SECONDS"


def refuse_recordings(store: Path) -> Path:
    """The store takes no recording of the session as long as this file is there."""
    in_the_way = store / f"study/sessions/{SID}/trials"
    in_the_way.parent.mkdir(parents=True, exist_ok=True)
    in_the_way.touch()
    return in_the_way


async def play_to_the_end(server):
    """Both play, and one ends the game; how long it took from there until both were told that all is stored."""
    async with member(server, "anna") as anna, member(server, "bert") as bert:
        await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))
        await anna.say(command="stop")
        since = time.monotonic()
        codes = await asyncio.gather(anna.closed(), bert.closed())
        return codes, time.monotonic() - since


def outcomes(store):
    return {each: answer(store, each)["answers"]["outcome"] for each in MEMBERS}


def test_answers_wait_for_a_recording_that_cannot_be_stored_but_not_for_ever(launch, tmp_path):
    """The members go on, and the server stays until the store takes the recording."""
    server = launch_session(launch, SPOOL=str(tmp_path / "spool"), **{SECONDS: "1.5"})
    form(server.store)
    in_the_way = refuse_recordings(server.store)
    codes, waited = asyncio.run(play_to_the_end(server))
    assert codes == [1000, 1000], server.said()
    assert waited > 1.4
    assert outcomes(server.store) == {"anna": "stopped", "bert": "partnerLeft"}
    time.sleep(1)  # well after LINGER_SECONDS
    assert server.process.poll() is None, "the recording is not stored yet"
    in_the_way.unlink()
    assert server.wait(25) == 0
    (lines,) = recordings(server.store).values()
    assert lines[-1]["kind"] == "end"


def test_a_server_that_is_told_to_end_keeps_the_answers_without_the_recording(launch, tmp_path):
    server = launch_session(launch, SPOOL=str(tmp_path / "spool"), STOP_SECONDS="15")
    form(server.store)
    refuse_recordings(server.store)

    async def run():
        async with member(server, "anna") as anna, member(server, "bert") as bert:
            await asyncio.gather(*(each.until(lambda each=each: len(each.frames) > 5) for each in (anna, bert)))
            await anna.say(command="stop")
            await asyncio.gather(*(each.until(lambda each=each: "ended" in each.states) for each in (anna, bert)))
            server.terminate()
            await asyncio.gather(anna.closed(), bert.closed())

    asyncio.run(run())
    server.wait()
    assert outcomes(server.store) == {"anna": "stopped", "bert": "partnerLeft"}
    (left,) = (tmp_path / "spool").rglob("*.part")
    assert recording.read(left.read_bytes())[-1]["kind"] == "end", "on one machine the next process stores it"


def test_a_participant_alone_keeps_the_answer_too(launch, tmp_path):
    server = launch(trial={"ui": TRIAL["ui"]}, SPOOL=str(tmp_path / "spool"), **{SECONDS: "0.5"})
    in_the_way = server.store / "study/users/P1/trials"
    in_the_way.parent.mkdir(parents=True)
    in_the_way.touch()

    async def run():
        async with client_of(server.address) as client:
            await client.play()
            await client.say(command="stop")
            return await client.closed()

    assert asyncio.run(run()) == 1000
    assert server.answer()["answers"]["outcome"] == "stopped"
    in_the_way.unlink()
    assert server.wait(25) == 0
    assert server.recordings()


def test_the_answers_come_after_the_recording_if_that_can_be_stored(launch):
    """The usual order: who reads the answer finds the recording."""
    server = launch_session(launch)
    form(server.store)
    asyncio.run(play_to_the_end(server))
    assert server.wait() == 0
    (recorded,) = (server.store / f"study/sessions/{SID}/trials/pair-1").glob("*.gz")
    answers = [server.store / f"study/users/{each}/answers/3.json" for each in MEMBERS]
    assert all(recorded.stat().st_mtime_ns <= each.stat().st_mtime_ns for each in answers)
