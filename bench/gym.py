"""Measures the speed and the costs of the server of environments: `python -m bench.gym`.

One client drives all servers: a loop over sockets that sends the next request of a connection as soon as the answer to
the last one has come. The servers run on one core, and the client on others. A server's processor time is that of all
its processes, from the scheduler (/proc/PID/schedstat, in nanoseconds). The yardsticks are a bare echo by `websockets`
of messages of the same length, and `env.step` alone in a process without a server, both in the same run on the same
core.

Gymie 0.5.4 needs gym 0.17.3 and eventlet 0.28, which have no wheels for a present Python. Its figures were measured on
another machine, so rows only mention them.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from websockets.client import ClientProtocol
from websockets.frames import Frame, Opcode
from websockets.http11 import Response
from websockets.typing import Subprotocol
from websockets.uri import parse_uri

from bench.table import Row, each, row
from testing.gym_server import gym_server

ROOT = Path(__file__).resolve().parent.parent
REQUESTS = 2000  # requests of one measurement, of all clients together
ROUNDS = 15  # repetitions of each measurement, ours and the yardsticks' in turn; the quickest of each counts
MANY = 64  # steps in one request
IDLE = 500  # connections that send no request
THEIRS = {1: (4371, 136), 8: (11067, 88)}  # clients: Gymie 0.5.4's steps/s, and µs of server CPU per step
CORES = sorted(os.sched_getaffinity(0))  # all cores, before `pinned` restricts this process
_SEED = 3

# The client


class FrameConnection:
    """A WebSocket that sends ready-made frames, so that the client itself takes little time."""

    def __init__(self, url: str, subprotocol: str | None = None) -> None:
        uri = parse_uri(url)
        self.socket = socket.create_connection((uri.host, uri.port))
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        protocol = ClientProtocol(uri, subprotocols=[Subprotocol(subprotocol)] if subprotocol else None)
        protocol.send_request(protocol.connect())
        self.socket.sendall(b"".join(protocol.data_to_send()))
        protocol.receive_data(self.socket.recv(65536))
        (answer,) = protocol.events_received()
        assert isinstance(answer, Response)
        assert answer.status_code == 101, answer

    def ask(self, frame: bytes) -> bytes:
        """Send a frame; return the payload of the answer."""
        self.socket.sendall(frame)
        return self.receive()

    def receive(self) -> bytes:
        """Return the payload of the next message, which must be one frame."""
        data = self.socket.recv(262144)
        while True:
            start, length = 2, data[1]
            if length >= 126:
                start = 4 if length == 126 else 10
                length = int.from_bytes(data[2:start], "big")
            if len(data) >= start + length:
                return data[start:]
            data += self.socket.recv(262144)


def frame(message: str | bytes) -> bytes:
    """Return a client's frame with this message."""
    data = message.encode() if isinstance(message, str) else message
    return Frame(Opcode.TEXT if isinstance(message, str) else Opcode.BINARY, data).serialize(mask=True)


@dataclass(frozen=True, slots=True)
class GymRun:
    """The figures of one measurement: µs of server CPU per request, requests per second, each answer's time in µs."""

    cpu: float
    rate: float
    waits: Sequence[float]

    def wait(self, percentile: int) -> float:
        """Return this percentile of the waits, in µs."""
        return statistics.quantiles(self.waits, n=100)[percentile - 1]


Next = Callable[[bytes], bytes]
"""A function that makes a connection's next request from the answer to the last one."""


def drive(pid: int, clients: Sequence[tuple[FrameConnection, Next]], requests: int) -> GymRun:
    """Let each client send a request after each answer, `requests` in all. `pid` is the server's process."""
    selector = selectors.DefaultSelector()
    sent, waits = {}, []
    begun, used = time.perf_counter(), cpu(pid)
    for connection, following in clients:
        selector.register(connection.socket, selectors.EVENT_READ, (connection, following))
        sent[connection] = time.perf_counter()
        connection.socket.sendall(following(b""))
    left, waiting = requests - len(clients), len(clients)
    while waiting:
        for key, _ in selector.select():
            connection, following = key.data
            answer = connection.receive()
            now = time.perf_counter()
            waits.append(1e6 * (now - sent[connection]))
            if left > 0:
                left -= 1
                sent[connection] = now
                connection.socket.sendall(following(answer))
            else:
                waiting -= 1
    took = time.perf_counter() - begun
    return GymRun(1e6 * (cpu(pid) - used) / len(waits), len(waits) / took, waits)


def cpu(pid: int) -> float:
    """Return the seconds of processor time of a process and of its descendants that run now."""
    parent = psutil.Process(pid)
    processes = [parent.pid, *(child.pid for child in parent.children(recursive=True))]
    return sum(int(Path(f"/proc/{one}/schedstat").read_text().split()[0]) for one in processes) / 1e9


# The servers


@contextlib.contextmanager
def pinned() -> Iterator[None]:
    """Let processes that are started within the block run on the last core; then let this process run on the others."""
    os.sched_setaffinity(0, CORES[-1:])
    try:
        yield
    finally:
        os.sched_setaffinity(0, CORES[:-1] or CORES)


@contextlib.contextmanager
def echo(reply: str, binary: int = 0) -> Iterator[tuple[str, int]]:
    """Run the yardstick's server within the block; give its address and process id."""
    with pinned():
        process = subprocess.Popen(
            [sys.executable, "-m", "bench.echo", reply, str(binary)],
            cwd=ROOT,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
    try:
        assert process.stdout is not None
        yield f"ws://127.0.0.1:{int(process.stdout.readline())}/gym", process.pid
        process.stdout.close()
    finally:
        process.kill()
        process.wait()


@contextlib.contextmanager
def ours() -> Iterator[tuple[str, int]]:
    """Run our server within the block; give its address and process id."""
    with contextlib.ExitStack() as stack:
        with pinned():
            found = stack.enter_context(gym_server())
        yield found.url, found.pid


_ALONE = """
import sys, time, gymnasium
env = gymnasium.make("CartPole-v1")
env.reset(seed=int(sys.argv[1]))
env.action_space.seed(0)
actions = [env.action_space.sample() for _ in range(20_000)]
ended = False
begun = time.process_time()
for action in actions:
    if ended:
        env.reset()
        ended = False
    else:
        _, _, terminated, truncated, _ = env.step(action)
        ended = terminated or truncated
print(1e6 * (time.process_time() - begun) / len(actions))
"""


def alone() -> float:
    """Measure the µs of processor time of `env.step` without a server, with resets as in a request of `step_many`."""
    with pinned():
        done = subprocess.run(
            [sys.executable, "-c", _ALONE, str(_SEED)], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, check=True
        )
    return float(done.stdout)


# One request for a step


def cartpole(url: str) -> tuple[FrameConnection, Next]:
    """Make a client like Gymie's. It steps an environment of its own, and resets it after each episode."""
    connection = FrameConnection(url)
    instance = connection.ask(frame('{"method":"make","params":{"env_id":"CartPole-v1"}}')).decode()
    reset = frame(json.dumps({"method": "reset", "params": {"instance_id": instance}}, separators=(",", ":")))
    steps = [
        frame(json.dumps({"method": "step", "params": {"action": at, "instance_id": instance}}, separators=(",", ":")))
        for at in (0, 1)
    ]
    connection.ask(reset)
    taken = 0

    def following(answer: bytes) -> bytes:
        nonlocal taken
        taken += 1
        return reset if b",true,{" in answer else steps[taken & 1]

    return connection, following


REPLY = "[[0.027395604178309441,-0.0061121615581214428,0.035859793424606323,0.019736802205443382],1.0,false,{}]"
"""A text as long as the answer to a step."""


def echoed(url: str) -> tuple[FrameConnection, Next]:
    """Make a client that sends requests as long as those of a step."""
    request = {"method": "step", "params": {"action": 1, "instance_id": "0" * 32}}
    step = frame(json.dumps(request, separators=(",", ":")))
    return FrameConnection(url), lambda _: step


def single_steps() -> Iterator[Row]:
    """Measure one request for each step, in Gymie's JSON, from one client and from eight."""
    for count in THEIRS:
        with ours() as (url, pid), echo(REPLY) as (bare_url, bare_pid):
            clients, bare_clients = (
                [make(to) for _ in range(count)] for make, to in ((cartpole, url), (echoed, bare_url))
            )
            found, bare, step = [], [], []
            for _ in range(ROUNDS):
                found.append(drive(pid, clients, REQUESTS))
                bare.append(drive(bare_pid, bare_clients, REQUESTS))
                step.append(alone())
        yield from _single(count, found, bare, min(step))


def _single(count: int, found: Sequence[GymRun], bare: Sequence[GymRun], step: float) -> Iterator[Row]:
    ours_, echo_ = min(found, key=lambda run: run.cpu), min(bare, key=lambda run: run.cpu)
    who = "one client" if count == 1 else f"{count} clients"
    rate, used = THEIRS[count]
    yield row(
        f"server CPU per step, {who}, Gymie's JSON, against echo + env.step",
        ours_.cpu,
        "µs",
        yardstick=echo_.cpu + step,
        at_most=1.3,
        detail={
            "bare echo": f"{echo_.cpu:.1f} µs",
            "env.step alone": f"{step:.1f} µs",
            "Gymie 0.5.4, measured elsewhere": f"{rate:,} steps/s, {used} µs of server CPU per step",
        },
    )
    quickest, echo_ = max(found, key=lambda run: run.rate), max(bare, key=lambda run: run.rate)
    yield row(f"steps/s, {who}, Gymie's JSON, against echoes/s", quickest.rate, "a second", yardstick=echo_.rate)
    for percentile in (50, 99):
        yield row(
            f"answer to a step, {who}, p{percentile}, against an echo",
            quickest.wait(percentile),
            "µs",
            yardstick=echo_.wait(percentile),
        )


# One request for many steps


def batched_steps() -> Iterator[Row]:
    """Measure 64 steps in a request, by the binary subprotocol."""
    from trial.gym import arrays, spaces
    from trial.gym.forms import SUBPROTOCOL

    with ours() as (url, pid):
        connection = FrameConnection(url, SUBPROTOCOL)
        made = json.loads(connection.ask(frame('{"method":"make","params":{"env_id":"CartPole-v1"}}')))
        actions = arrays.layout(spaces.build(made["action_space"]), action=True)
        connection.ask(frame(arrays.reset_request(made["handle"], _SEED, None)))
        batch = arrays.batch_of(actions, [at * at % 3 % 2 for at in range(MANY)])
        request = frame(arrays.step_request(arrays.STEP_MANY, made["handle"], MANY, actions, batch))
        found, step = [], []
        for turn in range(3 * ROUNDS):  # many short measurements, since some of them may find the machine quiet
            found.append(drive(pid, [(connection, lambda _: request)], REQUESTS // 20))
            if turn % 3 == 0:
                step.append(alone())
    yield from _batched(found, min(step))


def _batched(found: Sequence[GymRun], step: float) -> Iterator[Row]:
    yield row(
        f"server CPU per step, {MANY} in a request, raw arrays, against env.step alone",
        min(run.cpu for run in found) / MANY,
        "µs",
        yardstick=step,
        at_most=1.5,
    )
    quickest = max(found, key=lambda run: run.rate)
    yield row(f"steps/s, {MANY} in a request, raw arrays", quickest.rate * MANY, "a second")


# Idle connections


def idle() -> Iterator[Row]:
    """Measure the memory of a connection before its first request, and that of one with an environment."""
    with ours() as (url, pid), echo(REPLY) as (bare_url, bare_pid):
        found = [_grown(pid_, url_) for pid_, url_ in ((pid, url), (bare_pid, bare_url))]
        with_environment = _grown(pid, url, 8, lambda connection: connection.ask(_MAKE))
    yield row(
        f"memory per connection, {IDLE} that have asked for nothing, against echo", found[0], "KB", yardstick=found[1]
    )
    yield row("memory per connection with a CartPole, in a process of its own", with_environment / 1024, "MB")


_MAKE = frame('{"method":"make","params":{"env_id":"CartPole-v1"}}')


def _grown(pid: int, url: str, count: int = IDLE, then: Callable[[FrameConnection], Any] = lambda _: None) -> float:
    """Return the KB by which a server grows with each of `count` connections. `then` is called with each of them."""
    opened = [FrameConnection(url)]  # the memory of what the first one loads is not counted
    then(opened[0])
    before = memory(pid)
    opened += [FrameConnection(url) for _ in range(count)]
    for connection in opened[1:]:
        then(connection)
    time.sleep(0.2)
    grown = (memory(pid) - before) / count / 1024
    for connection in opened:
        connection.socket.close()
    return grown


def memory(pid: int) -> int:
    """Return the bytes of a process and its descendants; pages that they share count once.

    Pages of files are left out (`Pss_Anon`, proc_pid_smaps(5)): how much of a library's pages counts for a process
    changes whenever another process on the machine loads the library or ends.
    """
    parent = psutil.Process(pid)
    return sum(_anonymous(one.pid) for one in (parent, *parent.children(recursive=True)))


def _anonymous(pid: int) -> int:
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("Pss_Anon:"))


def rows() -> Iterator[Row]:
    """Measure everything, one row after another; about a minute."""
    before = os.sched_getaffinity(0)
    try:
        yield from each((single_steps, batched_steps, idle))
    finally:
        os.sched_setaffinity(0, before)


if __name__ == "__main__":
    for found in rows():
        print(json.dumps(found, ensure_ascii=False), flush=True)
