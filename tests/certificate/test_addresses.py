"""A server without a DNS name gets a certificate for its address: a real trial, the function, and a real authority."""

from __future__ import annotations

import json
import os
import socket
import ssl
import struct
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta
from pathlib import Path
from typing import NoReturn

import msgspec
import pytest
from cryptography import x509

from hippodrome.control.certificates.rules import (
    ACCOUNT,
    ADDRESS_ORDERS,
    MAX_ORDERS,
    MAX_ORDERS_OF_SERVER,
    AddressOrders,
    CountedOrder,
    FailureReason,
    OrderFailed,
)
from hippodrome.control.model import server as servers
from hippodrome.control.model.messages import DnsChanged, ServerAttempt
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import Server, ServerState
from hippodrome.control.servers.certifying import Certifying
from hippodrome.protocol import exits
from hippodrome.trial.server import own_certificate
from hippodrome.trial.server.own_certificate import NoCertificate, Order
from tests.certificate.addresses import HOST, Installation, served
from tests.certificate.pebble import Pebble

ROOT = Path(__file__).resolve().parents[2]
WARM = "~" + "0" * 20  # the id of a warm server
AGENT = """
import pathlib
class Agent:
    def start(self, game): pathlib.Path(__file__).with_name("started").touch()
    def reset(self): pass
    def step(self, action): pass
    def render(self): pass
    def close(self): pass
"""
PROGRAM = """
import sys
from hippodrome.trial.server import own_certificate
own_certificate.Order.__init__.__defaults__ = (PORT,)
own_certificate.BETWEEN_ORDERS = 0.1
from hippodrome.trial.__main__ import main
sys.exit(main())
"""


def free_port() -> int:
    with socket.create_server((HOST, 0)) as listening:
        port: int = listening.getsockname()[1]
        return port


@pytest.fixture
def installation(pebble: Pebble) -> Iterator[Installation]:
    with served(pebble) as made:
        yield made


@pytest.fixture
def trial(installation: Installation, tmp_path: Path) -> Iterator[Callable[[Server], subprocess.Popen[str]]]:
    """A function that starts the trial of a server."""
    (tmp_path / "agent.py").write_text(AGENT)
    started = []

    def start(record: Server, elsewhere: bool = False) -> subprocess.Popen[str]:
        env = {
            **{key: value for key, value in os.environ.items() if key not in {"SPOOL", "DEADLINE"}},
            "PROJECT_ID": record.project_id,
            "USER_ID": record.user_id,
            "SERVER": record.name,
            "CREDENTIAL": installation.credential(record),
            "CERTIFICATE": installation.url,
            "TOKEN": "the-secret-token",
            "GAME_STEPS": "3",
            "STORE": str(tmp_path / "bucket"),
            "TRIAL": '{"game": "none", "actionSpace": ["noop"]}',
            "HOST": HOST,
            "PORT": "0",
            "AGENT_DIR": str(tmp_path),
            "PYTHONPATH": str(ROOT),
        }
        program = PROGRAM.replace("PORT", str(free_port() if elsewhere else installation.pebble.http_port), 1)
        process = subprocess.Popen([sys.executable, "-c", program], env=env, stdout=subprocess.PIPE, text=True)
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        assert process.stdout
        process.stdout.close()


def test_a_trial_listens_with_a_certificate_for_its_address(installation, trial, pebble) -> None:
    record = installation.server()
    port = json.loads(trial(record).stdout.readline())["port"]
    context = ssl.create_default_context(cadata=pebble.root())
    with (
        socket.create_connection((HOST, port), 10) as plain,
        context.wrap_socket(plain, server_hostname=HOST) as secure,  # checks the address against the certificate
    ):
        shown = x509.load_der_x509_certificate(secure.getpeercert(True))
    names = shown.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert [str(name) for name in names.get_values_for_type(x509.IPAddress)] == [HOST]
    assert len(list(names)) == 1
    assert DnsChanged("", [ServerAttempt(record.label, 1)]) in installation.ready
    assert installation.orders == 1


def test_a_server_waits_for_its_certificate_until_its_task_was_seen(installation, pebble) -> None:
    record = installation.server(ServerState.STARTING, host="")
    order = Order(installation.url, record.name, installation.credential(record), pebble.http_port)
    issued = []
    thread = threading.Thread(target=lambda: issued.append(order.certificate()))
    thread.start()
    thread.join(3)
    assert not issued
    assert not installation.ready
    installation.server(ServerState.NAMING)
    thread.join(30)
    assert issued
    assert sum("answer" in sent for _, sent in installation.received) == 1  # each answer is another validation
    assert installation.ready


def test_a_server_whose_running_event_was_lost_gets_its_certificate_when_the_sweep_sends_it(
    installation, pebble, monkeypatch
) -> None:
    monkeypatch.setattr(own_certificate, "ORDER_SECONDS", 6.0)
    record = installation.server(ServerState.STARTING, host="")
    order = Order(installation.url, record.name, installation.credential(record), pebble.http_port)
    issued = []
    thread = threading.Thread(target=lambda: issued.append(order.certificate()))
    thread.start()
    thread.join(9)
    assert thread.is_alive()
    installation.server(ServerState.NAMING)
    thread.join(30)
    assert issued
    assert installation.orders == 1


def test_a_warm_server_whose_last_answer_was_lost_gets_its_certificate_after_it_was_assigned(
    installation, pebble
) -> None:
    warm = installation.server(user_id=WARM)
    asked = {"order": installation.ask(warm)[1]["order"], "csr": ""}
    record = installation.server(ServerState.STARTING, user_id="alice")
    record = servers.reserving(record, warm)
    installation.keep(record)
    installation.keep(servers.handed_over(warm, record.label, installation.now()))
    assert installation.ask(warm, **asked) == (200, {})  # the authority works
    installation.keep(servers.assigned(record, warm, installation.now()))
    assert installation.ask(warm, **asked) == (200, {})
    installation.keep(servers.close(record, servers.Reason.STOPPED, installation.now()))
    assert installation.ask(warm, **asked)[0] == 409


def test_after_three_failed_orders_the_trial_ends_with_an_exit_code_of_its_own(installation, trial) -> None:
    process = trial(installation.server(), elsewhere=True)  # not where the authority looks
    assert process.wait(60) == exits.NO_CERTIFICATE
    assert installation.orders == 3
    assert not installation.ready


def test_an_order_belongs_to_the_address_that_the_request_comes_from(installation) -> None:
    record = installation.server(ServerState.STARTING, host="")
    _, placed = installation.ask(record)
    assert placed["address"] == HOST
    assert installation.ask(record, "127.0.0.2", order=placed["order"], csr="") == (
        403,
        {"message": "That order is for another address."},
    )
    elsewhere = "http://169.254.169.254/order"
    assert installation.ask(record, order=elsewhere, csr="")[0] == 403


def test_no_order_is_placed_for_another_address_than_the_tasks(installation) -> None:
    assert installation.ask(installation.server(), "127.0.0.2")[0] == 409
    assert installation.orders == 0


def test_the_authority_looks_when_the_server_says_so_and_the_failure_is_the_validations(installation) -> None:
    record = installation.server()
    order = installation.ask(record)[1]["order"]
    for _ in range(3):
        time.sleep(0.2)
        assert installation.ask(record, order=order, csr="") == (200, {})
    answer = installation.ask(record, order=order, csr="", answer=True)
    for _ in range(50):
        if answer != (200, {}):
            break
        time.sleep(0.2)
        answer = installation.ask(record, order=order, csr="")
    assert answer == (200, {"failed": "validation"})


class Refusing:
    """An authority that refuses each order with this text."""

    def __init__(self, text: str, until: datetime, reason: FailureReason = FailureReason.RATE_LIMITED) -> None:
        self.error = OrderFailed(reason, text, until)

    def order(self, address: str) -> NoReturn:
        raise self.error

    def advance(self, *args: str, **options: bool) -> NoReturn:
        raise self.error


@pytest.mark.parametrize(
    "text",
    [
        "too many certificates (5) already issued for this exact set of identifiers in the last 168h0m0s, retry after …",
        'too many failed authorizations (5) for "203.0.113.7" in the last 1h0m0s, retry after …',
    ],
)
def test_the_limit_of_one_address_keeps_no_other_server_from_ordering(installation, text) -> None:
    record = installation.server()
    installation.certifying = Certifying(installation, lambda: Refusing(text, installation.now() + timedelta(hours=34)))
    assert installation.ask(record) == (200, {"refused": "the limit of this address"})
    installation.certifying = Certifying(installation, installation.open_authority)
    assert "order" in installation.ask(record)[1]


def test_the_limit_of_the_account_keeps_all_from_ordering_until_it_is_over(installation) -> None:
    record = installation.server()
    text = "too many new orders (300) from this account in the last 3h0m0s, retry after …"
    installation.certifying = Certifying(
        installation, lambda: Refusing(text, installation.now() + timedelta(minutes=1))
    )
    assert installation.ask(record) == (200, {"refused": "the limit of this account"})
    installation.certifying = Certifying(installation, installation.open_authority)
    assert "refused" in installation.ask(record)[1]
    installation.wait(minutes=2)
    assert "order" in installation.ask(record)[1]


@pytest.mark.parametrize("reason", [FailureReason.RATE_LIMITED, FailureReason.UNREACHABLE])
def test_a_busy_authority_costs_no_order_and_the_server_asks_again(installation, reason) -> None:
    record = installation.server()
    order = installation.ask(record)[1]["order"]
    busy = Refusing("Service busy; retry later.", installation.now() + timedelta(hours=1), reason)
    installation.certifying = Certifying(installation, lambda: busy)
    assert installation.ask(record)[0] == 429
    assert installation.ask(record, order=order, csr="")[0] == 429
    installation.certifying = Certifying(installation, installation.open_authority)
    assert installation.ask(record, order=order, csr="") == (200, {})
    assert installation.orders == 1


def test_a_trial_that_waits_for_its_certificate_ends_when_asked_to(installation, trial, tmp_path) -> None:
    process = trial(installation.server(ServerState.STARTING, host=""))
    while not (tmp_path / "started").exists():
        time.sleep(0.05)
    process.terminate()
    assert process.wait(10) == 0


def test_a_trial_asks_over_ipv4_although_the_functions_name_has_an_ipv6_address_too(installation, monkeypatch) -> None:
    asked = socket.getaddrinfo
    v6 = (socket.AF_INET6, socket.SOCK_STREAM, 6, "", ("::1", 1, 0, 0))
    monkeypatch.setattr(socket, "getaddrinfo", lambda *wanted: [v6, *asked(*wanted)])
    connected = []
    connect = socket.socket.connect
    monkeypatch.setattr(
        socket.socket, "connect", lambda this, to: (connected.append(this.family), connect(this, to))[1]
    )
    record = installation.server()
    placed = Order(installation.url, record.name, installation.credential(record))._post(
        {"server": "", "credential": ""}
    )
    assert placed[0] == 403
    assert connected == [socket.AF_INET]


def test_who_hangs_up_on_the_proof_leaves_nothing_in_the_log(capfd) -> None:
    port = free_port()
    with own_certificate._serving(port, "token", "proof"):
        for _ in range(3):
            with socket.create_connection((HOST, port)) as scanner:
                scanner.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))  # closes by a reset
                scanner.sendall(b"GET / HTTP/1.0\r\n")
        url = f"http://{HOST}:{port}/.well-known/acme-challenge/token"
        assert urllib.request.urlopen(url, timeout=5).read() == b"proof"
    assert capfd.readouterr().err == ""


def test_a_wrong_credential_and_a_server_that_has_a_name_or_has_ended_get_nothing(installation) -> None:
    record = installation.server()
    assert installation.ask(record, credential="wrong")[0] == 403
    for change in ({"dns": "s1.servers.example.org"}, {"state": ServerState.CLOSED}, {"state": ServerState.DRAINING}):
        installation.documents.put(servers.key(record.label), to_json(msgspec.structs.replace(record, **change)))
        assert installation.ask(record)[0] == 409
    assert installation.orders == 0


def test_no_order_is_placed_beyond_the_limit_until_three_hours_have_passed(installation) -> None:
    record, now = installation.server(), installation.now()
    placed = AddressOrders(tuple(CountedOrder(now - timedelta(minutes=1), f"s{n}-1") for n in range(MAX_ORDERS)))
    installation.documents.put(ADDRESS_ORDERS, to_json(placed))
    assert installation.ask(record) == (200, {"refused": "the limit of certificates is reached"})
    order = Order(installation.url, record.name, installation.credential(record))
    with pytest.raises(NoCertificate, match="takes no orders now"):
        order.certificate()
    installation.wait(hours=3)
    assert "order" in installation.ask(record)[1]
    assert installation.orders == 1


def test_one_server_cannot_use_up_the_orders_of_all(installation) -> None:
    record = installation.server()
    answers = [installation.ask(record)[1] for _ in range(MAX_ORDERS_OF_SERVER + 1)]
    assert ["order" in answer for answer in answers] == [True] * MAX_ORDERS_OF_SERVER + [False]
    assert answers[-1] == {"refused": "the limit of this server"}
    assert installation.orders == MAX_ORDERS_OF_SERVER
    another = installation.server(user_id="bob")
    assert "order" in installation.ask(another)[1]


def test_the_account_is_opened_once(installation, pebble) -> None:
    before = pebble.accounts()
    record = installation.server()
    installation.ask(record)
    installation.certifying = Certifying(installation, installation.open_authority)
    installation.ask(record)
    assert pebble.accounts() - before == 1
    assert installation.documents.get(ACCOUNT)
