"""Measures pages and the start of a game with `hippodrome run`."""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from websockets.sync.client import connect
from websockets.typing import Subprotocol

from bench.row import Row, row
from bench.study import ANSWERS, PATIENCE, ROOT, Visitor, copy_example, folder, running, write_game

GAME_PAGE = 40 * 1024  # bytes
PEOPLE = 100  # participants at once
STARTS = 3  # servers, one after the other


def pages() -> Iterator[Row]:
    """Measure the weight of the example's pages, as they go over the network to a browser that accepts gzip."""
    weights = {}
    with folder() as study:
        copy_example(study)
        with running(study) as address:
            visitor = Visitor(address, "ms-pacman", "P1")
            while (step := visitor.open()) in ANSWERS:
                weights[step] = visitor.weight
                visitor.answer(ANSWERS[step])
            game = visitor.weight
    yield row(
        "the heaviest page before the game, compressed",
        max(weights.values()),
        "bytes",
        decides="a participant on a slow network waits for each page; the bill counts data that leave AWS",
        detail={f"step {step}": weight for step, weight in weights.items()},
    )
    yield row(
        "the page of the game, compressed",
        game,
        "bytes",
        at_most=GAME_PAGE,
        decides="a participant on a slow network waits for it before the game",
    )


def crowd() -> Iterator[Row]:
    """Measure participants who go through the pages of one machine at the same moment, without pauses."""
    with folder() as study:
        (study / "steps").mkdir()
        for file in (ROOT / "steps").glob("*.html"):
            (study / "steps" / file.name).write_bytes(file.read_bytes())
        (study / "config.yml").write_text(
            "project:\n  id: crowd\n  live: true\n  steps:\n"
            "    1: consent\n    2: questionnaire\n    3: survey\n    finalStep: debrief\n"
        )
        with running(study) as address, ThreadPoolExecutor(PEOPLE) as people:
            begun = time.perf_counter()
            waits = [wait for walk in people.map(lambda n: _through(address, n), range(PEOPLE)) for wait in walk]
            seconds = time.perf_counter() - begun
        answers = len(list(study.glob("data/crowd/users/*/answers/*.json")))
    if answers != PEOPLE * len(ANSWERS):
        raise RuntimeError(f"{answers} answers are stored of {PEOPLE} participants")
    yield row(
        f"{PEOPLE} participants at once on one machine, p99 of a request",
        1000 * statistics.quantiles(waits, n=100)[-1],
        "ms",
        decides="whether `make run` serves a class in a computer room",
        detail={"requests a second": len(waits) / seconds, "the clients": "threads of one process on this machine"},
    )


def _through(address: str, number: int) -> list[float]:
    visitor = Visitor(address, "crowd", f"P{number}")
    for answers in ANSWERS.values():
        visitor.open()
        visitor.answer(answers)
    if (step := visitor.open()) != "final":
        raise RuntimeError(f"a participant got no further than step {step}")
    return visitor.waits


SUBPROTOCOLS = [Subprotocol("hippodrome"), Subprotocol("hippodrome.1")]  # the second: checkouts of November 2026
CONFIG = """
trial:
  game: ALE/MsPacman-v5
  maxEpisodes: 1
  startingFrameRate: 30
  ui: {start: true, stop: true}
"""


def first_picture() -> Iterator[Row]:
    """Measure the start of servers of the example's game."""
    with folder() as study:
        write_game(study, CONFIG, Path(ROOT, "agent.py").read_text(encoding="utf-8"))
        with running(study) as address:
            took = [
                _to_first_picture(Visitor(address, "bench", f"P{number}"), f"P{number}") for number in range(STARTS)
            ]
    yield row(
        "on one machine, from the answer that calls for a server to the first picture",
        statistics.median(took),
        "s",
        decides="the part of a participant's wait that is the server's own start; how soon a researcher sees a change",
        detail={"runs": took},
    )


def _to_first_picture(visitor: Visitor, user: str) -> float:
    visitor.open()
    begun = time.perf_counter()
    visitor.answer({"word": "hello"})
    while (state := visitor.poll("2"))["state"] != "ready":
        if time.perf_counter() - begun > PATIENCE:
            raise RuntimeError(f"no server after {PATIENCE:g} s: {state}")
        time.sleep(0.05)
    with connect(state["url"], subprotocols=SUBPROTOCOLS, max_size=None, proxy=None) as socket:
        socket.send(json.dumps({"userId": user, "token": state["token"], "step": "2"}))
        while not isinstance(socket.recv(PATIENCE), bytes):
            pass
        took = time.perf_counter() - begun
        socket.send('{"command": "start"}')
        socket.send('{"command": "stop"}')
        for message in socket:  # until the trial is over, so that it takes no time from the next one
            if isinstance(message, str) and json.loads(message).get("done"):
                break
    return took
