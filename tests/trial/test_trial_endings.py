"""How a trial server ends: by SIGTERM, killed, idle or at its deadline; and what it keeps."""

import asyncio
import time

from hippodrome.trial.recordings import recording
from tests.trial.client_messages import play_to_the_end

UI = {"stop": True}


def steps_of(lines):
    return [line for line in lines if line["kind"] == "step"]


async def test_sigterm_keeps_the_whole_recording_and_closes_with_1001(launch, open_client):
    server = launch()
    async with open_client(server.address) as client:
        await client.play(30)
        server.terminate()
        assert await client.closed() == 1001
        last = client.frames[-1][1]
    begun = time.monotonic()
    assert server.wait() == 0
    assert time.monotonic() - begun < 10
    (lines,) = server.recordings().values()
    assert lines[-1]["kind"] == "end"
    assert lines[-1]["why"] == "shutdown"
    assert steps_of(lines)[-1]["frame"] >= last
    assert not server.answered(), "a trial that was cut short is not done"
    assert not list(server.store.rglob("*.part"))


async def test_sigterm_ends_a_server_while_its_agent_starts(launch, open_client, grid):
    source = grid().replace("def start(self, game):", "def start(self, game):\n        import time; time.sleep(60)")
    server = launch(source)
    async with open_client(server.address) as client:
        await client.hello()
        await client.watch(0.3)
        server.terminate()
        assert await client.closed() == 1001
    begun = time.monotonic()
    assert server.wait() == 0
    assert time.monotonic() - begun < 10
    assert not server.answered()


async def test_a_spool_that_cannot_be_written_ends_the_trial_with_a_sentence(launch, open_client, tmp_path):
    (tmp_path / "file").write_text("")
    server = launch(SPOOL=str(tmp_path / "file" / "spool"))
    async with open_client(server.address) as client:
        await client.hello()
        assert await client.closed() == 1011
        assert "cannot be started" in client.errors[0]
    assert server.wait() == 1
    assert not server.answered()


def test_sigterm_ends_a_server_before_its_participant_comes(launch):
    server = launch()
    time.sleep(0.3)
    server.terminate()
    assert server.wait() == 0
    assert "Traceback" not in server.log_text()


async def test_a_killed_server_loses_a_second_at_most(launch, open_client):
    server = launch(trial={"startingFrameRate": 50})
    async with open_client(server.address) as client:
        await client.play(80)
        server.process.kill()
        last = client.frames[-1][1]
    server.wait()
    (part,) = server.store.rglob("*.part")
    left = recording.read(part.read_bytes())
    behind = last - steps_of(left)[-1]["frame"]
    assert behind <= 75, "a second's steps, and half as many on a busy machine"
    # The next process of this server stores the recording that is left, and begins a file of its own.
    again = launch(trial={"startingFrameRate": 50, "ui": UI})
    async with open_client(again.address) as client:
        await client.play(5)
        await client.stop()
    assert again.wait() == 0
    kept = again.recordings()
    assert len(kept) == 2
    assert left in kept.values()
    assert not list(server.store.rglob("*.part"))


def test_a_server_to_which_no_participant_comes_ends_as_idle(launch):
    server = launch(IDLE_SECONDS="1", GRACE_SECONDS="30")
    assert server.wait() == 0
    assert "idle" in server.log_text()


async def test_a_server_waits_for_a_participant_who_leaves(launch, open_client):
    server = launch(IDLE_SECONDS="3", GRACE_SECONDS="6")
    async with open_client(server.address) as client:
        await client.play()
        await client.watch(3.2)
    left = time.monotonic()
    await asyncio.sleep(1.5)
    async with open_client(server.address) as client:
        await client.enter()
        assert client.controls["state"] == "paused"
        assert time.monotonic() - left < 6, "this machine is too slow for the test"
        left = time.monotonic()
    assert server.wait() == 0
    assert time.monotonic() - left > 5.9
    (lines,) = server.recordings().values()
    assert lines[-1]["why"] == "shutdown"


async def test_a_server_ends_at_its_deadline(launch, open_client):
    server = launch(DEADLINE=str(time.time() + 8))
    async with open_client(server.address) as client:
        await client.play()
        assert await client.closed() == 1001
    assert server.wait() == 0
    assert "deadline" in server.log_text()
    assert server.recordings()
    assert not server.answered()


async def test_without_s3upload_recordings_stay_on_the_server(launch, open_client, grid, tmp_path):
    server = launch(
        grid(5), {"maxEpisodes": 1, "s3upload": False, "startingFrameRate": 60}, SPOOL=str(tmp_path / "spool")
    )

    await play_to_the_end(server, open_client)
    assert server.wait() == 0
    assert server.answered()
    assert server.recordings() == {}
    (path,) = (tmp_path / "spool").rglob("*.gz")
    assert path.name == "3-episode-0001.jsonl.gz"
    assert len(steps_of(recording.read(path.read_bytes()))) == 5


async def test_a_store_that_fails_for_a_while_loses_nothing(launch, open_client, tmp_path):
    server = launch(trial={"ui": UI}, SPOOL=str(tmp_path / "spool"))
    blocked = server.store / "study/users/P1/trials"
    blocked.parent.mkdir(parents=True)
    blocked.write_text("a file where a folder must be: no recording can be stored")
    async with open_client(server.address) as client:
        await client.play(10)
        await client.say(command="stop")
        await client.until(lambda: client.state["state"] == "ended")
        while "trying again" not in server.log_text():
            await client.watch(0.05)
        assert not server.answered()
        assert client.done is None, "not done before the data are safe"
        blocked.unlink()
        assert await client.closed() == 1000
        assert client.done is not None
    assert server.wait() == 0
    assert server.answered()
    (lines,) = server.recordings().values()
    assert len(steps_of(lines)) >= 9
    assert "trying again" in server.log_text()
    assert "P1" not in server.log_text()


async def test_a_server_without_clients_uses_almost_no_processor_time(launch, open_client):
    server = launch()
    async with open_client(server.address) as client:
        await client.play(10)
    time.sleep(0.7)
    before = server.cpu_seconds()
    time.sleep(2)
    assert server.cpu_seconds() - before <= 0.05


def test_wrong_settings_are_named(tmp_path):
    import os
    import subprocess
    import sys
    from pathlib import Path

    root = Path(__file__).parents[2]
    env = {"PATH": os.environ["PATH"], "PYTHONPATH": str(root), "PROJECT_ID": "x", "USER_ID": "a/b"}
    done = subprocess.run(
        [sys.executable, "-m", "hippodrome.trial"],
        check=False,
        cwd=tmp_path,
        env={**env, "GAME_STEPS": "3"},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 2
    assert done.stderr.startswith("trial: ")
    assert "Traceback" not in done.stderr


LEARNER = """
_reset, _step = Grid.reset, Grid.step
def _began(self, **options):
    self.episode = getattr(self, "episode", 0) + 1
    return _reset(self, **options)
def _measured(self, action):
    seen, reward, terminated, truncated, info = _step(self, action)
    import numpy as np
    return seen, reward, terminated, truncated, {**info, "success": np.bool_(self.episode != 2)}
Grid.reset, Grid.step = _began, _measured
"""


async def test_training_ends_once_so_many_episodes_have_succeeded(launch, open_client, grid):
    trial = {"maxEpisodes": 9, "betweenEpisodes": 0, "until": {"success": 2}}
    server = launch(agent=grid(3) + LEARNER, trial=trial)
    async with open_client(server.address) as client:
        await client.start()
        await client.until(lambda: client.done)
    answers = server.answer()["answers"]
    assert (answers["episodes"], answers["outcome"], answers["reached"]) == (3, "finished", True)
