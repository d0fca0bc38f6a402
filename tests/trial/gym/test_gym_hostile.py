"""Bad input, and environments that behave badly: the request gets a sentence, the others go on, nothing stays behind."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest
from websockets.exceptions import ConnectionClosed, InvalidHandshake, InvalidStatus
from websockets.sync.client import connect

from hippodrome.trial.gym.server import REFUSING
from testing.gym_server import GymServerProcess, TextClient, gym_server
from testing.waiting import until

WITHIN = 15.0
HERE = Path(__file__).parent


@pytest.fixture(autouse=True)
def nothing_stays_behind(server: GymServerProcess) -> Iterator[None]:
    """After each test, with all connections closed, only the server runs, and it serves other clients."""
    yield
    until(lambda: descendants(server) == [], WITHIN)
    with TextClient(server.url) as other:
        assert len(other.ask("reset", instance_id=other.make("Odd/Calm-v0"))) == 2


def descendants(server: GymServerProcess) -> list[psutil.Process]:
    """Return the processes below the server's."""
    return psutil.Process(server.pid).children(recursive=True)


def first_step(client: TextClient, env_id: str, **action: Any) -> Any:
    """Make an environment, reset it and take a step; return the answer to the step."""
    made = client.make(env_id)
    client.ask("reset", instance_id=made)
    return client.ask("step", instance_id=made, **(action or {"action": 1}))


def begin_step(client: TextClient, env_id: str) -> None:
    """Make an environment, reset it, and ask for a step without waiting for the answer."""
    made = client.make(env_id)
    client.ask("reset", instance_id=made)
    client.websocket.send(json.dumps({"method": "step", "params": {"instance_id": made, "action": 1}}))


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
        ('{"method": "make", "params": {"env_id": "CartPole-v1", "autoreset_mode": 3}}', "WrongParameters"),
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


def test_a_request_in_fragments_is_answered(asking: TextClient) -> None:
    asking.websocket.send(['{"method": ', '"none", ', '"params": {}}'])
    assert kind_and_sentence(json.loads(asking.websocket.recv(WITHIN)))[0] == "MethodNotFound"


def test_a_text_that_is_no_utf_8_closes_the_connection(asking: TextClient) -> None:
    asking.websocket.send(b"\xff", text=True)
    with pytest.raises(ConnectionClosed) as found:
        asking.websocket.recv(WITHIN)
    assert found.value.rcvd is not None
    assert found.value.rcvd.code == 1007


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


# Environments


@pytest.mark.parametrize(
    ("env_id", "words"),
    [
        ("Odd/Raising-v0", "RuntimeError: no such luck"),
        ("Odd/Leaving-v0", "SystemExit: that was all"),
        ("Odd/Greedy-v0", "MemoryError"),
    ],
)
def test_the_connection_stays_when_an_environment_fails(asking: TextClient, env_id: str, words: str) -> None:
    assert words in kind_and_sentence(first_step(asking, env_id))[1]
    assert still_serves(asking)


def closed_within(client: TextClient) -> str:
    """Return the reason with which the server closes the connection, perhaps after an answer."""
    with contextlib.suppress(ConnectionClosed):
        client.websocket.recv(WITHIN)
    with pytest.raises(ConnectionClosed) as found:
        client.websocket.recv(WITHIN)
    assert found.value.rcvd is not None
    return found.value.rcvd.reason


@pytest.mark.parametrize(
    ("env_id", "words"),
    [
        ("Odd/Dying-v0", "The environment ended its process (exit status 3)."),
        ("Odd/Crashing-v0", "The environment ended its process (signal SIGSEGV)."),
        ("Odd/Looping-v0", "The environment took longer than 2 s; its process was ended."),
        ("Odd/Hanging-v0", "The environment took longer than 2 s; its process was ended."),
        ("Odd/Multiplying-v0", "The environments started more than 4 processes; all were ended."),
        ("Odd/GreedyTogether-v0", "The environments used more than 300 MB; their process was ended."),
    ],
)
def test_the_close_says_why_an_environments_process_ended(asking: TextClient, env_id: str, words: str) -> None:
    begin_step(asking, env_id)
    assert closed_within(asking) == words


def test_memory_that_processes_may_share_counts_too(asking: TextClient) -> None:
    made = asking.make("Odd/GreedyShared-v0")
    asking.ask("reset", instance_id=made)
    with contextlib.suppress(ConnectionClosed):
        for _ in range(9):
            asking.ask("step", instance_id=made, action=1)
    assert closed_within(asking) == "The environments used more than 300 MB; their process was ended."


def test_a_process_that_an_environment_left_ends_with_the_connection(
    server: GymServerProcess, asking: TextClient
) -> None:
    first_step(asking, "Odd/Forking-v0")
    connections, left = (psutil.Process(server.pid).children(recursive=recursive) for recursive in (False, True))
    assert len(left) > len(connections)  # the fixture sees it gone


def test_an_environment_may_start_threads(asking: TextClient) -> None:
    assert first_step(asking, "Odd/Threading-v0")[0] == [1.0, 0.5]


def test_what_an_environment_prints_disturbs_no_answer(asking: TextClient) -> None:
    assert first_step(asking, "Odd/Printing-v0")[0] == [1.0, 0.5]


@pytest.mark.parametrize("env_id", ["Odd/Looping-v0", "Odd/Hanging-v0", "Odd/Stubborn-v0", "Odd/Calm-v0"])
def test_a_client_that_vanishes_during_a_step_leaves_nothing_behind(server: GymServerProcess, env_id: str) -> None:
    client = TextClient(server.url)
    begin_step(client, env_id)
    client.websocket.socket.close()


def test_others_play_while_an_environment_hangs() -> None:
    """It hangs for longer than an answer may take: if others waited for it, they would get no answer."""
    odd = ("--import", "odd_environments", "--seconds", "600")
    with gym_server(*odd, cwd=HERE) as own, TextClient(own.url + "?form=gymnasium") as other:
        stuck = TextClient(own.url)
        begin_step(stuck, "Odd/Hanging-v0")
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
    for origin in ("https://example.org", "http://127.0.0.1.example.org", "null"):
        with pytest.raises(InvalidStatus) as found, connect(server.url, origin=origin):
            pass
        assert found.value.response.status_code == 403


def test_pages_of_this_machine_may_connect(server: GymServerProcess) -> None:
    with connect(server.url, origin="http://localhost:3000"):
        pass


def test_only_the_path_of_environments_is_served(server: GymServerProcess) -> None:
    with pytest.raises(InvalidStatus) as found, connect(server.url.replace("/gym", "/other")):
        pass
    assert found.value.response.status_code == 404


def test_an_idle_connection_answers_pings(server: GymServerProcess) -> None:
    with connect(server.url) as websocket:
        for _ in range(3):
            assert websocket.ping().wait(WITHIN)


def test_half_a_handshake_keeps_no_other_from_playing(server: GymServerProcess, asking: TextClient) -> None:
    with socket.create_connection(("127.0.0.1", server.port)) as silent:
        silent.sendall(b"GET /gym HTTP/1.1\r\nHost: ")
        assert still_serves(asking)


def test_a_connection_that_is_no_http_is_dropped(server: GymServerProcess) -> None:
    for said in (
        b"\x16\x03\x01\x00\xa5" + bytes(200) + b"\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + b"a" * 20_000,
        b"GET /gym HTTP/1.1\r\nUpgrade: websocket\r\nUpgrade: websocket\r\n\r\n",
    ):
        with socket.create_connection(("127.0.0.1", server.port)) as raw, contextlib.suppress(ConnectionResetError):
            raw.settimeout(WITHIN)
            raw.sendall(said)
            while raw.recv(4096):
                pass


def test_the_number_of_connections_is_limited() -> None:
    with gym_server("--connections", "2") as own:
        with TextClient(own.url), TextClient(own.url) as second:
            with pytest.raises(InvalidStatus) as found, connect(own.url):
                pass
            assert found.value.response.body == b"There are 2 connections already; try later.\n"
            second.make("CartPole-v1")
        until(lambda: serves(own), WITHIN)


def test_the_number_of_silent_connections_is_limited_too() -> None:
    with gym_server("--connections", "3") as own:
        silent = [socket.create_connection(("127.0.0.1", own.port)) for _ in range(3 + REFUSING)]
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
    except (InvalidHandshake, ConnectionClosed, OSError, EOFError):  # when the server refuses decides which
        return False


@pytest.mark.parametrize("asks", [True, False])
def test_a_connection_without_requests_is_closed(asks: bool) -> None:
    """Otherwise silent connections would keep everybody out."""
    with gym_server("--idle-seconds", "1", "--connections", "1") as own, TextClient(own.url) as client:
        if asks:
            client.make("CartPole-v1")
        assert closed_within(client) == "There was no request for 1 s."
        until(lambda: serves(own), WITHIN)


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGTERM, signal.SIGKILL])
def test_no_connection_outlives_the_server(how: signal.Signals) -> None:
    odd = ("--import", "odd_environments", "--seconds", "600")
    with gym_server(*odd, cwd=HERE) as own, TextClient(own.url) as idle, TextClient(own.url) as stuck:
        idle.make("CartPole-v1")
        begin_step(stuck, "Odd/Hanging-v0")
        below = descendants(own)
        assert len(below) == 2
        os.kill(own.pid, how)
        if how is not signal.SIGKILL:
            assert {closed_within(client) for client in (idle, stuck)} == {"The server ends."}
        until(lambda: not any(process.is_running() for process in below), WITHIN)


def test_clients_that_come_and_go_leave_processes_and_memory_as_they_were(server: GymServerProcess) -> None:
    until(lambda: descendants(server) == [], WITHIN)
    process = psutil.Process(server.pid)
    before = process.memory_info().rss, process.num_fds()
    for _ in range(50):
        with TextClient(server.url) as client:
            client.make("Odd/Calm-v0")
    until(lambda: descendants(server) == [], WITHIN)
    assert process.num_fds() == before[1]
    assert process.memory_info().rss < before[0] + 2**20


def test_the_process_that_listens_has_one_thread(server: GymServerProcess) -> None:
    """A fork has only one of its parent's threads, and a lock that another held would never be released."""
    assert psutil.Process(server.pid).num_threads() == 1
