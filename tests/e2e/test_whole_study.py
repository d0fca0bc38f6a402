"""Whole studies over HTTP and WebSocket: `hippodrome run` in a process of its own, and bots for participants."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from random import Random
from typing import Any

import psutil
import pytest

from hippodrome.bots.bot import Bot
from hippodrome.bots.http import ask
from hippodrome.bots.links import with_user
from hippodrome.bots.report import BotReport
from hippodrome.local.rehearsal.logs import Verification, verify
from hippodrome.local.rehearsal.study_process import StudyNotStarted, StudyProcess, servers_of, wait_until_gone
from testing.waiting import until_async


def bot(study: StudyProcess, name: str, *, play: float = 0, patience: float = 60) -> Bot:
    return Bot(study.link, name, Random(name), play=play, patience=patience)


async def with_bots(bots: list[Bot], meanwhile: Awaitable[Any] | None = None) -> list[BotReport]:
    """Let them walk through the study while something else happens."""
    async with asyncio.timeout(150), asyncio.TaskGroup() as group:
        for each in bots:
            group.create_task(each.run())
        if meanwhile is not None:
            await meanwhile
    return [each.report for each in bots]


def plays(*bots: Bot, frames: int = 10) -> Callable[[], bool]:
    return lambda: all(b.report.plays and b.report.plays[-1].frames >= frames for b in bots)


def looked_at(study: StudyProcess, reports: list[BotReport]) -> Verification:
    """Everybody has finished, and nothing they did is missing."""
    assert [(report.errors, report.finished) for report in reports] == [([], True)] * len(reports), reports
    found = verify(study.data, "tiny", reports)
    assert found.missing == []
    assert (found.answers, found.games, found.codes) == (3 * len(reports), len(reports), len(reports))
    return found


def test_two_play_at_once_on_servers_of_their_own(project: Any, hold: Any) -> None:
    study = hold(project())
    bots = [bot(study, "ada"), bot(study, "grace")]
    together = []

    async def watch() -> None:
        await until_async(plays(*bots), 60)
        together.append({process.environ()["USER_ID"] for process in servers_of(study.data)})

    reports = asyncio.run(with_bots(bots, watch()))
    assert together == [{"ada", "grace"}]
    ada, grace = (report.plays[0] for report in reports)
    assert set(ada.addresses).isdisjoint(grace.addresses)
    found = looked_at(study, reports)
    assert [report.troubles for report in reports] == [[], []]
    assert [(play.done, play.episodes, play.score) for play in (ada, grace)] == [(True, 2, 90)] * 2
    assert (found.recordings, found.steps) == (4, 180)
    assert wait_until_gone(study.data).words() == []
    assert study.interrupt()


def test_local_mode_is_killed_and_started_again(project: Any, hold: Any, free_port: int) -> None:
    folder = project(length=240, maxEpisodes=1)
    study = hold(folder, port=free_port)
    player, reader = bot(study, "player"), bot(study, "reader")

    async def crash() -> None:
        page = await reader.open()
        page = await reader.answer(page, page.form)  # has consented, and looks at the next page
        await until_async(plays(player), 60)
        before = {process.pid for process in servers_of(study.data)}
        study.kill()
        sends = asyncio.create_task(reader.do(page))  # while nobody is there
        await asyncio.sleep(0.5)
        assert {process.pid for process in servers_of(study.data)} == before
        assert not sends.done()
        await asyncio.to_thread(hold, folder, port=free_port)
        page = await sends
        while page is not None:
            page = await reader.do(page)

    asyncio.run(with_bots([player], crash()))
    found = looked_at(study, [player.report, reader.report])
    assert (found.recordings, found.steps) == (3, 480)
    assert len(player.report.plays[0].addresses) == 2  # went on where they were, on another server
    assert wait_until_gone(study.data).words() == []


def test_the_machine_goes_down_in_the_middle(project: Any, hold: Any, free_port: int) -> None:
    folder = project(length=150, maxEpisodes=1)
    study = hold(folder, port=free_port)
    player = bot(study, "player")

    async def crash() -> int:
        """Kill everything in mid-game, and start the study again. Return how many steps were recorded by then."""
        await until_async(plays(player, frames=60), 60)
        seen = player.report.plays[0]
        await until_async(lambda: study.steps_written() > seen.frames - 30, 60)  # a busy machine may write it late
        study.kill()
        for process in servers_of(study.data):
            process.kill()
        await until_async(lambda: not servers_of(study.data), 60)
        written = study.steps_written()
        await asyncio.to_thread(hold, folder, port=free_port)
        return written

    async def play_through_the_crash() -> int:
        crashing = asyncio.create_task(crash())
        await with_bots([player], crashing)
        return await crashing

    written = asyncio.run(play_through_the_crash())
    report = player.report
    assert (report.errors, report.finished) == ([], True)
    assert len(report.plays[0].addresses) == 2
    found = verify(study.data, "tiny", [report])
    assert (found.answers, found.games) == (3, 1)
    assert found.recordings == 2  # what was played before is kept, too
    assert found.steps in (150, written + 150)  # the game went on where it was, or began anew; no step is there twice
    assert found.steps > report.plays[0].frames - 45  # half a second may be lost, and what was played until the kill
    assert [line for line in found.missing if "is cut off" not in line and "frames seen" not in line] == []
    assert wait_until_gone(study.data).words() == []


def test_ctrl_c_ends_everything_and_the_study_can_go_on(project: Any, hold: Any, free_port: int) -> None:
    folder = project(length=120, maxEpisodes=1)
    study = hold(folder, port=free_port)
    bots = [bot(study, "ada"), bot(study, "grace")]
    lasted = []

    async def interrupt() -> None:
        await until_async(plays(*bots), 60)
        began = time.monotonic()
        assert await asyncio.to_thread(study.interrupt)
        lasted.append(time.monotonic() - began)
        assert servers_of(study.data) == []
        await asyncio.to_thread(hold, folder, port=free_port)

    reports = asyncio.run(with_bots(bots, interrupt()))
    assert lasted[0] < 20
    found = looked_at(study, reports)  # no recording is cut off
    assert found.recordings == 4
    assert [len(report.plays[0].addresses) for report in reports] == [2, 2]
    assert wait_until_gone(study.data).words() == []


def test_ctrl_c_with_nobody_there_is_quick(project: Any, hold: Any) -> None:
    study = hold(project())
    children = psutil.Process(study.pid).children(recursive=True)
    assert study.interrupt(10)
    assert not any(child.is_running() for child in children)


def test_one_data_folder_is_for_one_study_at_a_time(project: Any, hold: Any) -> None:
    folder = project(length=30, maxEpisodes=1)
    study = hold(folder)
    with pytest.raises(StudyNotStarted, match="already runs"):
        StudyProcess(folder, study.data, log=study.log.with_name("second.log")).start()
    reports = asyncio.run(with_bots([bot(study, "ada")]))  # the first does not mind
    looked_at(study, reports)


def test_a_study_that_is_not_live_does_not_exist(project: Any, hold: Any) -> None:
    study = hold(project(live=False))

    async def visit() -> None:
        for link in (study.link, with_user(study.link, "ada")):
            reply = await ask(link)
            assert (reply.status, "Study not found" in reply.text) == (404, True)

    asyncio.run(visit())
    assert not (study.data / "tiny" / "users").exists()


def test_the_same_page_twice_and_a_reload_change_nothing(project: Any, hold: Any) -> None:
    study = hold(project())
    ada = bot(study, "ada")

    async def walk() -> None:
        first = await ada.open()
        assert (await ada.open()).step == first.step == "1"
        second = await ada.answer(first, first.form)
        again = await ada.post(first.address, [*_hidden(first), ("consent", "forged")])
        assert (again.step, (await ada.open()).step, second.step) == ("2", "2", "2")

    asyncio.run(walk())
    found = verify(study.data, "tiny", [ada.report])
    assert (found.answers, found.missing) == (1, [])


def _hidden(page: Any) -> list[tuple[str, str]]:
    from hippodrome.bots.forms import hidden

    return list(hidden(page.form))


def test_files_written_by_a_study_are_the_documents_of_the_design(project: Any, hold: Any) -> None:
    study = hold(project(length=20, maxEpisodes=1))
    asyncio.run(with_bots([bot(study, "ada")]))
    wait_until_gone(study.data)
    user = study.data / "tiny" / "users" / "ada"
    files = {str(path.relative_to(user)) for path in user.rglob("*") if path.is_file()}
    [trial] = [Path(name).parts[1] for name in files if name.startswith("trials/")]
    assert files == {
        "participant.json",
        *(f"answers/{step}.json" for step in (1, 2, 3, 4)),
        f"trials/{trial}/3-episode-0001.jsonl.gz",
    }
