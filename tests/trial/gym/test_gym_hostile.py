"""Bad input, and environments that behave badly: the request gets a sentence, the others go on, nothing stays behind."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from websockets.exceptions import ConnectionClosed, InvalidMessage, InvalidStatus
from websockets.sync.client import connect

from testing.gym_server import GymServerProcess, TextClient, gym_server
from testing.waiting import until
from trial.gym.limits import Limits
from trial.gym.worker import WorkerState

WITHIN = 15.0


@pytest.fixture(autouse=True)
def nothing_stays_behind(server: GymServerProcess) -> Iterator[None]:
    """After each test, with all connections closed, only the server and its spawner run, and it serves other clients."""
    yield
    until(lambda: len(descendants(server)) == 1, WITHIN)
    with TextClient(server.url) as other:
        assert len(other.ask("reset", instance_id=other.make("Odd/Calm-v0"))) == 2


def patient_server() -> contextlib.AbstractContextManager[GymServerProcess]:
    """Return a server of its own, which gives environments ten minutes for each call."""
    odd = ("--import", "odd_environments", "--seconds", "600")
    return gym_server(*odd, cwd=Path(__file__).parent)


def descendants(server: GymServerProcess) -> list[psutil.Process]:
    """Return the processes below the server's."""
    return psutil.Process(server.pid).children(recursive=True)


def first_step(client: TextClient, env_id: str, **action: Any) -> Any:
    """Make an environment, reset it and take a step; return the answer to the step."""
    made = client.make(env_id)
    client.ask("reset", instance_id=made)
    return client.ask("step", instance_id=made, **(action or {"action": 1}))


def kind_and_sentence(said: Any) -> tuple[str, str]:
    """Return the kind and the sentence of an error."""
    return said["error"]["type"], said["error"]["message"]


def still_serves(client: TextClient) -> bool:
    return len(first_step(client, "Odd/Calm-v0")) == 5


# Messages


@pytest.mark.parametrize(
    ("message", "kind"),
    [
        ("", "InvalidMessage"),
        ("[]", "InvalidMessage"),
        ("[" * 100_000, "InvalidMessage"),
        ("7", "InvalidMessage"),
        ('{"method": "make"}', "InvalidMessage"),
        ('{"method": "make", "params": {"env_id": "CartPole-v1", "__class__": 1}}', "EnvironmentMalformed"),
        ('{"method": "end", "params": {}}', "MethodNotFound"),
        ('{"method": "__init__", "params": {}}', "MethodNotFound"),
        ('{"method": {}, "params": {}}', "MethodNotFound"),
        ('{"method": "step", "params": []}', "WrongParameters"),
        ('{"method": "step", "params": {"instance_id": {}, "action": 1}}', "InstanceNotFound"),
        ('{"method": "make", "params": {"env_id": 7}}', "WrongParameters"),
        ('{"method": "make", "params": {"env_id": "CartPole-v1", "seed": -1}}', "WrongParameters"),
        ('{"method": "make", "params": {"env_id": "CartPole-v1", "seed": "x"}}', "WrongParameters"),
        ('{"method": "make", "params": {"env_id": "CartPole-v1", "num_envs": 1e9}}', "WrongParameters"),
        ('{"method": "make", "params": {"env_id": "CartPole-v1", "num_envs": 9}}', "LimitReached"),
        ('{"method": "make", "params": {"env_id": ""}}', "EnvironmentMalformed"),
        ('{"method": "make", "params": {"env_id": "Nothing-v0"}}', "EnvironmentNotFound"),
        ('{"method": "make", "params": {"env_id": "antigravity:Nothing-v0"}}', "EnvironmentMalformed"),
        (b"\x00" * 8, "InvalidMessage"),
    ],
)
def test_a_wrong_request_gets_a_sentence(asking: TextClient, message: str | bytes, kind: str) -> None:
    found, sentence = kind_and_sentence(json.loads(asking.say(message)))
    assert found == kind
    assert 10 < len(sentence) <= 300
    assert still_serves(asking)


@pytest.mark.parametrize(
    ("params", "reason"),
    [
        ('{"instance_id": "x"}', "missing 1 required positional argument: 'action'"),
        ('{"instance_id": "x", "action": 1, "actions": [1]}', "got an unexpected keyword argument 'actions'"),
        ("[]", "they must be an object"),
    ],
)
def test_parameters_that_a_method_does_not_take_are_named(asking: TextClient, params: str, reason: str) -> None:
    kind, sentence = kind_and_sentence(json.loads(asking.say(f'{{"method": "step", "params": {params}}}')))
    assert kind == "WrongParameters"
    assert f"are wrong: {reason}" in sentence  # newer Pythons ask whether a similar name was meant


@pytest.mark.parametrize(
    ("env_id", "action"),
    [
        ("Odd/Calm-v0", 3),
        ("Odd/Calm-v0", "1"),
        ("Odd/Calm-v0", None),
        ("Odd/Calm-v0", 10**30),
        ("Odd/Continuous-v0", [float("nan"), 0]),
        ("Odd/Continuous-v0", [float("inf"), 0]),
        ("Odd/Continuous-v0", [0.0]),
        ("Odd/Continuous-v0", [[0.0], [1.0, 2.0]]),
    ],
)
def test_a_wrong_action_gets_a_sentence(asking: TextClient, env_id: str, action: Any) -> None:
    kind, sentence = kind_and_sentence(first_step(asking, env_id, action=action))
    assert kind == "WrongAction"
    assert sentence.startswith("Action `")
    assert still_serves(asking)


def test_a_step_before_reset_gets_gymnasiums_sentence(asking: TextClient) -> None:
    made = asking.make("CartPole-v1")
    assert "reset" in kind_and_sentence(asking.ask("step", instance_id=made, action=0))[1]


def test_10_mb_in_a_message_close_the_connection(asking: TextClient) -> None:
    with pytest.raises(ConnectionClosed) as found:
        asking.say("x" * 10_000_000)
    assert found.value.rcvd is not None
    assert (found.value.rcvd.code, "exceeds limit" in found.value.rcvd.reason) == (1009, True)


def test_too_many_steps_for_one_reply_get_a_sentence(asking: TextClient) -> None:
    made = asking.make("Odd/Calm-v0")
    kind, _ = kind_and_sentence(asking.ask("step_many", instance_id=made, actions=[0] * 70_000))
    assert kind == "LimitReached"


def test_a_client_cannot_use_another_clients_environment(server: GymServerProcess, asking: TextClient) -> None:
    made = asking.make("Odd/Calm-v0")
    with TextClient(server.url + "?form=gymnasium") as other:
        for method in ("reset", "close", "observation_space", "render"):
            assert kind_and_sentence(other.ask(method, instance_id=made))[0] == "InstanceNotFound"
    assert len(asking.ask("reset", instance_id=made)) == 2


def test_a_thousand_requests_make_only_as_many_environments_as_allowed(asking: TextClient) -> None:
    for _ in range(1000):
        asking.websocket.send('{"method": "make", "params": {"env_id": "Odd/Calm-v0"}}')
    said = [json.loads(asking.websocket.recv(20)) for _ in range(1000)]
    assert sum("instance_id" in one for one in said) == 8
    assert {kind_and_sentence(one) for one in said if "error" in one} == {
        ("LimitReached", "A connection may have 8 environments; it has 8. Close some.")
    }


def test_a_closed_environment_makes_room(asking: TextClient) -> None:
    for _ in range(20):
        assert asking.ask("close", instance_id=asking.make("Odd/Calm-v0")) is True


# Environments


@pytest.mark.parametrize(
    ("env_id", "words"),
    [
        ("Odd/Raising-v0", "RuntimeError: no such luck"),
        ("Odd/Leaving-v0", "SystemExit: that was all"),
        ("Odd/Looping-v0", "longer than 1 s"),
        ("Odd/Greedy-v0", "MemoryError"),
    ],
)
def test_the_connection_stays_when_an_environment_fails(asking: TextClient, env_id: str, words: str) -> None:
    assert words in kind_and_sentence(first_step(asking, env_id))[1]
    assert still_serves(asking)


@pytest.mark.parametrize(
    ("env_id", "words"),
    [
        ("Odd/Dying-v0", "The environment ended its process (exit status 3)."),
        ("Odd/Crashing-v0", "The environment ended its process (signal SIGSEGV)."),
        ("Odd/Hanging-v0", "The environment took longer than 1 s; its process was ended."),
    ],
)
def test_the_close_says_how_an_environments_process_ended(asking: TextClient, env_id: str, words: str) -> None:
    with pytest.raises(ConnectionClosed) as found:
        first_step(asking, env_id)
    assert found.value.rcvd is not None
    assert (found.value.rcvd.code, found.value.rcvd.reason) == (1011, words)


def closed_within(client: TextClient) -> str:
    """Return the reason with which the server closes the connection."""
    with pytest.raises(ConnectionClosed) as found:
        client.websocket.recv(WITHIN)
    assert found.value.rcvd is not None
    return found.value.rcvd.reason


def step_until_closed(client: TextClient, env_id: str) -> str:
    """Take a step, and return the reason with which the server closes: after the answer; on a busy machine, before it."""
    with contextlib.suppress(ConnectionClosed):
        first_step(client, env_id)
    return closed_within(client)


def test_too_many_processes_of_an_environment_are_ended(asking: TextClient) -> None:
    reason = step_until_closed(asking, "Odd/Multiplying-v0")
    assert reason == "The environments started more than 4 processes; all were ended."


def test_processes_that_use_too_much_memory_together_are_ended(asking: TextClient) -> None:
    reason = step_until_closed(asking, "Odd/GreedyTogether-v0")
    assert reason == "The environments used more than 300 MB; their process was ended."


@pytest.mark.parametrize("env_id", ["Odd/GreedyShared-v0", "Odd/GreedyBesideSmall-v0"])
def test_memory_that_processes_may_share_counts_too(asking: TextClient, env_id: str) -> None:
    made = asking.make(env_id)
    asking.ask("reset", instance_id=made)
    with contextlib.suppress(ConnectionClosed):
        for _ in range(18):
            asking.ask("step", instance_id=made, action=1)
    reason = closed_within(asking)
    assert reason == "The environments used more than 300 MB; their process was ended."


def test_a_process_that_an_environment_left_ends_with_the_connection(
    server: GymServerProcess, asking: TextClient
) -> None:
    until(lambda: len(descendants(server)) == 1, WITHIN)  # what an earlier test has left is on its way out
    first_step(asking, "Odd/Forking-v0")
    assert len(descendants(server)) == 3  # spawner, worker, and what was left; the fixture sees it gone


def test_what_an_environment_prints_disturbs_no_answer(asking: TextClient) -> None:
    assert first_step(asking, "Odd/Printing-v0")[0] == [1.0, 0.5]


@pytest.mark.parametrize("env_id", ["Odd/Looping-v0", "Odd/Hanging-v0", "Odd/Calm-v0"])
def test_a_client_that_vanishes_during_a_step_leaves_nothing_behind(server: GymServerProcess, env_id: str) -> None:
    client = TextClient(server.url)
    made = client.make(env_id)
    client.ask("reset", instance_id=made)
    client.websocket.send(json.dumps({"method": "step", "params": {"instance_id": made, "action": 1}}))
    client.websocket.socket.close()


def test_others_play_while_an_environment_hangs() -> None:
    """It hangs for longer than an answer may take: if others waited for it, they would get no answer."""
    with patient_server() as own, TextClient(own.url + "?form=gymnasium") as other:
        stuck = TextClient(own.url)
        made = stuck.make("Odd/Looping-v0")
        stuck.ask("reset", instance_id=made)
        stuck.websocket.send(json.dumps({"method": "step", "params": {"instance_id": made, "action": 1}}))
        assert still_serves(other)
        stuck.websocket.socket.close()


def test_a_client_that_reads_no_answer_keeps_no_other_from_playing(
    server: GymServerProcess, asking: TextClient
) -> None:
    deaf = TextClient(server.url + "?form=gymnasium")
    made = deaf.make("Odd/Calm-v0")
    ask = json.dumps({"method": "step_many", "params": {"instance_id": made, "actions": [0] * 10_000}})
    deaf.ask("reset", instance_id=made)
    for _ in range(20):
        deaf.websocket.send(ask)
    assert still_serves(asking)
    deaf.websocket.socket.close()


# The server


def test_pages_of_other_sites_may_not_connect(server: GymServerProcess) -> None:
    with pytest.raises(InvalidStatus) as found, connect(server.url, origin="https://example.org"):
        pass
    assert found.value.response.status_code == 403


def test_pages_of_this_machine_may_connect(server: GymServerProcess) -> None:
    with connect(server.url, origin="http://localhost:3000"):
        pass


def test_only_the_path_of_environments_is_served(server: GymServerProcess) -> None:
    with pytest.raises(InvalidStatus) as found, connect(server.url.replace("/gym", "/other")):
        pass
    assert found.value.response.status_code == 404


def test_an_idle_connection_answers_pings_and_has_no_process(server: GymServerProcess) -> None:
    until(lambda: len(descendants(server)) == 1, WITHIN)  # what an earlier test has left is on its way out
    with connect(server.url) as websocket:
        for _ in range(3):
            assert websocket.ping().wait(WITHIN)
        assert len(descendants(server)) == 1


def test_a_connection_that_is_no_http_is_dropped(server: GymServerProcess) -> None:
    for said in (b"\x16\x03\x01\x00\xa5" + bytes(200) + b"\r\n\r\n", b"GET / HTTP/1.1\r\n" + b"a" * 20_000):
        with socket.create_connection(("127.0.0.1", server.port)) as raw:
            raw.settimeout(WITHIN)
            raw.sendall(said)
            try:
                while raw.recv(4096):
                    pass
            except ConnectionResetError:
                pass


@pytest.fixture
def small_server() -> Iterator[GymServerProcess]:
    with gym_server(*("--workers", "2", "--connections", "4", "--steps-per-second", "10")) as found:
        yield found


def test_the_number_of_connections_with_environments_is_limited(small_server: GymServerProcess) -> None:
    with (
        TextClient(small_server.url) as first,
        TextClient(small_server.url) as second,
        TextClient(small_server.url) as third,
    ):
        first.make("CartPole-v1")
        second.make("CartPole-v1")
        with pytest.raises(ConnectionClosed, match="2 connections use environments already"):
            third.make("CartPole-v1")


def test_a_worker_that_has_ended_makes_room_at_once(small_server: GymServerProcess) -> None:
    """Even if its end and the next connection's first request reach the spawner together."""
    with (
        TextClient(small_server.url) as first,
        TextClient(small_server.url) as second,
        TextClient(small_server.url) as third,
    ):
        first.make("CartPole-v1")
        second.make("CartPole-v1")
        spawner, ending, _ = descendants(small_server)
        spawner.suspend()
        ending.kill()
        third.websocket.send(json.dumps({"method": "make", "params": {"env_id": "CartPole-v1"}}))
        until(lambda: ending.status() == psutil.STATUS_ZOMBIE, WITHIN)
        time.sleep(0.2)  # until the server has passed the request on, which nothing shows
        spawner.resume()
        assert "error" not in third.websocket.recv(WITHIN)


def test_the_number_of_connections_is_limited(small_server: GymServerProcess) -> None:
    with (
        TextClient(small_server.url),
        TextClient(small_server.url),
        TextClient(small_server.url),
        TextClient(small_server.url),
    ):
        with pytest.raises(InvalidStatus) as found, connect(small_server.url):
            pass
        assert found.value.response.body == b"There are 4 connections already.\n"


def test_the_number_of_steps_a_second_is_limited(small_server: GymServerProcess) -> None:
    with TextClient(small_server.url + "?form=gymnasium") as client:
        made = client.make("CartPole-v1")
        client.ask("reset", instance_id=made)
        kind, sentence = kind_and_sentence(client.ask("step_many", instance_id=made, actions=[0] * 11))
        assert (kind, sentence) == ("LimitReached", "More than 10 steps a second; send them more slowly.")
        assert len(client.ask("step", instance_id=made, action=0)) == 5


def test_a_connection_without_requests_is_closed() -> None:
    with gym_server("--idle-seconds", "1") as own, TextClient(own.url) as client:
        client.make("CartPole-v1")
        assert closed_within(client) == "There was no request for 1 s."


def test_a_connection_whose_first_request_does_not_come_is_closed() -> None:
    """Otherwise silent connections would keep everybody out."""
    with gym_server("--idle-seconds", "1", "--connections", "1") as own, TextClient(own.url) as client:
        assert closed_within(client) == "There was no request for 1 s."
        with TextClient(own.url) as other:
            other.make("CartPole-v1")


@pytest.mark.parametrize(("idle", "first"), [(3600.0, 60.0), (0.0, 60.0), (5.0, 5.0)])
def test_a_client_that_begins_its_first_request_has_no_longer_to_send_it_than_a_silent_one(
    idle: float, first: float
) -> None:
    """Otherwise two bytes on each connection would keep everybody out for an hour."""
    state = WorkerState([0.0], 0)
    assert state.silent
    state.work()
    assert not state.silent
    state.rest()
    assert not state.silent
    assert Limits(idle_seconds=idle).silent_seconds == first


def have_ended(pids: list[int]) -> bool:
    return not any(Path(f"/proc/{pid}").exists() for pid in pids)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_process_of_an_ended_server_stays(how: signal.Signals) -> None:
    with gym_server() as own, TextClient(own.url) as client:
        client.make("CartPole-v1")
        pids = [one.pid for one in descendants(own)]
        assert len(pids) == 2
        os.kill(own.pid, how)
        if how is not signal.SIGKILL:
            assert closed_within(client) == "The server ends."
        until(lambda: have_ended(pids), WITHIN)


def test_workers_end_with_their_spawner(server: GymServerProcess) -> None:
    with gym_server() as own, TextClient(own.url) as client:
        client.make("CartPole-v1")
        spawner, worker = (one.pid for one in descendants(own))
        os.kill(spawner, signal.SIGKILL)
        until(lambda: have_ended([worker]), WITHIN)


def test_a_worker_that_hangs_ends_with_its_spawner() -> None:
    """It no longer reads its socket, so only the system can end it."""
    with patient_server() as own, TextClient(own.url) as client:
        made = client.make("Odd/Hanging-v0")
        client.ask("reset", instance_id=made)
        client.websocket.send(json.dumps({"method": "step", "params": {"instance_id": made, "action": 1}}))
        spawner, worker = (one.pid for one in descendants(own))
        time.sleep(0.3)
        os.kill(spawner, signal.SIGKILL)
        until(lambda: have_ended([worker]), WITHIN)


def test_the_number_of_silent_connections_is_limited_too() -> None:
    with gym_server("--connections", "3") as own:
        silent = [socket.create_connection(("127.0.0.1", own.port)) for _ in range(103)]
        with socket.create_connection(("127.0.0.1", own.port)) as one_more:
            one_more.settimeout(WITHIN)
            assert one_more.recv(1) == b""
        for one in silent:
            one.close()
        until(lambda: serves(own), WITHIN)


def serves(server: GymServerProcess) -> bool:
    try:
        with TextClient(server.url) as client:
            return len(client.make("CartPole-v1")) == 32
    # The error depends on when the server refused.
    except (InvalidStatus, OSError, EOFError, InvalidMessage, ConnectionClosed):
        return False


def test_a_server_takes_more_connections_than_the_shells_limit_of_files() -> None:
    limited = ("-c", "import resource as r, runpy, sys; r.setrlimit(r.RLIMIT_NOFILE, (64, r.getrlimit(7)[1])); "
               "sys.argv[1:] = ['--port', '0']; runpy.run_module('trial.gym', run_name='__main__')")  # fmt: skip
    with gym_server(program=limited) as own:
        opened = [TextClient(own.url) for _ in range(100)]
        assert len(opened[-1].make("CartPole-v1")) == 32
        for one in opened:
            one.close()


def test_hundreds_of_first_requests_at_once_are_all_answered() -> None:
    """More requests than the pipe between server and spawner can hold, in both directions."""
    made = json.dumps({"method": "make", "params": {"env_id": "CartPole-v1"}})
    with gym_server("--workers", "2") as own, contextlib.ExitStack() as stack:
        clients = [TextClient(own.url) for _ in range(700)]
        for client in clients:
            stack.callback(client.websocket.socket.close)
        for client in clients:
            client.websocket.send(made)
        answered = [_first_answer(client) for client in clients]
        assert set(answered) == {1013, "made"}
        assert answered.count("made") == 2


def _first_answer(client: TextClient) -> int | str:
    try:
        return "made" if len(client.websocket.recv(WITHIN)) == 32 else "another"
    except ConnectionClosed as error:
        assert error.rcvd is not None
        return error.rcvd.code
