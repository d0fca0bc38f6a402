"""An installation without a domain whose function `certify_server` is served on loopback, with a real authority."""

from __future__ import annotations

import contextlib
import http.server
import json
import threading
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgspec

from hippodrome.control.certificates.accounts import account_key
from hippodrome.control.certificates.addresses import AddressAuthority
from hippodrome.control.certificates.rules import ADDRESS_ORDERS, AddressOrders
from hippodrome.control.http import Request
from hippodrome.control.model import server as servers
from hippodrome.control.model.messages import DnsChanged, parse_dns_changed
from hippodrome.control.model.records import from_json, to_json
from hippodrome.control.model.server import Server, ServerState
from hippodrome.control.servers.certifying import Certifying
from hippodrome.control.storage.secret import SecretCache
from testing.fake_platform import FakePlatform
from testing.studies import study
from tests.certificate.pebble import Pebble

HOST = "127.0.0.1"


class Installation(FakePlatform):
    """An installation without a domain, whose function `certify_server` is served at `url`."""

    def __init__(self, pebble: Pebble) -> None:
        super().__init__()
        self.settings = replace(self.settings, root_domain="", servers_host="", game_sources="")
        self.pebble, self.url = pebble, ""
        self.received: list[tuple[str, dict[str, Any]]] = []  # the source and the body of each request of a trial
        self.secrets = SecretCache(self.documents)
        self.secrets.get_or_create()
        self.certifying = Certifying(self, self.open_authority)

    def open_authority(self) -> AddressAuthority:
        directory = self.pebble.directory
        return AddressAuthority(directory, account_key(self.documents, directory), self.pebble.trusted)

    def server(self, state: ServerState = ServerState.NAMING, host: str = HOST, user_id: str = "alice") -> Server:
        """Store the record of a server whose task runs at this address."""
        record = servers.new_attempt(
            study(id="maze"), user_id, 1, nonce="nonce", settings=self.settings, now=self.now()
        )
        return self.keep(msgspec.structs.replace(record, state=state, host=host, task="task"))

    def keep(self, record: Server) -> Server:
        self.documents.put(servers.key(record.label), to_json(record))
        return record

    def credential(self, record: Server) -> str:
        return self.secrets.get_or_create().credential(record.name, record.nonce)

    def ask(self, record: Server, source: str = HOST, **more: str | bool) -> tuple[int, dict[str, Any]]:
        body = json.dumps({"server": record.name, "credential": self.credential(record), **more}).encode()
        answer = self.certifying.respond(Request("POST", "/certificate", (), {}, body, source))
        return answer.status, json.loads(answer.body)

    @property
    def ready(self) -> list[DnsChanged]:
        """The messages that make servers ready."""
        return [message for _, sent in self.bus.delayed if (message := parse_dns_changed(sent))]

    @property
    def orders(self) -> int:
        found = self.documents.get(ADDRESS_ORDERS)
        return len(from_json(found.body, AddressOrders).placed) if found else 0


@contextlib.contextmanager
def served(pebble: Pebble) -> Iterator[Installation]:
    """Serve the function of a new installation until the block ends."""
    made = Installation(pebble)

    class Function(http.server.BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            body = self.rfile.read(int(self.headers["Content-Length"]))
            made.received.append((self.client_address[0], json.loads(body)))
            answer = made.certifying.respond(Request("POST", self.path, (), {}, body, self.client_address[0]))
            self.send_response(answer.status)
            self.end_headers()
            self.wfile.write(str(answer.body).encode())

        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer((HOST, 0), Function) as function:
        thread = threading.Thread(target=function.serve_forever, args=(0.05,))
        thread.start()
        made.url = f"http://{HOST}:{function.server_port}/certificate"
        yield made
        function.shutdown()
        thread.join()
