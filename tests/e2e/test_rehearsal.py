"""`make try`: bots walk through a study, report on it, and leave nothing behind in any case."""

from __future__ import annotations

import asyncio
import csv
import ctypes
import json
import os
import platform
import re
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from random import Random
from typing import Any

import psutil
import pytest

from hippodrome.bots.addresses import THIS_MACHINE, AddressRefused
from hippodrome.bots.bot import Bot
from hippodrome.bots.game import RandomKeys
from hippodrome.bots.links import with_project, with_user
from hippodrome.local.new import LEFT_OUT
from hippodrome.local.rehearsal.study_process import copy_of, servers_of
from hippodrome.trial.recordings.recording import read
from testing import processes
from testing.processes import ROOT
from testing.waiting import until

TGKILL = {"x86_64": 234, "aarch64": 131}.get(platform.machine(), -1)  # the system call that names a thread
Process = subprocess.Popen[str]


def rehearsal(*arguments: str | Path, **env: str) -> Process:
    return processes.start(
        "hippodrome",
        ["try", *map(str, arguments)],
        cwd=ROOT,
        env={**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "150", **env},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    )


def said(process: Process, seconds: float = 120) -> str:
    try:
        return process.communicate(timeout=seconds)[0]
    finally:
        process.kill()


def test_bots_walk_through_the_example_project(tmp_path: Path) -> None:
    process = rehearsal(ROOT, "--bots", "2", "--play", "2", "--data", tmp_path / "data")
    text = said(process)
    assert process.returncode == 0, text
    for line in ("ui.stop", "2 of 2: a bot plays 2 s (`--play 0`: to the end)", "6 of 6", "of 30 set", "none"):
        assert line in text
    assert servers_of(tmp_path / "data") == []
    assert len([*(tmp_path / "data").glob("ms-pacman/users/*/trials/*/*.gz")]) == 2
    made = [tmp_path / "data", *(tmp_path / "data").rglob("*")]
    assert [path.name for path in made if path.stat().st_mode & 0o077] == [], "they are their owner's alone"


def test_bots_end_at_a_page_without_a_button_and_the_report_tells_it(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    (folder / "steps").mkdir(parents=True)
    (folder / "config.yml").write_text("project: {id: screen, steps: {1: about, 2: screen, finalStep: end}}")
    pages = {
        "about": '<select name="colour" required><option>blue<option>red</select>',
        "screen": "{% if answers['1'].colour == 'red' %}<button hidden>x</button>{% else %}<h1>You are in</h1>{% endif %}",
        "end": '<a href="https://app.prolific.com/submissions/complete?cc=ABC">Back to Prolific</a>',
    }
    for name, text in pages.items():
        (folder / "steps" / f"{name}.html").write_text(text)
    process = rehearsal(folder, "--bots", "12", "--ramp", "0", "--data", tmp_path / "data")
    text = said(process)
    assert process.returncode == 0, text
    rows = {row[1].strip(): row[2].strip() for row in (line.split("│") for line in text.splitlines()) if len(row) == 4}
    users = tmp_path / "data" / "screen" / "users"
    colours = [json.loads(path.read_text())["answers"]["colour"] for path in users.glob("*/answers/1.json")]
    passed = colours.count("blue")
    assert 0 < passed < 12, "a chance of 1 in 2048"
    assert rows["bots finished"] == f"{passed} of 12"
    assert rows["ended before"].startswith(f"{12 - passed} at step 2, whose page had no button for them to press")
    assert rows["codes or links back shown"] == f"{passed} of {passed}"


def test_bots_play_in_pairs_and_one_of_an_odd_number_finds_no_other(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    shutil.copytree(ROOT / "examples" / "two-players", folder, ignore=LEFT_OUT)
    config = (folder / "config.yml").read_text()
    (folder / "config.yml").write_text(config.replace("patience: 120", "patience: 10"))
    process = rehearsal(folder, "--bots", "3", "--at-once", "1", "--play", "2", "--data", tmp_path / "data")
    text = said(process)
    assert process.returncode == 0, text
    rows = {row[1].strip(): row[2].strip() for row in (line.split("│") for line in text.splitlines()) if len(row) == 4}
    assert rows["games played together"] == "1 with 2 participants"
    assert rows["games stopped early"].startswith("1 of 1: "), "one of the two stops the game for both"
    assert re.fullmatch(r"1: bot-[0-9a-f]{6}-\d", rows["unmatched"])
    assert re.fullmatch(r"p50 \d+\.\d s, .*max 1[0-9]\.\d s", rows["wait in the lobby"])
    assert [rows[name] for name in ("bots finished", "games found", "codes or links back shown")] == ["3 of 3"] * 3
    assert rows["recordings"].startswith("1, with ")
    assert (rows["servers left over"], rows["errors"]) == ("0", "none")


def test_bots_play_a_game_with_the_default_break_to_its_end(project: Any, tmp_path: Path) -> None:
    """With a break between its two episodes, as studies have it by default."""
    process = rehearsal(project(length=30, betweenEpisodes=1), "--bots", "3", "--at-once", "2", "--play", "0")
    text = said(process)
    assert process.returncode == 0, text
    assert "copy" not in text
    assert "9 of 9" in text


def test_bots_play_a_game_with_pages_keys_and_limits_to_its_end(project: Any, tmp_path: Path) -> None:
    """The environment would go on for long; there are pages to read before it and between its episodes."""
    folder = project(
        length=100_000,
        instructions="after",
        betweenEpisodes="about",
        resetFreeze=0.5,
        maxSteps=20,
        keys={"ArrowLeft": "left", "a": "left", "ArrowRight": "right", "ArrowLeft+ArrowRight": "noop"},
        input="single",
    )
    data = tmp_path / "data"
    process = rehearsal(folder, "--bots", "2", "--play", "0", "--data", data)
    text = said(process)
    assert process.returncode == 0, text
    assert "2 of 2" in text
    recordings = [read(path.read_bytes()) for path in sorted(data.glob("tiny/users/*/trials/*/*.gz"))]
    assert len(recordings) == 4
    for lines in recordings:
        steps = [line for line in lines if line["kind"] == "step"]
        assert [line["truncated"] for line in steps] == [False] * 19 + [True]
        (end,) = [line for line in lines if line["kind"] == "end"]
        assert (end["why"], end["limit"]) == ("truncated", "maxSteps")
        if [line for line in lines if line["kind"] == "break"]:
            assert [line["why"] for line in lines if line["kind"] == "break"] == ["start"]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_nothing_is_left_when_it_is_interrupted(project: Any, tmp_path: Path, number: int) -> None:
    data = tmp_path / "data"
    process = rehearsal(project(length=3000), "--bots", "2", "--play", "100", "--data", data)
    until(lambda: len(servers_of(data)) >= 2, 60)
    process.send_signal(number)
    text = said(process, 60)
    assert process.returncode == 130, text
    assert "Traceback" not in text
    assert servers_of(data) == []


def test_its_study_and_servers_end_also_if_it_is_killed(project: Any, tmp_path: Path) -> None:
    data = tmp_path / "data"
    process = rehearsal(project(length=3000), "--bots", "1", "--play", "100", "--data", data)
    until(lambda: servers_of(data), 60)
    in_use = (tmp_path / ".hippodrome" / "data.lock").read_text()
    study = psutil.Process(int(re.findall(r"process (\d+)", in_use)[0]))
    process.kill()
    said(process)
    until(lambda: not study.is_running() and not servers_of(data), 60)


def interrupted(pid: int) -> bool:
    """Send Ctrl-C's signal to a thread of the process that is not its first; whether one has got it."""
    others = sorted({int(thread.name) for thread in Path(f"/proc/{pid}/task").iterdir()} - {pid})
    return any(ctypes.CDLL(None).syscall(TGKILL, pid, other, signal.SIGINT) == 0 for other in reversed(others))


@pytest.mark.skipif(sys.platform != "linux" or TGKILL < 0, reason="it needs a system call of Linux")
def test_ctrl_c_ends_it_whichever_thread_the_signal_reaches(project: Any, tmp_path: Path) -> None:
    data = tmp_path / "data"
    process = rehearsal(project(length=3000), "--bots", "1", "--play", "100", "--data", data)
    until(lambda: servers_of(data), 60)
    until(lambda: interrupted(process.pid), 60)  # there may be no other thread yet, or it has just ended
    text = said(process, 30)
    assert process.returncode == 130, text
    assert servers_of(data) == []


def test_the_rehearsal_says_what_is_missing(project: Any, tmp_path: Path) -> None:
    folder = project(start="raise RuntimeError('no such game')")
    process = rehearsal(folder, "--bots", "1", "--data", tmp_path / "data", TMPDIR=str(tmp_path))
    text = said(process)
    assert process.returncode == 1, text
    assert re.search(r"step 3: its server said last: .*RuntimeError: no such game", text), text
    assert "Rehearsal with 1 bot," in text
    assert "no recording" in text
    logs = tmp_path / ".hippodrome" / "data" / "logs"
    assert f"are in {logs}" in text
    assert "no such game" in next(logs.glob("s*.log")).read_text()
    assert (logs / "run.log").exists()
    assert servers_of(tmp_path / "data") == []


def test_the_error_of_an_agent_in_mid_game_is_printed(project: Any) -> None:
    folder = project()
    agent = folder / "agent.py"
    agent.write_text(agent.read_text().replace("self.t += 1", "raise ValueError('boom secret')"))
    text = said(rehearsal(folder, "--bots", "1"))
    assert re.search(r"error of the agent's: .*ValueError: boom secret", text), text


def test_an_agent_that_fails_late_and_goes_on_is_an_error_with_its_line_and_traceback(project: Any) -> None:
    folder = project(length=60, maxEpisodes=2)
    agent = folder / "agent.py"
    source = agent.read_text().replace(
        "self.t += 1", "self.t += 1\n        if self.t == 50: raise ValueError('boom at 50')"
    )
    agent.write_text(source)
    line = next(number for number, text in enumerate(source.splitlines(), 1) if "boom" in text)
    process = rehearsal(folder, "--bots", "2", "--play", "0")
    text = said(process)
    assert process.returncode == 1, text
    assert re.search(rf"errors .*agent\.py failed \d+ times: agent\.py:{line}: ValueError: boom at 50", text, re.DOTALL)
    assert "if self.t == 50: raise ValueError" in text  # the traceback
    assert "/rehearsal-" not in text


def test_the_data_of_bots_stay_apart_and_can_be_read(project: Any, tmp_path: Path, monkeypatch: Any) -> None:
    from hippodrome.cli import main

    folder = project(length=30)
    process = rehearsal(folder, "--bots", "2", "--play", "1")
    text = said(process)
    assert process.returncode == 0, text
    (data,) = (folder / "data-try").glob("try-*")
    assert not (folder / "data").exists()
    assert f"hippodrome data {folder} --from {data}" in text
    monkeypatch.chdir(tmp_path)
    assert main(["data", f"{folder}/", "--from", str(data)]) == 0
    with (folder / f"data-tiny-{data.name}" / "answers.csv").open(newline="") as table:
        assert len(list(csv.DictReader(table))) == 2
    assert [*copy_of(folder, tmp_path / "copy")]
    assert not (tmp_path / "copy" / "data-try").exists()


def test_bots_are_refused_in_a_folder_with_data_of_people(project: Any, tmp_path: Path) -> None:
    folder = project()
    (tmp_path / "people" / "tiny" / "users" / "ada").mkdir(parents=True)
    for place in (folder / "data", tmp_path / "people"):
        process = rehearsal(folder, "--bots", "1", "--data", place)
        assert "bots must not be among them" in said(process)
        assert process.returncode == 1
    (tmp_path / "file").write_text("")
    process = rehearsal(folder, "--bots", "1", "--data", tmp_path / "file")
    assert "cannot be stored" in said(process)


def test_a_broken_page_is_reported_once_with_its_name(project: Any, tmp_path: Path) -> None:
    folder = project(s3upload=False)
    (folder / "steps" / "after.html").write_text("<h1>After</h1>\n{{ nobody( }}")
    text = said(rehearsal(folder, "--bots", "2", "--play", "1", TMPDIR=str(tmp_path)))
    assert text.count("This page cannot be shown. ") + text.count("This page cannot be shown It") == 1
    assert re.search(r"2 times: bot-\w+-1: status 500 on the page after step 3", text)
    assert re.search(r"\d times: step page broken \(file after, line 2\)", text)
    assert "none expected: config.yml says `s3upload: false`" in text


def test_a_study_that_is_not_live_shows_no_codes(project: Any) -> None:
    text = said(rehearsal(project(live=False), "--bots", "1", "--play", "0"))
    assert "none expected: config.yml says `live: false`" in text


def test_a_project_with_mistakes_is_not_rehearsed(project: Any) -> None:
    folder = project()
    (folder / "steps" / "about.html").unlink()
    process = rehearsal(folder, "--bots", "1")
    assert "about" in said(process)
    assert process.returncode == 1


def test_bots_stay_on_this_machine(project: Any) -> None:
    process = rehearsal(project(), "--bots", "1", "--url", "http://studies.example.org/next?projectId=tiny")
    assert "bots only go to http://127.0.0.1" in said(process)
    assert process.returncode == 1
    for address in (
        "http://127.0.0.1.example.org/",
        "http://localhost@example.org",
        "https://10.0.0.1",
        "ftp://127.0.0.1",
    ):
        with pytest.raises(AddressRefused):
            THIS_MACHINE.page(address)
    assert THIS_MACHINE.server("ws://127.0.0.1:5000/")


def test_a_study_that_is_already_running_can_be_rehearsed(project: Any, hold: Any) -> None:
    study = hold(project(length=30))
    process = rehearsal(study.folder, "--bots", "2", "--url", study.link.split("/next")[0], "--data", study.data)
    text = said(process)
    assert process.returncode == 0, text
    assert "6 of 6" in text


def test_the_copy_differs_from_the_study_only_where_it_must(project: Any, tmp_path: Path) -> None:
    import yaml

    folder = project(live=False, ui={"fire": True})
    (folder / "picture.png").write_bytes(b"...")
    assert len(copy_of(folder, tmp_path / "copy")) == 2
    before, after = (yaml.safe_load((place / "config.yml").read_text()) for place in (folder, tmp_path / "copy"))
    assert after["trial"].pop("ui") == {"fire": True, "stop": True}
    before["trial"].pop("ui")
    assert after == {**before, "project": {**before["project"], "live": True}}
    assert (tmp_path / "copy" / "picture.png").read_bytes() == b"..."
    assert copy_of(tmp_path / "copy", tmp_path / "second") == []


def test_bots_need_no_invitation_and_are_never_too_many(project: Any, tmp_path: Path) -> None:
    import yaml

    folder = project()
    config = folder / "config.yml"
    tree = yaml.safe_load(config.read_text())
    own = {"signedLinks": True, "maxParticipants": 2, "maxServers": 1, "maxServerHours": 3}
    config.write_text(yaml.safe_dump({**tree, "project": {**tree["project"], **own}}, sort_keys=False))
    words = " and ".join(copy_of(folder, tmp_path / "copy"))
    assert all(key in words for key in ("maxParticipants", "maxServers", "maxServerHours", "signed"))
    assert yaml.safe_load((tmp_path / "copy" / "config.yml").read_text())["project"] == tree["project"]


def test_random_keys_are_keys_of_the_game() -> None:
    keys_pressed = RandomKeys(
        Random(1), {"UI": ["left", "up", "start", "good"], "actionSpace": ["noop", "left", "jump"]}
    )
    said = [message for _ in range(300) for message in keys_pressed.move()]
    assert {message["action"] for message in said if "action" in message} == {"left", "up", "jump"}
    assert {message["command"] for message in said if "command" in message} == {"good"}


def test_random_keys_are_the_keys_that_the_project_names() -> None:
    keys = {"ArrowLeft": "left", "x+y": "jump"}
    keys_pressed = RandomKeys(Random(1), {"UI": ["left", "up"], "actionSpace": ["noop", "left", "jump"], "keys": keys})
    said = [message for _ in range(300) for message in keys_pressed.move()]
    assert {message["key"] for message in said if "held" in message} == {"ArrowLeft", "x", "y"}
    assert {message["action"] for message in said if "action" in message} == {"left", "jump"}


def test_a_bot_gives_up_if_no_server_answers(free_port: int) -> None:
    bot = Bot(f"http://127.0.0.1:{free_port}/next?projectId=x", "ada", Random(0), patience=1)
    report = asyncio.run(bot.run())
    assert not report.finished
    assert "no answer from" in report.errors[0]


def test_the_link_gets_the_participants_id() -> None:
    assert (
        with_user("http://127.0.0.1/next?projectId=x&userId=old", "ada")
        == "http://127.0.0.1/next?projectId=x&userId=ada"
    )
    assert with_project("http://127.0.0.1:8000", "x") == "http://127.0.0.1:8000/next?projectId=x"
