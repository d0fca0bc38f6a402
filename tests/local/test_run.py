"""A real `hippodrome run`: walked through, killed, started again, ended."""

from __future__ import annotations

import ctypes
import gzip
import json
import os
import platform
import random
import re
import shutil
import signal
import socket
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import httpx
import pytest
from websockets.exceptions import WebSocketException

from testing.waiting import until
from tests.local.conftest import Local
from tests.local.walk import Walker, at_the_game

TGKILL = {"x86_64": 234, "aarch64": 131}.get(platform.machine(), -1)
"""The number of the system call tgkill, which the C library may not have as a function."""

Make = Callable[..., Local]


def test_a_participant_goes_through_the_study(local: Make) -> None:
    here = local().run()
    walker = Walker(here.url, "quick", "P-123456789")
    walker.answer(word="secret words")
    last = walker.play(walker.until("ready"))
    assert last["score"] == 30
    walker.answer(word="more secrets")
    assert "<h1>end</h1>" in walker.page()
    here.wait_for_text(r"server gone \(stopped\)")

    users = here.data / "quick" / "users" / "P-123456789"
    assert sorted(path.name for path in (users / "answers").iterdir()) == ["1.json", "2.json", "3.json"]
    assert json.loads((users / "answers" / "1.json").read_text())["answers"] == {"word": "secret words"}
    [recording] = (users / "trials").rglob("*.gz")
    assert b'"end"' in gzip.decompress(recording.read_bytes())
    assert not [path for path in here.data.rglob("*") if path.name.startswith(".") or path.suffix in (".new", ".part")]

    _gone(here, 10)

    text = here.text()
    told = [line.split("  ")[-1] for line in text.splitlines() if "P-1234…" in line]
    in_order = ["arrived", "answered step 1 (hello)", "played step 2", "answered step 3 (bye)"]
    assert [line for line in told if line in in_order] == in_order
    assert "came to the end of the study" in told
    assert any(line.startswith("server ready at ws://127.0.0.1:") for line in told)
    assert "secret" not in text
    assert "P-123456789" not in text
    assert "{" not in text, "what the functions log belongs into a file"


def test_after_a_kill_during_a_game_it_goes_on_where_it_was_on_another_server(local: Make) -> None:
    here = local(frames=240, holds=120).run()
    walker = at_the_game(here.url)
    with walker.connect(walker.until("ready")) as game:
        game.send(json.dumps({"command": "start"}))
        for _ in range(60):
            game.recv()
        here.kill()
    here.let_go_on()
    here.run()
    here.wait_for_text(r"The last run was killed\. Its 1 server\(s\) were ended")
    again = Walker(here.url, "quick", "P1")
    assert again.play(again.until("ready", attempt=2))["score"] == 240
    again.answer(word="two")
    here.wait_for_text(r"server gone \(stopped\)")
    _gone(here)
    lines = [
        json.loads(line)
        for path in sorted((here.data / "quick" / "users" / "P1" / "trials").rglob("*.gz"))
        for line in gzip.decompress(path.read_bytes()).splitlines()
    ]
    assert "resume" in {line["kind"] for line in lines}


def test_a_trial_that_ended_between_two_runs_is_not_replaced(local: Make) -> None:
    here = local(frames=60).run()
    walker = at_the_game(here.url)
    state = walker.until("ready")
    here.kill()
    walker.play(state)
    _gone(here)
    here.run()
    assert "<h1>bye</h1>" in Walker(here.url, "quick", "P1").page()
    assert here.servers() == []


def test_a_server_that_was_lost_between_two_runs_is_replaced(local: Make) -> None:
    here = local().run()
    walker = at_the_game(here.url)
    walker.until("ready")
    here.kill()
    os.killpg(_group(here), signal.SIGKILL)
    here.run()
    here.wait_for_text(r"server gone \(its process was killed\)")
    again = Walker(here.url, "quick", "P1")
    state = again.until("ready")
    assert state["attempt"] == 2
    assert again.play(state)["score"] == 30


def test_ctrl_c_ends_everything_and_keeps_what_was_played(local: Make) -> None:
    here = local(frames=100_000).run()
    walker = at_the_game(here.url)
    with walker.connect(walker.until("ready")) as game:
        game.send(json.dumps({"command": "start"}))
        for _ in range(60):
            game.recv()
        began = time.monotonic()
        assert here.end() == 0
        assert time.monotonic() - began < 10
    assert here.servers() == []
    assert "Ended. The data are in" in here.text()
    [recording] = here.data.rglob("*.gz")
    lines = gzip.decompress(recording.read_bytes()).splitlines()
    assert len(lines) > 30

    here.run()  # and the participant can go on
    again = Walker(here.url, "quick", "P1")
    assert again.until("ended")["again"] is True


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_other_signals_end_the_study_too(local: Make, number: int) -> None:
    here = local().run()
    Walker(here.url, "quick", "P1").page()
    here.wait_for_text("server ready")
    assert here.end(number) == 0
    assert here.servers() == []


@pytest.mark.skipif(sys.platform != "linux" or TGKILL < 0, reason="it needs a system call of Linux")
def test_ctrl_c_ends_it_whichever_thread_the_signal_reaches(local: Make) -> None:
    """The system chooses the thread. Python calls the handler in the main thread alone, which sleeps until then."""
    here = local().run()
    assert here.process
    *_, other = sorted(int(thread.name) for thread in Path(f"/proc/{here.process.pid}/task").iterdir())
    assert other != here.process.pid
    assert ctypes.CDLL(None, use_errno=True).syscall(TGKILL, here.process.pid, other, signal.SIGINT) == 0
    assert here.process.wait(60) == 0


def test_an_agent_that_hangs_does_not_hold_up_ctrl_c(local: Make) -> None:
    here = local()
    agent = here.folder / "agent.py"
    agent.write_text(agent.read_text().replace("self.n += 1", "import time; time.sleep(1000)"))
    here.run()
    walker = at_the_game(here.url)
    with walker.connect(walker.until("ready")) as game:
        game.send(json.dumps({"command": "start"}))
        time.sleep(1)
        began = time.monotonic()
        assert here.end() == 0
        assert time.monotonic() - began < 12
    assert here.servers() == []


def test_a_second_run_on_the_same_data_is_refused(local: Make) -> None:
    here = local().run()
    other = Local(here.folder, here.place)
    other.output = here.place / "other.txt"
    assert other.begin().wait(60) == 1
    assert f"already runs with the data in data, at {here.url}" in other.text()
    assert here.process
    assert here.process.poll() is None


def test_a_port_in_use_leads_to_the_next(local: Make) -> None:
    here = local()
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        here.run("--port", str(port))
        assert here.url != f"http://127.0.0.1:{port}"
        here.wait_for_text(f"Port {port} is in use")
        assert httpx.get(f"{here.url}/healthz").text == "ok\n"


def test_mistakes_in_the_project_are_reported_and_nothing_starts(local: Make) -> None:
    here = local()
    config = here.folder / "config.yml"
    config.write_text(config.read_text().replace("maxEpisodes: 1", "maxEpisodes: none"))
    assert here.begin().wait(60) == 1
    assert "config.yml:10: trial.maxEpisodes" in here.text()
    assert "Traceback" not in here.text()


def test_a_study_that_is_not_live_says_so(local: Make) -> None:
    here = local(live=False).run()
    here.wait_for_text("live: false")
    assert httpx.get(f"{here.url}/next?projectId=quick").status_code == 404


def test_a_study_with_signed_links_shows_one_that_is_let_in(local: Make) -> None:
    here = local()
    config = here.folder / "config.yml"
    config.write_text(config.read_text().replace("live: true", "live: true\n  signedLinks: true"))
    here.run()
    link = here.wait_for_text(r"Link\s+(http://\S+)")[1]
    assert httpx.get(link, follow_redirects=True).status_code == 200
    assert httpx.get(link.partition("&")[0]).status_code == 403


def test_an_edited_page_is_shown_after_a_reload(local: Make) -> None:
    here = local(start=2).run()
    walker = Walker(here.url, "quick", "P1")
    assert "<h1>hello</h1>" in walker.page()
    (here.folder / "steps" / "hello.html").write_text("<h1>Good day</h1>")
    here.wait_for_text("steps/hello.html changed")
    until(lambda: "<h1>Good day</h1>" in walker.page())  # the change is printed before it is published

    config = here.folder / "config.yml"
    good = config.read_text()
    config.write_text(good.replace("1: hello", "1: nowhere"))
    here.wait_for_text("The study goes on as it was")
    here.wait_for_text("nowhere.html")
    assert "<h1>Good day</h1>" in walker.page()
    config.write_text(good.replace("live: true", "live: false"))
    here.wait_for_text("live: false")
    assert httpx.get(walker.link).status_code == 404


def test_an_agent_saved_with_a_syntax_error_is_reported_in_one_message(local: Make) -> None:
    here = local(start=2).run()
    agent = here.folder / "agent.py"
    good = agent.read_text()
    agent.write_text(f"{good}\n")
    here.wait_for_text(r"agent\.py changed: servers that start from now on run it")
    agent.write_text("def start(:\n")
    here.wait_for_text(
        r"agent\.py:1: Python cannot read this: invalid syntax; servers that start from now on fail until it is mended"
    )
    agent.write_text(good)
    here.wait_for_text("No mistakes are left")
    assert here.text().count("Python cannot read this") == 1
    assert here.text().count("servers that start from now on run it") == 2


def test_the_error_of_a_broken_agent_is_printed(local: Make) -> None:
    here = local()
    agent = here.folder / "agent.py"
    agent.write_text(agent.read_text().replace("self.env = Env()", "self.env = Envy()"))
    here.run()
    Walker(here.url, "quick", "P1").page()
    here.wait_for_text("name 'Envy' is not defined")


def test_the_error_of_an_agent_that_cannot_start_comes_with_the_advice_of_make_check(local: Make) -> None:
    here = local()
    agent = here.folder / "agent.py"
    agent.write_text("import cv2_of_nobody\n" + agent.read_text())
    here.run()
    Walker(here.url, "quick", "P1").page()
    here.wait_for_text(
        r"agent\.py:1: ModuleNotFoundError: No module named 'cv2_of_nobody'; name its package in a requirements\.txt"
    )


def test_fresh_moves_the_data_aside(local: Make) -> None:
    here = local().run()
    walker = at_the_game(here.url)
    walker.until("ready")
    here.kill()
    here.run("--fresh")
    _gone(here)
    here.wait_for_text("Earlier data are in .hippodrome/earlier/data-")
    [moved] = (here.place / ".hippodrome" / "earlier").rglob("answers/1.json")
    assert "one" in moved.read_text()
    assert "<h1>hello</h1>" in Walker(here.url, "quick", "P1").page()


def _group(here: Local) -> int:
    [task] = (here.state / "tasks").glob("s*.json")
    return int(json.loads(task.read_text())["pid"])


def _gone(here: Local, seconds: float = 60) -> None:
    until(lambda: not here.servers(), seconds)


def test_repeated_kills_lose_nothing_and_leave_nothing(local: Make) -> None:
    here = local(frames=400).run()
    port = here.url.rpartition(":")[2]
    people = [f"P{n}" for n in range(4)]
    walks = [threading.Thread(target=_walk_whatever_happens, args=[here.url, user], daemon=True) for user in people]
    for walk in walks:
        walk.start()
    dice = random.Random(1)
    for n in range(5):
        time.sleep(dice.uniform(0.1, 1.5))
        here.kill()
        if n % 2:
            here.begin("--port", port)
            time.sleep(dice.uniform(0.3, 1.0))  # while the process starts
            here.kill()
        here.run("--port", port)
        assert here.url.endswith(port)
    for walk in walks:
        walk.join(60)
        assert not walk.is_alive(), here.text()
    _gone(here)
    for user in people:
        answers = here.data / "quick" / "users" / user / "answers"
        assert json.loads((answers / "1.json").read_text())["answers"] == {"word": f"hello {user}"}
        assert json.loads((answers / "3.json").read_text())["answers"] == {"word": f"bye {user}"}
        assert (answers / "2.json").exists()
    assert here.end() == 0
    assert {json.loads(path.read_text())["state"] for path in (here.data / "_servers").iterdir()} == {"closed"}
    assert not list((here.state / "spool").rglob("*.part"))


def _walk_whatever_happens(url: str, user: str) -> None:
    """Take part, and reload the page whenever it does not answer."""
    walker = Walker(url, "quick", user)
    while True:
        try:
            page = walker.page()
            if "<h1>end</h1>" in page:
                return
            word = next((word for word in ("hello", "bye") if f"<h1>{word}</h1>" in page), None)
            if word:
                walker.answer(word=f"{word} {user}")
            else:
                state = walker.state()
                if state.get("state") == "ready":
                    walker.play(state)
                elif state.get("again"):
                    walker.ask_again()
                time.sleep(0.1)
        except (httpx.HTTPError, OSError, WebSocketException, AssertionError):
            time.sleep(0.2)


def test_a_broken_page_is_reported_with_its_line(local: Make) -> None:
    here = local(start=2)
    (here.folder / "steps" / "hello.html").write_text("<h1>Hello</h1>\n{{ nobody( }}")
    here.run()
    assert httpx.get(f"{here.url}/next?projectId=quick&userId=P1").status_code == 500
    here.wait_for_text(r"broken \(file hello, line 2\)")


def test_a_participant_whose_documents_were_deleted_gets_another_server(local: Make) -> None:
    """The old server has the same name as the new one, and its end must not count as the new one's end."""
    here = local(start=1).run()
    walker = at_the_game(here.url)
    before = walker.until("ready")
    shutil.rmtree(here.data / "quick" / "users" / "P1")
    for record in (here.data / "_servers").iterdir():
        record.unlink()
    walker.answer(word="one")
    state = walker.until("ready")
    assert state["token"] != before["token"]
    assert len(here.servers()) == 1
    walker.play(state)
    walker.answer(word="two")
    assert "<h1>end</h1>" in walker.page()
    _gone(here)


@pytest.mark.parametrize("what", ["data", "project_master_list.json", "_secret.json", "quick/steps"])
def test_deleted_data_are_reported_and_the_study_goes_on(local: Make, what: str) -> None:
    here = local(start=1).run()
    walker = at_the_game(here.url)
    walker.until("ready")
    kept = {name: (here.data / name).read_text() for name in ("_secret.json", "project_master_list.json")}
    time.sleep(1.2)  # it looks twice a second
    path = here.data if what == "data" else here.data / what
    gone = path.rename(here.data.parent / "gone")  # all of it at once
    shutil.rmtree(gone) if gone.is_dir() else gone.unlink()
    here.wait_for_text("WAS DELETED")
    here.wait_for_text("published again")
    time.sleep(1.5)
    assert here.text().count("WAS DELETED") == here.text().count("published again") == 1
    again = Walker(here.url, "quick", "P1")
    if what == "data":
        here.wait_for_text(r"1 server\(s\) whose records were deleted")
        assert "<h1>hello</h1>" in again.page()
        again.answer(word="two")
    assert (here.data / "_secret.json").read_text() == kept["_secret.json"]
    salts = [
        [each["salt"] for each in json.loads(text)["projects"]]
        for text in (kept["project_master_list.json"], (here.data / "project_master_list.json").read_text())
    ]
    assert salts[0] == salts[1] != [""]
    assert again.play(again.until("ready"))["score"] == 30
    assert "<h1>bye</h1>" in again.page()
    assert here.text().count("answered step 1") == (2 if what == "data" else 1)


def test_data_deleted_between_two_runs_cause_no_error(local: Make) -> None:
    here = local(start=1).run()
    for _ in range(2):
        walker = at_the_game(here.url)
        assert walker.play(walker.until("ready"))["score"] == 30
        assert here.end() == 0
        shutil.rmtree(here.data)
        here.run()


def test_after_ctrl_c_the_participant_is_told_that_the_study_was_stopped(local: Make) -> None:
    here = local(frames=100_000).run()
    walker = at_the_game(here.url)
    walker.until("ready")
    assert here.end() == 0
    here.run()
    again = Walker(here.url, "quick", "P1")
    assert again.until("ended")["reason"] == "stopped"
    assert "The researchers ended your game." in again.page()


def test_a_folder_without_a_study_is_reported(local: Make) -> None:
    here = local()
    here.folder = here.place
    assert here.begin().wait(60) == 1
    assert "config.yml" in here.text()
    assert "Traceback" not in here.text()


def test_an_unusable_data_folder_is_reported(local: Make) -> None:
    here = local()
    (here.place / "data").write_text("a file")
    assert here.begin().wait(60) == 1
    assert "The study cannot run with the data in data" in here.text()
    assert "Traceback" not in here.text()


def test_an_invalid_origin_is_refused_in_a_sentence(local: Make) -> None:
    here = local()
    assert here.begin("--origin", "localhost:3000").wait(60) == 2
    assert "Write it like http://localhost:3000" in here.text()


def test_an_agent_reads_earlier_answers_that_its_game_names(local: Make) -> None:
    here = local()
    config = here.folder / "config.yml"
    steps = """
    - hello
    - each: {look: [a, b]}
      order: fixed
      steps: [game: {answers: [hello, bye]}, bye]
    - end"""
    text = config.read_text().replace(" {1: hello, 2: game, 3: bye, finalStep: end}", steps)
    config.write_text(re.sub(r"  events: .*\n", "", text))
    source = here.folder / "agent.py"
    source.write_text(source.read_text() + "    def on_session_start(self, session):\n        return session.answers\n")
    here.run()
    walker = Walker(here.url, "quick", "P1")
    walker.answer(word="hi")
    for word in ("first", "second"):
        walker.play(walker.until("ready"))
        walker.answer(word=word)
    assert "<h1>end</h1>" in walker.page()
    told = {}
    for path in (here.data / "quick" / "users" / "P1" / "trials").rglob("*.gz"):
        lines = [json.loads(line) for line in gzip.decompress(path.read_bytes()).splitlines()]
        (value,) = [line["value"] for line in lines if line.get("callback") == "on_session_start"]
        told[lines[0]["step"]] = value
    hello = {"hello": {"word": "hi"}}
    assert told == {"game-a": hello, "game-b": {**hello, "bye": {"a": {"word": "first"}}}}
