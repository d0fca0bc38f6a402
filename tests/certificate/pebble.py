"""A real certificate authority on loopback: Pebble, Let's Encrypt's ACME server for tests, with its DNS server.

They are Debian's packages `pebble` and `pebble-challtestsrv`. A CA that is made here signs the certificate of Pebble's address.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import socket
import ssl
import subprocess
import time
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest

from hippodrome.control.aws.challenges import Route53Challenges
from testing.certificates import authority

MISSING = "pebble and pebble-challtestsrv are not installed (Debian packages of these names)"
STARTS_WITHIN = 20  # seconds, on a busy machine


def installed() -> bool:
    return all(shutil.which(name) for name in ("pebble", "pebble-challtestsrv"))


@dataclass
class Pebble:
    """A running Pebble: `directory` is its ACME directory, `trusted` the PEM by which its HTTPS is checked."""

    directory: str
    management: str
    trusted: str
    dns: str
    dns_port: int
    dns_management: str
    http_port: int
    log: Path

    def root(self) -> str:
        """Return the root of the certificates that it issues."""
        return self.ask(f"{self.management}/roots/0").decode()

    def ask(self, url: str) -> bytes:
        with urllib.request.urlopen(url, context=ssl.create_default_context(cadata=self.trusted), timeout=10) as answer:
            return answer.read()

    def tell_dns(self, verb: str, **said: Any) -> bytes:
        request = urllib.request.Request(f"{self.dns_management}/{verb}", json.dumps(said).encode())
        with urllib.request.urlopen(request, timeout=10) as answer:
            return answer.read()

    def orders(self) -> int:
        """Return the number of orders that it has accepted."""
        return self.log.read_text().count(" Added order ")

    def accounts(self) -> int:
        """Return the number of accounts that were made."""
        return self.log.read_text().count("accounts in memory")


def answer_as_route_53(pebble: Pebble, monkeypatch: pytest.MonkeyPatch) -> None:
    """Publish in Pebble's DNS, too, what is put into Route 53."""
    put = Route53Challenges.put

    def put_there_too(self: Route53Challenges, name: str, values: Sequence[str], seconds: float) -> None:
        put(self, name, values, seconds)
        pebble.tell_dns("clear-txt", host=f"{name}.")
        for value in values:
            pebble.tell_dns("set-txt", host=f"{name}.", value=value)

    monkeypatch.setattr(Route53Challenges, "put", put_there_too)


class TestChallenges:
    """`Challenges` on challtestsrv. `present` holds the published values; `puts` and `removals` hold all calls."""

    __test__ = False

    def __init__(self, pebble: Pebble) -> None:
        self._pebble = pebble
        self.present: dict[str, list[str]] = {}
        self.puts: list[tuple[str, list[str]]] = []
        self.removals: list[tuple[str, list[str]]] = []
        self.lies = False  # True: it publishes other values

    def put(self, name: str, values: Sequence[str], seconds: float) -> None:
        assert seconds > 0
        self.puts.append((name, list(values)))
        self.present[name] = list(values)
        self._pebble.tell_dns("clear-txt", host=f"{name}.")
        for value in values:
            self._pebble.tell_dns("set-txt", host=f"{name}.", value="wrong" if self.lies else value)

    def remove(self, name: str, values: Sequence[str]) -> None:
        self.removals.append((name, list(values)))
        if self.present.get(name) == list(values):
            del self.present[name]
            self._pebble.tell_dns("clear-txt", host=f"{name}.")

    @property
    def left(self) -> list[str]:
        return [value for values in self.present.values() for value in values]


def make_ca(folder: Path) -> tuple[str, Path, Path]:
    """Make a CA and a certificate for loopback that it signs: the CA's PEM, the certificate's file, the file of its key."""
    made = authority("Test CA")
    issued, files = made.issue("localhost", "127.0.0.1"), (folder / "cert.pem", folder / "key.pem")
    for file, content in zip(files, issued, strict=True):
        file.write_bytes(content)
    return made.certificate.decode(), *files


@contextlib.contextmanager
def running(folder: Path, lifetime: timedelta = timedelta(days=90)) -> Iterator[Pebble]:
    """Run Pebble and its DNS server until the block ends."""
    with contextlib.ExitStack() as stack:
        for last in (False, False, True):
            try:
                pebble = stack.enter_context(_started(folder, lifetime))
                break
            except DidNotStart:  # another process was faster at one of the ports
                if last:
                    raise
        yield pebble


class DidNotStart(Exception):
    pass


@contextlib.contextmanager
def _started(folder: Path, lifetime: timedelta) -> Iterator[Pebble]:
    trusted, certificate, key = make_ca(folder)
    dns, dns_management, acme, management, http_port, unused = _ports(6)
    config = {
        "listenAddress": f"127.0.0.1:{acme}",
        "managementListenAddress": f"127.0.0.1:{management}",
        "certificate": str(certificate),
        "privateKey": str(key),
        "httpPort": http_port,
        "tlsPort": unused,
        "ocspResponderURL": "",
        "externalAccountBindingRequired": False,
        "domainBlocklist": ["blocked.example"],
        "profiles": {  # Pebble 2.7 and later; earlier ones know no profiles
            "default": {"description": "for names", "validityPeriod": int(lifetime.total_seconds())},
            "shortlived": {"description": "for addresses", "validityPeriod": 160 * 3600},
        },
        "certificateValidityPeriod": int(lifetime.total_seconds()),
    }
    (folder / "pebble.json").write_text(json.dumps({"pebble": config}))
    log = folder / "pebble.log"
    # With 20 %, one of a run's thousand requests was refused eight times in a row now and then, which ends an order.
    settings = {"PEBBLE_VA_NOSLEEP": "1", "PEBBLE_WFE_NONCEREJECT": "10", "PEBBLE_AUTHZREUSE": "0"}
    unneeded = ["-http01", "", "-https01", "", "-tlsalpn01", ""]
    commands = [
        ["pebble-challtestsrv", "-dns01", f"127.0.0.1:{dns}", "-management", f"127.0.0.1:{dns_management}", *unneeded],
        ["pebble", "-strict", "-config", str(folder / "pebble.json"), "-dnsserver", f"127.0.0.1:{dns}"],
    ]
    processes = []
    with contextlib.ExitStack() as stack:
        for command in commands:
            out = stack.enter_context((folder / f"{command[0]}.log").open("wb"))
            process = subprocess.Popen(command, stdout=out, stderr=subprocess.STDOUT, env={**os.environ, **settings})
            stack.callback(process.wait, 10)
            stack.callback(process.kill)
            processes.append(process)
        pebble = Pebble(
            directory=f"https://127.0.0.1:{acme}/dir",
            management=f"https://127.0.0.1:{management}",
            trusted=trusted,
            dns="127.0.0.1",
            dns_port=dns,
            dns_management=f"http://127.0.0.1:{dns_management}",
            http_port=http_port,
            log=log,
        )
        for port in (dns, dns_management, acme, management):  # its name server also listens on TCP
            _wait_for(port, processes, folder)
        yield pebble


def _ports(number: int) -> list[int]:
    """Ports that are free now."""
    with contextlib.ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(number)]
        for one in sockets:
            one.bind(("127.0.0.1", 0))
        return [one.getsockname()[1] for one in sockets]


def _wait_for(port: int, processes: list[subprocess.Popen[bytes]], folder: Path) -> None:
    deadline = time.monotonic() + STARTS_WITHIN
    while True:
        if any(process.poll() is not None for process in processes) or time.monotonic() > deadline:
            raise DidNotStart("\n".join(path.read_text()[-2000:] for path in folder.glob("*.log")))
        try:
            socket.create_connection(("127.0.0.1", port), 1).close()
            return
        except OSError:
            time.sleep(0.05)
