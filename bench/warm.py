"""Servers that are kept warm (`warmServers`) and none: on the simulated account, and for real in local mode."""

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

from bench.bill import server_seconds
from bench.pages import KeptConnection, serving
from bench.scale import SEED, assumed, quantile, seconds_of
from bench.study_on_moto import ROOT
from bench.table import Row, each, row
from deploy.cost import estimate
from deploy.cost.prices import Prices
from hippodrome.model import ids, server, warm_pool
from testing.quiet_log import quiet
from testing.simulation.people import SimulatedParticipant
from testing.simulation.world import PROJECT, SimulatedWorld
from testing.visitors import hidden

WARM = 10  # servers
OPENS, HOUR = 300.0, 3600.0  # seconds from the registration to the first participant; for how long they come
GAPS = (10.0, 15.0)  # seconds between participants, uniform
BURST, WITHIN = 40, 10.0  # participants, seconds
CLOSES, ENDS = 5000.0, 7500.0  # when the study is closed, and when nothing may be left
READS = 2.0  # seconds for a page: who reads for long would wait less
RUNS = 5  # participants in local mode, one after the other
SETTLES = 2.0  # seconds from a warm server's `ready` until a participant comes: its agent has made its imports by then
PATIENCE = 60.0  # seconds for any one thing in local mode


def rows() -> Iterator[Row]:
    """A simulated hour and a simulated crowd, and a few participants for real; about a minute."""
    with quiet():
        yield from each([an_hour, a_burst, what_they_cost])
    yield from each([for_real])


# Simulated


@dataclass(frozen=True)
class Came:
    """How it went for those who came. Times are seconds, of each participant."""

    world: SimulatedWorld
    took_warm_server: float  # the share that was given a warm server
    to_shown: list[float]  # from sending the answer that asks for the server until the page shows it
    at_game: list[float]  # from the first sight of the game page until there is a server
    calls: float  # of AWS, per participant


def simulated(warm: int, arrivals: Sequence[float], closes: float = CLOSES, ends: float = ENDS) -> Came:
    """Participants who come at these seconds to a study with so many warm servers, which is closed afterwards."""
    world = SimulatedWorld(SEED, project=msgspec.structs.replace(PROJECT, warm_servers=warm))
    world.open()
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
    """When participants come who come one after the other."""
    chance, found = random.Random(SEED), [OPENS]
    while found[-1] < OPENS + HOUR:
        found.append(found[-1] + chance.uniform(*GAPS))
    return found


def an_hour() -> Iterator[Row]:
    """The pool keeps up with those who come."""
    arrivals = hour_of_arrivals()
    came, without = simulated(WARM, arrivals), simulated(0, arrivals)
    what = f"{WARM} warm servers, a participant every {GAPS[0]:.0f} to {GAPS[1]:.0f} s for an hour"
    yield from _compared(what, came, without, goal=0.1)
    yield row(
        f"{what}: API calls per participant, against none warm",
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
        f"{what}: left when the study is closed",
        sum(came.world.left().values()),
        "things",
        bound="no server outlives its study",
        at_most=0,
        detail=dict(came.world.left()),
    )


def a_burst() -> Iterator[Row]:
    """More come at once than servers wait."""
    chance = random.Random(SEED)
    arrivals = [OPENS + chance.uniform(0, WITHIN) for _ in range(BURST)]
    came, without = simulated(WARM, arrivals), simulated(0, arrivals)
    yield from _compared(f"{WARM} warm servers, {BURST} participants within {WITHIN:.0f} s", came, without)


def _compared(what: str, came: Came, without: Came, goal: float | None = None) -> Iterator[Row]:
    took = f"{100 * came.took_warm_server:.0f} % were given a warm server"
    for kind, mine, theirs in (
        ("asked for a server until the page shows it", came.to_shown, without.to_shown),
        ("wait at the game page", came.at_game, without.at_game),
    ):
        yield row(
            f"{what}: {kind}, p50, against none warm",
            quantile(mine, 0.5),
            "s",
            yardstick=quantile(theirs, 0.5),
            at_most=goal,
            detail={
                "p50, p95, max": [quantile(mine, 0.5), quantile(mine, 0.95), max(mine)],
                "none warm: p50, p95, max": [quantile(theirs, 0.5), quantile(theirs, 0.95), max(theirs)],
                "who": took,
                "they": f"read a page for {0.5 * READS:g} to {1.5 * READS:g} s",
                **({f"assumed: {of}": text for of, text in assumed(came.world.conditions).items()} if goal else {}),
            },
        )


def _waited(world: SimulatedWorld) -> float:
    """Seconds that servers waited for a participant, in all."""
    records = [
        json.loads(body) for key, (body, _, _) in world.platform.documents.kept.items() if _is_warm_server(key, body)
    ]
    return sum(seconds_of(record["closed"]) - seconds_of(record["requested"]) for record in records)


def _is_warm_server(key: str, body: bytes) -> bool:
    return key.startswith("_servers/") and ids.is_warm_id(json.loads(body).get("userId"))


def what_they_cost() -> Iterator[Row]:
    """What is paid for readiness."""
    prices = Prices()
    warm = estimate.warm(PROJECT.id, WARM, PROJECT.size.cpu, PROJECT.size.memory, prices)
    yield row(
        f"{WARM} warm servers of {warm.cpu:g} vCPU and {warm.memory:g} GB, an hour of waiting on Spot",
        warm.spot.likely,
        "$",
        yardstick=warm.on_demand.likely,
        detail={"Spot from, to": [warm.spot.low, warm.spot.high], "prices": prices.note(prices.region)},
    )


# For real


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
    """A page, the example's game with its agent, and the end."""
    (folder / "steps").mkdir(parents=True)
    (folder / "config.yml").write_text(CONFIG.format(warm=warm))
    shutil.copy(ROOT / "agent.py", folder)
    (folder / "steps" / "hello.html").write_text("<h1>hello</h1><input name=word><button>Go on</button>")
    (folder / "steps" / "end.html").write_text("<h1>end</h1>")


def in_local_mode(warm: int, participants: int) -> list[float]:
    """Seconds from the form that asks for a server to the first picture, of participants one after the other."""
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
    """Until so many servers wait."""
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
            async for said in ws:  # until the trial is over, so that it does not stand in the next one's way
                if isinstance(said, str) and json.loads(said).get("done"):
                    break
            return took
    finally:
        line.close()


def for_real() -> Iterator[Row]:
    """`python -m local` with real trial processes."""
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
            "participants": f"{RUNS}, one after the other; the next comes {SETTLES:g} s after a server waits again",
            "the page": "polls every 50 ms; a browser's looks every two seconds come on top of both",
        },
    )
