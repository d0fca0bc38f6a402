"""A real trial server runs while its certificate is renewed, and is asked over TLS."""

import asyncio
import json
import os
import socket
import ssl
import subprocess
import sys
import time
from datetime import timedelta
from pathlib import Path

import pytest
from cryptography import x509

from testing.waiting import until
from tests.certificate.conftest import DOMAIN, FULLCHAIN, PRIVKEY

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = "import sys, hippodrome.trial.server.listener; hippodrome.trial.server.listener.RELOAD_SECONDS = 0.1; from hippodrome.trial.__main__ import main; sys.exit(main())"
AGENT = """
class Agent:
    def start(self, game): pass
    def reset(self): pass
    def step(self, action): pass
    def render(self): pass
    def close(self): pass
"""


@pytest.fixture
def trial(place, tmp_path):
    """A function that starts a trial server with the bucket and returns its port."""
    (tmp_path / "agent").mkdir()
    (tmp_path / "agent" / "agent.py").write_text(AGENT)
    env = {
        **{key: value for key, value in os.environ.items() if key not in {"SPOOL", "DEADLINE"}},
        "PROJECT_ID": "study",
        "USER_ID": "P1",
        "SERVER": "a1",
        "TOKEN": "the-secret-token",
        "GAME_STEPS": "3",
        "STORE": str(place.folder),
        "SSL_FULLCHAIN": FULLCHAIN,
        "SSL_PRIVKEY": PRIVKEY,
        "TRIAL": '{"game": "none", "actionSpace": ["noop"]}',
        "HOST": "127.0.0.1",
        "PORT": "0",
        "AGENT_DIR": str(tmp_path / "agent"),
        "PYTHONPATH": str(ROOT),
    }
    started = []

    def start():
        said = (tmp_path / "trial.txt").open("wb")
        process = subprocess.Popen(
            [sys.executable, "-c", PROGRAM], cwd=tmp_path, env=env, stdout=subprocess.PIPE, stderr=said, text=True
        )
        started.append((process, said))
        line = process.stdout.readline()
        assert line, (tmp_path / "trial.txt").read_text()
        return json.loads(line)["port"]

    yield start
    for process, said in started:
        process.kill()
        process.wait()
        process.stdout.close()
        said.close()


def shown(port, root):
    """Return the serial number of the certificate that the server shows to a client that checks it."""
    context = ssl.create_default_context(cadata=root)
    with (
        socket.create_connection(("127.0.0.1", port), 10) as plain,
        context.wrap_socket(plain, server_hostname=f"k3f9-1.{DOMAIN}") as secure,
    ):
        return f"{x509.load_der_x509_certificate(secure.getpeercert(True)).serial_number:x}"


def wait_until_shown(port, root, serial):
    until(lambda: shown(port, root) == serial)  # every connection meanwhile must succeed


def test_a_running_server_shows_the_renewed_certificate(place, trial):
    first = place.obtain().stored.serial
    port, root = trial(), place.pebble.root()
    assert shown(port, root) == first
    place.ahead = timedelta(days=61)
    second = place.obtain().stored.serial
    assert second != first
    wait_until_shown(port, root, second)


def test_connections_stay_while_the_certificate_changes(place, trial):
    from websockets.asyncio.client import connect

    place.obtain()
    port, root = trial(), place.pebble.root()

    async def stay():
        context = ssl.create_default_context(cadata=root)
        address = f"wss://k3f9-1.{DOMAIN}:{port}/"
        async with connect(address, host="127.0.0.1", ssl=context, subprotocols=["hippodrome"], proxy=None) as held:
            place.ahead = timedelta(days=61)
            serial = (await asyncio.to_thread(place.obtain)).stored.serial
            await asyncio.to_thread(wait_until_shown, port, root, serial)
            await asyncio.wait_for(await held.ping(), 10)

    asyncio.run(stay())


def test_half_a_renewal_affects_no_server(place, trial, tmp_path):
    """The renewal was killed between writing privkey.pem and fullchain.pem: running servers go on, and new ones can start."""
    place.obtain()
    old_chain = place.chain
    place.ahead = timedelta(days=61)
    port, root = trial(), place.pebble.root()
    second = place.obtain().stored.serial
    (place.folder / FULLCHAIN).write_text(old_chain)
    wait_until_shown(port, root, second)
    assert shown(trial(), root) == second


def test_a_pair_that_does_not_fit_is_not_used_by_a_running_server(place, trial, tmp_path):
    """An administrator puts one file there by hand and not the other."""
    serial = place.obtain().stored.serial
    port, root = trial(), place.pebble.root()
    (place.folder / PRIVKEY).write_text("-----BEGIN PRIVATE KEY-----\nnonsense\n-----END PRIVATE KEY-----\n")
    until(lambda: "the present one stays" in (tmp_path / "trial.txt").read_text())
    other = place.folder.parent / "other"
    other.mkdir()
    from tests.certificate.pebble import make_ca

    _, chain, _ = make_ca(other)
    (place.folder / FULLCHAIN).write_bytes(chain.read_bytes())
    time.sleep(0.5)  # several reloads
    assert shown(port, root) == serial
