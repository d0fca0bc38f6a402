"""Warm servers for participants, in a real `hippodrome run`."""

from __future__ import annotations

import gzip
import json
import os
import signal
from collections import deque
from collections.abc import Callable

import pytest
from websockets.exceptions import ConnectionClosedError

from hippodrome.local.rehearsal.study_process import servers_of
from testing.waiting import PATIENCE, until
from tests.local.conftest import Local
from tests.local.walk import Walker, at_the_game

Make = Callable[..., Local]


def ready(here: Local, number: int) -> None:
    """Wait until so many servers have become warm since the start. The sweep replaces a failed one after 20 s."""
    here.wait_for_text(rf"(?s)(a warm server is ready.*?){{{number}}}", seconds=60)


def wait_for(here: Local, number: int) -> None:
    """Wait until so many servers have a process."""
    until(lambda: len(here.servers()) == number)


def test_a_participant_gets_a_warm_server_and_their_recording_has_its_usual_place(local: Make) -> None:
    here = local(warm=1).run()
    ready(here, 1)
    (waiting,) = here.servers()
    walker = at_the_game(here.url)
    state = walker.until("ready")
    assert waiting in here.servers()
    assert [process.environ()["SERVER"] for process in servers_of(here.data, {"P1"})].count(waiting) >= 1
    assert walker.play(state)["score"] == 30
    walker.answer(word="two")
    assert "<h1>end</h1>" in walker.page()
    here.wait_for_text(r"has a warm server at ws://127\.0\.0\.1:\d+")
    here.wait_for_text("played step 2")
    here.wait_for_text(r"server gone \(stopped\)")

    users = here.data / "quick" / "users" / "P1"
    assert json.loads((users / "answers" / "2.json").read_text())["answers"]["score"] == 30
    [recording] = (users / "trials").rglob("*.gz")
    assert recording.parent.name.endswith("-1")
    assert recording.parent.name != waiting
    assert json.loads(gzip.decompress(recording.read_bytes()).splitlines()[0])["userId"] == "P1"
    assert not list((here.data / "quick" / "handovers").glob("*.json"))
    ready(here, 2)
    wait_for(here, 1)


def test_a_warm_server_admits_only_its_participant(local: Make) -> None:
    here = local(warm=1).run()
    ready(here, 1)
    walker = at_the_game(here.url)
    state = walker.until("ready")
    other = Walker(here.url, "quick", "P2")
    with other.connect(state) as game, pytest.raises(ConnectionClosedError) as closed:
        deque(game, maxlen=0)
    assert closed.value.rcvd
    assert closed.value.rcvd.code == 4401
    assert walker.play(state)["score"] == 30


def test_warm_servers_are_replaced_whether_lost_while_waiting_or_in_play(local: Make) -> None:
    here = local(warm=1, frames=240, holds=120).run()
    ready(here, 1)
    for process in servers_of(here.data):
        os.kill(process.pid, signal.SIGKILL)
    ready(here, 2)
    walker = at_the_game(here.url)
    state = walker.until("ready")
    ready(here, 3)
    with walker.connect(state) as game:
        game.send(json.dumps({"command": "start"}))
        for _ in range(60):
            game.recv(timeout=PATIENCE)
        for process in servers_of(here.data, {"P1"}):
            os.kill(process.pid, signal.SIGKILL)
        here.let_go_on()
    again = walker.until("ready", attempt=2)
    assert walker.play(again)["score"] == 240


def test_a_changed_agent_replaces_the_warm_servers(local: Make) -> None:
    here = local(warm=1).run()
    ready(here, 1)
    (before,) = here.servers()
    agent = here.folder / "agent.py"
    agent.write_text(agent.read_text().replace(">= 30", ">= 40"))
    here.wait_for_text(r"a warm server is gone \(stopped\)")
    ready(here, 2)
    wait_for(here, 1)
    assert here.servers() != [before]
    walker = at_the_game(here.url)
    assert walker.play(walker.until("ready"))["score"] == 40


def test_no_warm_server_is_left_when_the_run_ends_or_the_study_is_closed(local: Make) -> None:
    here = local(warm=2).run()
    ready(here, 2)
    config = here.folder / "config.yml"
    config.write_text(config.read_text().replace("live: true", "live: false"))
    wait_for(here, 0)
    config.write_text(config.read_text().replace("live: false", "live: true"))
    wait_for(here, 2)
    assert here.end() == 0
    assert here.servers() == []
