"""examples/two-players, run by a real `make run` and played by bots: pairs, a third participant, lost servers, and `match`."""

from __future__ import annotations

import asyncio
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from random import Random
from typing import Any

import pytest
import yaml

from hippodrome.bots.bot import Bot
from hippodrome.bots.page import VisitedPage
from hippodrome.bots.report import BotReport
from hippodrome.bots.verification import document
from hippodrome.local.new import LEFT_OUT
from hippodrome.local.rehearsal.logs import verify
from hippodrome.local.rehearsal.study_process import servers_of, sessions_not_open, sessions_of, wait_until_gone
from hippodrome.trial.recordings.recording import read
from testing import ports
from testing.held_study import HeldStudy
from testing.processes import ROOT
from testing.waiting import until_async

EXAMPLE = ROOT / "examples" / "two-players"
PROJECT = "two-players"
PATIENCE = 150.0  # seconds within which a bot must finish the study

RunStudy = Callable[..., HeldStudy]


@pytest.fixture
def run_study(tmp_path: Path) -> Iterator[RunStudy]:
    """Run the example with other keys of its sections: `run_study(project={"patience": 10}, trial={…})`.

    `more` are lines at the end of its agent.py.
    """
    studies: list[HeldStudy] = []

    def start(project: dict[str, Any], trial: dict[str, Any], more: str = "", port: int = 0) -> HeldStudy:
        folder = tmp_path / "study"
        shutil.copytree(EXAMPLE, folder, ignore=LEFT_OUT)
        config = yaml.safe_load((folder / "config.yml").read_text())
        config["project"] |= project
        config["trial"] |= trial
        (folder / "config.yml").write_text(yaml.safe_dump(config, sort_keys=False))
        with (folder / "agent.py").open("a") as agent:
            agent.write(more)
        studies.append(HeldStudy(folder, tmp_path / "run" / "data", port=port, log=tmp_path / "local.log"))
        studies[-1].start()
        return studies[-1]

    yield start
    for study in studies:
        study.clear()


def bots_of(study: HeldStudy, *names: str) -> list[Bot]:
    return [Bot(study.link, name, Random(name), play=0, patience=PATIENCE) for name in names]


async def run_bots(bots: list[Bot]) -> list[BotReport]:
    return list(await asyncio.gather(*(bot.run() for bot in bots)))


def assert_all_stored_and_stopped(study: HeldStudy, reports: list[BotReport]) -> None:
    assert [(report.errors, report.troubles, report.finished) for report in reports] == [([], [], True)] * len(reports)
    assert verify(study.data, PROJECT, reports).missing == []
    names = {report.user_id for report in reports}
    assert (
        wait_until_gone(
            study.data, names | sessions_of(study.data, PROJECT, names) | sessions_not_open(study.data, PROJECT)
        ).words()
        == []
    )
    assert study.interrupt()


def recordings_of(study: HeldStudy) -> list[list[dict[str, Any]]]:
    files = sorted((study.data / PROJECT / "sessions").glob("*/trials/*/*.gz"))
    return [list(read(file.read_bytes())) for file in files]


def test_two_participants_are_matched_and_a_third_goes_on_unmatched(run_study: RunStudy) -> None:
    study = run_study({"patience": 10}, {"maxEpisodes": 1, "episodeSeconds": 4, "countdown": 1})
    reports = asyncio.run(asyncio.wait_for(run_bots(bots_of(study, "ada", "bo", "cy")), PATIENCE))
    assert_all_stored_and_stopped(study, reports)
    plays = {report.user_id: report.plays[0] for report in reports}
    (alone,) = (name for name, play in plays.items() if play.unmatched)
    one, other = (name for name in plays if name != alone)
    assert plays[one].addresses == plays[other].addresses
    assert [plays[name].outcome for name in (one, other, alone)] == ["finished", "finished", "unmatched"]
    # The survey asks an unmatched participant another question.
    assert "back" in reports[["ada", "bo", "cy"].index(alone)].answers["4"]
    (lines,) = recordings_of(study)
    steps = [line["players"] for line in lines if line["kind"] == "step"]
    assert steps
    assert {step[who]["by"] for step in steps for who in ("red", "blue")} <= {"human", "none"}
    assert not {one, other} & set(str(lines).replace('"', "'").split("'"))


def test_a_lost_server_is_replaced_for_both(run_study: RunStudy) -> None:
    study = run_study({}, {"maxEpisodes": 1, "episodeSeconds": 12, "countdown": 1})

    async def lose_the_server() -> list[BotReport]:
        bots = bots_of(study, "ada", "bo")
        walking = asyncio.ensure_future(run_bots(bots))
        while not all(bot.report.plays and bot.report.plays[0].frames > 6 for bot in bots):
            assert not walking.done()
            await asyncio.sleep(0.05)
        while study.steps_written() < bots[0].report.plays[0].frames - 5:  # a busy machine may write them late
            assert not walking.done()
            await asyncio.sleep(0.05)
        for server in servers_of(study.data):
            server.kill()
        return await walking

    reports = asyncio.run(asyncio.wait_for(lose_the_server(), PATIENCE))
    assert [(report.errors, report.finished) for report in reports] == [([], True)] * 2
    assert [len(report.plays[0].addresses) for report in reports] == [2, 2]
    assert [report.plays[0].outcome for report in reports] == ["finished", "finished"], [
        report.troubles for report in reports
    ]
    missing = verify(study.data, PROJECT, reports).missing  # the killed server's recording is cut off
    assert [line for line in missing if not line.endswith(" is cut off") and " frames seen but " not in line] == []
    steps = sum(line["kind"] == "step" for lines in recordings_of(study) for line in lines)
    # Half a second of the frames that were seen may be lost, and what was played until the kill.
    assert all(steps > report.plays[0].frames - 12 for report in reports)


def test_after_patience_a_participant_plays_with_the_helper_in_the_empty_place(run_study: RunStudy) -> None:
    study = run_study(
        {"patience": 10, "afterPatience": "policies"}, {"maxEpisodes": 1, "episodeSeconds": 4, "countdown": 1}
    )
    (report,) = asyncio.run(asyncio.wait_for(run_bots(bots_of(study, "ada")), PATIENCE))
    assert_all_stored_and_stopped(study, [report])
    assert (report.plays[0].outcome, report.plays[0].members) == ("finished", 1)
    (lines,) = recordings_of(study)
    steps = [line["players"] for line in lines if line["kind"] == "step"]
    assert {step["red"]["by"] for step in steps} <= {"human", "none"}
    assert "policy" in {step["blue"]["by"] for step in steps}


def test_if_one_participant_leaves_for_good_the_game_ends_and_the_other_goes_on(run_study: RunStudy) -> None:
    trial = {"maxEpisodes": 1, "episodeSeconds": 20, "countdown": 1, "absent": 3, "afterAbsent": "end"}
    study = run_study({}, trial)

    async def leave() -> BotReport:
        bots = bots_of(study, "ada", "bo")
        ada, bo = (asyncio.ensure_future(bot.run()) for bot in bots)
        await until_async(lambda: all(bot.report.plays and bot.report.plays[0].frames > 6 for bot in bots), PATIENCE)
        bo.cancel()
        return await ada

    report = asyncio.run(asyncio.wait_for(leave(), PATIENCE))
    assert (report.finished, report.errors, report.plays[0].outcome) == (True, [], "partnerLeft")
    assert ["Another participant left" in trouble for trouble in report.troubles] == [True]
    assert document(study.data / PROJECT / "users/bo/answers/3.json")["answers"]["outcome"] == "left"
    assert verify(study.data, PROJECT, [report]).missing == []


def test_make_run_may_be_killed_while_a_participant_waits_and_while_two_play(run_study: RunStudy) -> None:
    study = run_study({}, {"maxEpisodes": 1, "episodeSeconds": 8, "countdown": 1}, port=ports.free())

    async def kill_twice() -> list[BotReport]:
        ada, bo = bots_of(study, "ada", "bo")
        first = asyncio.ensure_future(ada.run())
        await until_async(lambda: ada.report.stage == "waits for others", PATIENCE)
        study.kill()
        await asyncio.to_thread(study.start)
        second = asyncio.ensure_future(bo.run())
        await until_async(
            lambda: all(bot.report.plays and bot.report.plays[0].frames > 6 for bot in (ada, bo)), PATIENCE
        )
        study.kill()
        await asyncio.to_thread(study.start)
        return [await first, await second]

    reports = asyncio.run(asyncio.wait_for(kill_twice(), PATIENCE))
    assert [(report.errors, report.finished) for report in reports] == [([], True)] * 2
    assert [(report.plays[0].outcome, report.plays[0].members) for report in reports] == [("finished", 2)] * 2
    missing = verify(study.data, PROJECT, reports).missing  # the killed server's recording is cut off
    assert [line for line in missing if not line.endswith(" is cut off") and " frames seen but " not in line] == []
    lines = [line for recording in recordings_of(study) for line in recording]
    assert sum(line["kind"] == "end" and line["why"] != "shutdown" for line in lines) == 1, "it is one game"


OPPOSITES = """

def match(waiting):
    never = [one for one in waiting if one["answers"]["plays"] == "never"]
    often = [one for one in waiting if one["answers"]["plays"] == "often"]
    return list(zip(never, often))
"""
FAILS = """

def match(waiting):
    raise RuntimeError("no idea who plays")
"""


class AnsweringBot(Bot):
    """A bot that gives the answer `plays` to the question on the page before the game."""

    plays = ""

    async def post(self, address: str, pairs: list[tuple[str, str]]) -> VisitedPage:
        for answers in self.report.answers.values():
            if "plays" in answers:
                answers["plays"] = self.plays
        return await super().post(address, [(name, self.plays if name == "plays" else it) for name, it in pairs])


def answering_bots(study: HeldStudy, **plays: str) -> list[Bot]:
    bots = [AnsweringBot(study.link, name, Random(name), play=0, patience=PATIENCE) for name in plays]
    for bot in bots:
        bot.plays = plays[bot.report.user_id]
    return list[Bot](bots)


def test_the_function_match_puts_opposites_together(run_study: RunStudy) -> None:
    study = run_study(
        {"patience": 40, "matching": "match"}, {"maxEpisodes": 1, "episodeSeconds": 3, "countdown": 1}, OPPOSITES
    )
    bots = answering_bots(study, ada="never", bo="never", cy="often", di="often")
    reports = asyncio.run(asyncio.wait_for(run_bots(bots), PATIENCE))
    assert_all_stored_and_stopped(study, reports)
    assert [report.plays[0].outcome for report in reports] == ["finished"] * 4
    sessions = [document(file) for file in (study.data / PROJECT / "sessions").glob("*/session.json")]
    groups = [sorted(member["userId"] for member in session["members"]) for session in sessions]
    assert len(groups) == 2
    assert [len({"ada", "bo"}.intersection(group)) for group in groups] == [1, 1]


def test_if_the_function_match_raises_participants_go_on_unmatched_and_the_log_says_why(run_study: RunStudy) -> None:
    study = run_study({"patience": 15, "matching": "match"}, {"maxEpisodes": 1}, FAILS)
    reports = asyncio.run(asyncio.wait_for(run_bots(bots_of(study, "ada", "bo")), PATIENCE))
    assert_all_stored_and_stopped(study, reports)
    assert [report.plays[0].outcome for report in reports] == ["unmatched"] * 2
    logs = [file.read_text(errors="replace") for file in study.data.parent.rglob("*.log")]
    told = [log for log in logs if "match() failed, and nobody is matched" in log]
    assert told
    assert all(re.search(r"^agent.py:\d+: RuntimeError$", log, re.MULTILINE) for log in told)
    assert all(log.count("match() failed") == 1 for log in told)
