"""Compares a study with warm servers (`warmServers`) and one without, on the simulated account and in local mode."""

from __future__ import annotations

import asyncio
import json
import random
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import msgspec
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from bench import table
from bench.bill import server_seconds
from bench.pages import KeptConnection, serving
from bench.scale import SEED, assumed, quantile, seconds_of
from bench.study_on_moto import ROOT
from bench.table import Row, each, row
from deploy.cost import estimate
from deploy.cost.prices import Prices
from hippodrome.model import ids, server, warm_pool
from testing.quiet_log import quiet
from testing.simulation.people import POLLS, SimulatedParticipant
from testing.simulation.world import PROJECT, SimulatedWorld
from testing.visitors import hidden

WARM = 10  # servers
OPENS, HOUR = 300.0, 3600.0  # seconds until the first participant comes; seconds in which participants come
GAPS = (10.0, 15.0)  # seconds between participants, uniform
BURST, WITHIN = 40, 10.0  # participants, seconds
CLOSES, ENDS = 5000.0, 7500.0  # the seconds at which the study is closed, and at which nothing may be left
READS = 2.0  # seconds for a page; participants who read longer would wait less
RUNS = 5  # participants in local mode, one after the other
SETTLES = 2.0  # seconds from a warm server's `ready` until a participant comes; by then its agent has made its imports
PATIENCE = 60.0  # seconds to wait for any condition in local mode


def rows() -> Iterator[Row]:
    """Measure a simulated hour, a simulated crowd, and a few participants in local mode; about a minute."""
    with quiet():
        yield from table.simulated(each([an_hour, a_burst]))
    yield from each([what_they_cost, for_real])


# Simulated


@dataclass(frozen=True)
class Came:
    """The outcome of a simulated study. Times are seconds, one for each participant."""

    world: SimulatedWorld
    took_warm_server: float  # the share of the participants who got a warm server
    to_shown: list[float]  # seconds from the answer that starts the server until the page has its address
    at_game: list[float]  # seconds from the first view of the game page until the page has the address
    calls: float  # AWS calls per participant


def simulated(warm: int, arrivals: Sequence[float], closes: float = CLOSES, ends: float = ENDS) -> Came:
    """Simulate participants who come at these seconds to a study with so many warm servers, which closes at `closes`.

    Raises RuntimeError if one of them did not come to a server before the second `ends`.
    """
    world = SimulatedWorld(SEED, project=msgspec.structs.replace(PROJECT, warm_servers=warm))
    world.ask_for_warm_servers()
    people = [SimulatedParticipant(world, number, read=READS) for number in range(len(arrivals))]
    for person, comes in zip(people, arrivals, strict=True):
        world.clock.spawn(person.walk, delay=comes)
    world.clock.after(closes, world.close)
    world.run(ends)
    kept, visits = world.platform.documents.kept, [person.visit for person in people]
    records = [json.loads(kept[server.key(ids.server_label(PROJECT.id, visit.user))][0]) for visit in visits]
    if late := [visit for visit in visits if visit.asked is None or visit.waiting is None or visit.ready is None]:
        raise RuntimeError(f"{len(late)} of {len(visits)} did not come to the game")
    return Came(
        world,
        sum(bool(record.get("spare")) for record in records) / len(records),
        [(visit.ready or 0) - (visit.asked or 0) for visit in visits],
        [(visit.ready or 0) - (visit.waiting or 0) for visit in visits],
        sum(world.cloud.calls.values()) / len(visits),
    )


def hour_of_arrivals() -> list[float]:
    """Return the seconds at which participants come, one after the other for an hour."""
    chance, found = random.Random(SEED), [OPENS]
    while found[-1] < OPENS + HOUR:
        found.append(found[-1] + chance.uniform(*GAPS))
    return found


def an_hour() -> Iterator[Row]:
    """Compare an hour in which the pool can keep up with the participants."""
    arrivals = hour_of_arrivals()
    came, without = simulated(WARM, arrivals), simulated(0, arrivals)
    name = f"{WARM} warm servers, a participant every {GAPS[0]:.0f} to {GAPS[1]:.0f} s for an hour"
    yield from _compared(name, came, without, goal=0.1)
    yield row(
        f"{name}: API calls per participant, against none warm",
        came.calls,
        "calls",
        yardstick=without.calls,
        detail={
            "participants": len(arrivals),
            "hours of servers": server_seconds(came.world) / HOUR,
            "none warm: hours of servers": server_seconds(without.world) / HOUR,
            "hours from the request of a warm server until it is taken or goes": _waited(came.world) / HOUR,
        },
    )
    yield row(
        f"{name}: left when the study is closed",
        sum(came.world.left().values()),
        "things",
        bound="no server outlives its study",
        at_most=0,
        detail=dict(came.world.left()),
    )


def a_burst() -> Iterator[Row]:
    """Compare a crowd that is larger than the pool."""
    chance = random.Random(SEED)
    arrivals = [OPENS + chance.uniform(0, WITHIN) for _ in range(BURST)]
    came, without = simulated(WARM, arrivals), simulated(0, arrivals)
    yield from _compared(f"{WARM} warm servers, {BURST} participants within {WITHIN:.0f} s", came, without)


def _compared(name: str, came: Came, without: Came, goal: float | None = None) -> Iterator[Row]:
    for kind, mine, theirs in (
        ("asked for a server until the page shows it", came.to_shown, without.to_shown),
        ("wait at the game page", came.at_game, without.at_game),
    ):
        yield row(
            f"{name}: {kind}, p50, against none warm",
            quantile(mine, 0.5),
            "s",
            yardstick=quantile(theirs, 0.5),
            at_most=goal,
            detail={
                "p50, p95, max": [quantile(mine, 0.5), quantile(mine, 0.95), max(mine)],
                "none warm: p50, p95, max": [quantile(theirs, 0.5), quantile(theirs, 0.95), max(theirs)],
                "participants who got a warm server": f"{100 * came.took_warm_server:.0f} %",
                "participants read a page for": f"{0.5 * READS:g} to {1.5 * READS:g} s",
                **(
                    {f"assumed: {thing}": text for thing, text in assumed(came.world.conditions).items()}
                    if goal
                    else {}
                ),
            },
        )


def _waited(world: SimulatedWorld) -> float:
    """Return the seconds for which all warm servers together existed before they were assigned or removed."""
    records = [
        json.loads(body) for key, (body, _, _) in world.platform.documents.kept.items() if _is_warm_server(key, body)
    ]
    return sum(seconds_of(record["closed"]) - seconds_of(record["requested"]) for record in records)


def _is_warm_server(key: str, body: bytes) -> bool:
    return key.startswith(server.RECORDS) and ids.is_warm_id(json.loads(body).get("userId"))


def what_they_cost() -> Iterator[Row]:
    """Compute the price of the warm servers while they wait."""
    prices = Prices()
    warm = estimate.warm(PROJECT.id, WARM, PROJECT.size.cpu, PROJECT.size.memory, prices)
    yield row(
        f"computed: {WARM} warm servers of {warm.cpu:g} vCPU and {warm.memory:g} GB, an hour of waiting on Spot",
        warm.spot.likely,
        "$",
        yardstick=warm.on_demand.likely,
        detail={"Spot from, to": [warm.spot.low, warm.spot.high], "prices": prices.note(prices.region)},
    )


# In local mode


CONFIG = """
project:
  id: warm
  live: true
  maxRuntime: 5
  warmServers: {warm}
  steps: {{1: hello, 2: game, finalStep: end}}
  events: {{startServerStep: 2}}
trial:
  game: ALE/MsPacman-v5
  maxEpisodes: 1
  startingFrameRate: 30
  ui: {{start: true, stop: true}}
"""


def write_study(folder: Path, warm: int) -> None:
    """Write a study with one page, the example's game with its agent, and a last page."""
    (folder / "steps").mkdir(parents=True)
    (folder / "config.yml").write_text(CONFIG.format(warm=warm))
    shutil.copy(ROOT / "agent.py", folder)
    (folder / "steps" / "hello.html").write_text("<h1>hello</h1><input name=word><button>Go on</button>")
    (folder / "steps" / "end.html").write_text("<h1>end</h1>")


def in_local_mode(warm: int, participants: int) -> list[float]:
    """Let participants come one after the other; return for each the seconds from the form to the first picture.

    The form is the one that starts a server.
    """
    with tempfile.TemporaryDirectory(prefix="bench-") as name:
        folder = Path(name)
        write_study(folder, warm)
        took = []
        with serving([sys.executable, "-m", "local", ".", "--port", "0"], folder) as address:
            for number in range(participants):
                if warm:
                    _wait_for_pool(folder / "data", warm)
                    time.sleep(SETTLES)
                took.append(asyncio.run(asyncio.wait_for(_to_first_picture(address, f"P{number}"), PATIENCE)))
        return took


def _wait_for_pool(data: Path, warm: int) -> None:
    """Wait until so many servers are ready. Raises RuntimeError after PATIENCE."""
    pool, until = data / warm_pool.pool_key("warm"), time.monotonic() + PATIENCE
    while sum(one.get("ready", False) for one in _read(pool).get("spares", {}).values()) < warm:
        if time.monotonic() > until:
            raise RuntimeError("the warm servers do not get ready")
        time.sleep(0.1)


def _read(file: Path) -> Mapping[str, Any]:
    try:
        found: Mapping[str, Any] = json.loads(file.read_bytes())
    except FileNotFoundError:
        return {}
    return found


async def _to_first_picture(address: str, user: str) -> float:
    line, target = KeptConnection(address), f"/next?projectId=warm&userId={user}"
    try:
        page = (await line.ask("GET", target)).body.decode()
        begun = time.perf_counter()
        await line.ask("POST", target, urlencode({**hidden(page), "word": "hello"}).encode())
        while (state := json.loads((await line.ask("GET", f"{target}&poll=2")).body))["state"] != "ready":
            if state["state"] in ("failed", "ended"):
                raise RuntimeError(f"the server is {state['state']}: {state['reason']}")
            await asyncio.sleep(0.05)
        options: dict[str, Any] = {"compression": None, "max_size": None, "proxy": None}
        async with connect(state["url"], subprotocols=[Subprotocol("hippodrome.1")], **options) as ws:
            await ws.send(json.dumps({"userId": user, "token": state["token"], "step": "2"}))
            while not isinstance(await ws.recv(), bytes):
                pass
            took = time.perf_counter() - begun
            await ws.send('{"command": "start"}')
            await ws.send('{"command": "stop"}')
            async for message in ws:  # until the trial is over, so that it takes no time from the next participant
                if isinstance(message, str) and json.loads(message).get("done"):
                    break
            return took
    finally:
        line.close()


def for_real() -> Iterator[Row]:
    """Compare one warm server and none with `python -m local` and real trial processes."""
    warm, cold = in_local_mode(1, RUNS), in_local_mode(0, RUNS)
    yield row(
        "local mode: form that asks for a server to the first picture, 1 warm server, against none",
        statistics.median(warm),
        "s",
        yardstick=statistics.median(cold),
        at_most=0.5,
        detail={
            "each": warm,
            "none warm, each": cold,
            "the agent": "the example's; one that loads a model gains more",
            "participants": f"{RUNS}, one after the other; the next comes {SETTLES:g} s after a server is ready again",
            "the client": f"polls every 50 ms; a browser's page every {POLLS['first']:g} to {POLLS['longest']:g} s",
        },
    )
