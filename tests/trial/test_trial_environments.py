"""Environments that a participant's server makes for programs that have its token (gym: environments)."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import os
import signal
import statistics
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.server import serve
from websockets.client import ClientProtocol
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode
from websockets.sync.client import connect
from websockets.uri import parse_uri

from testing.gym_server import SECONDS, TextClient
from testing.waiting import until, until_async
from tests.trial.conftest import grid_agent
from tests.trial.test_trial_tls import KEYS, put
from trial.gym import ConnectionLost, RemoteEnv, RemoteError, RemoteVectorEnv, linux
from trial.programs import environments
from trial.programs.environments import MAX_PROGRAMS, MAX_REQUEST, REQUESTS_A_SECOND

TOKEN = "the-secret-token"
SERVES = {"gym": "environments", "startingFrameRate": 30}
REGISTERS = """
import os, time

class Odd(gymnasium.Env):
    action_space = gymnasium.spaces.Discrete(4)
    observation_space = gymnasium.spaces.Box(0, 255, (2,), np.uint8)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        return np.zeros(2, np.uint8), {"environment": dict(os.environ), "nice": os.nice(0), "process": os.getpid()}

    def step(self, action):
        while action == 1:
            pass
        if action == 2:
            os._exit(3)
        return np.zeros(2, np.uint8), 0.0, False, False, {}

gymnasium.register("Odd-v0", Odd)
"""


def agent() -> str:
    """Return an agent.py that registers an environment: action 1 hangs, action 2 ends its process."""
    return grid_agent() + REGISTERS


def url(server: Any, query: str = f"?token={TOKEN}") -> str:
    return f"{server.address}gym{query}"


def processes_of(server: Any) -> list[int]:
    return [pid for pid in linux.descendants(server.process.pid) if linux.runs(pid)]


@contextlib.contextmanager
def remote_env(server: Any, env_id: str = "CartPole-v1", **options: Any) -> Iterator[RemoteEnv]:
    with RemoteEnv(server.address, env_id, token=TOKEN, **options) as env:
        yield env


def test_a_program_with_the_token_trains_on_environments(launch: Any) -> None:
    server = launch(agent(), SERVES)
    assert processes_of(server) == []  # no process before the first program
    with remote_env(server) as env:
        env.reset(seed=1)
        assert env.step(1)[1] == 1.0
        assert len(env.step_many([1, 0, 1])[1]) == 3
    with RemoteVectorEnv(server.address, "CartPole-v1", num_envs=3, token=TOKEN) as envs:
        envs.reset(seed=1)
        assert envs.step([0, 1, 0])[1].tolist() == [1.0, 1.0, 1.0]


def test_a_program_trains_over_tls(launch: Any, tmp_path: Path) -> None:
    put(tmp_path / "store" / "ssl", 1)
    server = launch(agent(), SERVES, **KEYS)
    address, ca = f"wss://localhost:{server.port}/", str(tmp_path / "store/ssl/fullchain.pem")
    with RemoteEnv(address, "CartPole-v1", token=TOKEN, ca=ca) as env:
        env.reset(seed=1)
        assert env.step(1)[1] == 1.0
    with pytest.raises(ConnectionLost, match="401"):
        RemoteEnv(address, "CartPole-v1", ca=ca)


def test_the_forms_of_make_gym_are_served(launch: Any) -> None:
    server = launch(agent(), SERVES)
    with TextClient(url(server)) as gymie:
        made = gymie.say('{"method": "make", "params": {"env_id": "CartPole-v1"}}')
        assert "{" not in made
        gymie.ask("reset", instance_id=made)
        assert len(gymie.ask("step", instance_id=made, action=1)) == 4
    with TextClient(url(server) + "&form=gymnasium") as client:
        made = client.ask("make", env_id="CartPole-v1")["instance_id"]
        client.ask("reset", instance_id=made)
        assert len(client.ask("step", instance_id=made, action=1)) == 5
    with pytest.raises(InvalidStatus) as refused:
        TextClient(url(server) + "&form=other")
    assert refused.value.response.status_code == 400


def test_closes_pass_with_their_codes_and_words(launch: Any) -> None:
    server = launch(agent(), SERVES)
    with TextClient(url(server)) as gymie, pytest.raises(ConnectionClosed) as closed:
        gymie.say("[]")
    assert closed.value.rcvd is not None
    assert closed.value.rcvd.code == 1003
    assert closed.value.rcvd.reason
    with remote_env(server, "Odd-v0") as env:
        env.reset()
        with pytest.raises(ConnectionLost, match=r"ended its process \(exit status 3\)"):
            env.step(2)


def test_a_request_that_is_too_large_ends_its_connection_alone(launch: Any) -> None:
    server = launch(agent(), SERVES)
    with remote_env(server) as env, connect(url(server), compression=None, proxy=None) as large:
        large.send("x" * (MAX_REQUEST + 1))
        with pytest.raises(ConnectionClosed):
            large.recv(SECONDS)
        assert large.close_code == 1009
        env.reset()


def test_a_program_may_send_a_larger_request_than_a_page(launch: Any) -> None:
    server = launch(agent(), SERVES)
    with remote_env(server) as env:
        env.reset(seed=1)
        assert len(env.step_many([1] * 60_000)[1]) == 60_000


@pytest.mark.parametrize("query", ["", "?token=", "?token=other", "?form=gymnasium"])
def test_a_program_without_the_token_makes_no_environments(launch: Any, query: str) -> None:
    server = launch(agent(), SERVES)
    with pytest.raises(InvalidStatus) as refused:
        connect(url(server, query), proxy=None)
    assert refused.value.response.status_code == 401
    assert processes_of(server) == []


@pytest.mark.parametrize(("gym", "words"), [("none", "404"), ("watch", "does not speak"), ("advise", "does not speak")])
def test_a_server_makes_environments_only_if_the_project_says_so(launch: Any, gym: str, words: str) -> None:
    server = launch(agent(), {"gym": gym})
    with pytest.raises(ConnectionLost, match=words), remote_env(server):
        pass
    assert processes_of(server) == []


def test_the_number_of_programs_is_limited(launch: Any) -> None:
    server = launch(agent(), SERVES)
    with contextlib.ExitStack() as stack:
        for _ in range(MAX_PROGRAMS):
            stack.enter_context(remote_env(server))
        with pytest.raises(ConnectionLost, match=f"{MAX_PROGRAMS} programs"), remote_env(server):
            pass
    until(lambda: len(processes_of(server)) == 2, SECONDS)  # who listens and who starts processes
    with remote_env(server) as env:
        env.reset()


def test_requests_above_the_limit_of_a_second_wait(launch: Any) -> None:
    server = launch(agent(), SERVES)
    count = REQUESTS_A_SECOND
    with connect(url(server) + "&form=gymnasium", compression=None, proxy=None) as program:
        program.send('{"method": "nothing", "params": {}}')
        program.recv(SECONDS)
        since = time.monotonic()
        for _ in range(count):
            program.send('{"method": "nothing", "params": {}}')
        for _ in range(count):
            assert "MethodNotFound" in program.recv(SECONDS)
        assert time.monotonic() - since > 0.95


def test_environments_know_no_secret_and_run_at_a_lower_priority_than_the_game(launch: Any) -> None:
    server = launch(agent(), SERVES)
    with remote_env(server, "Odd-v0") as env:
        _, info = env.reset()
        score = Path(f"/proc/{info['process']}/oom_score_adj").read_text()
    assert not {"TOKEN", "CREDENTIAL"} & info["environment"].keys()
    assert not [name for name, value in info["environment"].items() if TOKEN in value]
    assert info["nice"] == 19
    assert score.strip() == "1000"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_nothing_stays_behind_when_the_server_ends(launch: Any, number: signal.Signals) -> None:
    server = launch(agent(), SERVES, LINGER_SECONDS="0")
    with remote_env(server, "Odd-v0") as env:
        env.reset()
        threading.Thread(target=_hang, args=(env,), daemon=True).start()
        until(lambda: len(processes_of(server)) == 3, SECONDS)
        left = processes_of(server)
        os.kill(server.process.pid, number)
        server.wait()
        until(lambda: not any(map(linux.runs, left)), SECONDS)


def _hang(env: RemoteEnv) -> None:
    with contextlib.suppress(RemoteError):
        env.step(1)


def test_a_process_that_was_killed_is_started_again(launch: Any) -> None:
    server = launch(agent(), SERVES)
    with remote_env(server) as env:
        env.reset()
        (listens,) = linux.children(server.process.pid)
        below = processes_of(server)
        os.kill(listens, signal.SIGKILL)
        until(lambda: not any(map(linux.runs, below)), SECONDS)  # an environment may answer until its own process ends
        with pytest.raises(ConnectionLost):
            env.step_many([1] * 10)
    until(lambda: processes_of(server) == [], SECONDS)
    with remote_env(server) as env:
        env.reset()


async def test_a_process_whose_end_is_not_noticed_yet_is_started_again(tmp_path: Path) -> None:
    made = environments.Environments(tmp_path)
    (await made._connection()).close()
    first = made._process
    assert first is not None
    first.kill()
    until(lambda: not linux.runs(first.pid), SECONDS)  # the event loop stands still meanwhile
    assert first.returncode is None
    (await made._connection()).close()
    assert made._process is not None
    assert made._process.pid != first.pid
    await made.close()


async def test_an_environment_that_hangs_delays_no_step_of_the_game(launch: Any, open_client: Any) -> None:
    server = launch(agent(), SERVES)

    def begin() -> RemoteEnv:
        env = RemoteEnv(server.address, "Odd-v0", token=TOKEN)
        env.reset()
        return env

    async def measure_stalls(worst: list[float]) -> None:
        """Measure the longest time for which this machine did not run a task that was due."""
        while True:
            before = time.monotonic()
            await asyncio.sleep(0.02)
            worst[0] = max(worst[0], time.monotonic() - before - 0.02)

    async with open_client(server.address) as client:
        await client.play()
        beginning = asyncio.create_task(asyncio.to_thread(begin))
        while not beginning.done():  # a client that takes no frames gets no more of them
            await client.watch(0.05)
        with beginning.result() as env:
            hanging = threading.Thread(target=_hang, args=(env,), daemon=True)
            hanging.start()
            worst = [0.0]
            watching = asyncio.create_task(measure_stalls(worst))
            since = time.monotonic_ns()
            await client.see(90)
            ended = time.monotonic_ns()
            watching.cancel()
            assert hanging.is_alive()
        server.terminate()
        await client.closed()
    assert server.wait() == 0
    steps = (line["ns"] for lines in server.recordings().values() for line in lines if line["kind"] == "step")
    times = [since, *(ns for ns in steps if since < ns < ended)]  # by the server's clock, which is this machine's
    assert len(times) > 60  # of 90
    gaps = [(later - earlier) / 1e9 for earlier, later in itertools.pairwise(times)]
    assert statistics.median(gaps) < 0.05
    assert max(gaps) < 0.5 + worst[0]


def test_a_program_does_not_keep_the_server_for_a_participant_who_stays_away(launch: Any) -> None:
    server = launch(agent(), SERVES, IDLE_SECONDS="5")

    def train() -> None:
        with remote_env(server) as env:
            env.reset()
            assert server.wait() == 0
            env.step(1)

    with pytest.raises(ConnectionLost, match="going away"):  # wherever the end meets the program
        train()
    assert server.wait() == 0


def framed(request: Any) -> bytes:
    return Frame(Opcode.TEXT, json.dumps(request).encode()).serialize(mask=True)


def test_a_warm_server_without_a_participant_makes_no_environments(launch: Any) -> None:
    server = launch(agent(), SERVES, SPARE="on")
    with connect(url(server), compression=None, proxy=None) as program:
        with pytest.raises(ConnectionClosed):
            program.recv(SECONDS)
        assert program.close_code == 1013
    assert processes_of(server) == []


async def test_a_program_that_does_not_read_its_answers_is_cut_off(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(environments, "_SEND_SECONDS", 0.5)
    made = environments.Environments(tmp_path)
    options: Any = {"compression": None, "write_limit": (1, 0), "ping_interval": None}
    async with serve(made.serve, "127.0.0.1", 0, **options) as server:
        port = server.sockets[0].getsockname()[1]
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        handshake = ClientProtocol(parse_uri(f"ws://127.0.0.1:{port}/gym?form=gymnasium"))
        handshake.send_request(handshake.connect())
        writer.write(b"".join(handshake.data_to_send()))
        await reader.readuntil(b"\r\n\r\n")
        writer.write(framed({"method": "make", "params": {"env_id": "CartPole-v1"}}))
        await reader.readexactly(2)
        instance = json.loads(await reader.readuntil(b"}"))["instance_id"]
        writer.write(framed({"method": "reset", "params": {"instance_id": instance}}))
        for _ in range(10):  # each with an answer of 2 MB
            writer.write(framed({"method": "step_many", "params": {"instance_id": instance, "actions": [1] * 20000}}))
        await until_async(lambda: not made.connections, SECONDS)
        writer.close()
    await made.close()
