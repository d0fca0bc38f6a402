"""Gets a certificate for this server's own IPv4 address, while the server and the agent are still being imported.

The function `certify_server` orders it (`hippodrome/control/servers/certifying.py`). This process makes the key, which
never leaves it, and shows the authority that it has the address: it answers HTTP-01 on port 80 until the certificate is
issued. A failed order cannot be repeated, so each try is a new one.

Only the standard library and the program `openssl` are used: no import delays the first request.
"""

from __future__ import annotations

import http.client
import json
import logging
import ssl
import subprocess
import tempfile
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread
from typing import Any, NamedTuple
from urllib.parse import urlsplit

from hippodrome.protocol import environment

log = logging.getLogger("trial")

ORDERS = 3  # tries
ORDER_SECONDS = 60.0  # for one order, once the task was seen; Let's Encrypt usually takes less than ten
PAUSES = (1.0, 2.0)  # seconds between questions: the first, and the longest; each is a quarter longer than the last
BETWEEN_ORDERS = 5.0  # seconds
BUSY = 2.0  # seconds until the same question is sent again if it was not answered
TIMEOUT = 20.0  # seconds for one answer
CHALLENGE_PORT = 80  # RFC 8555, section 8.3
_IPV4 = ("0.0.0.0", 0)  # noqa: S104 - the local address: in a network with IPv6 the function would see that address
_PATH = "/.well-known/acme-challenge/"
_NEW_REQUEST = "openssl req -new -newkey ec -pkeyopt ec_paramgen_curve:P-256 -noenc -batch -subj /"


class NoCertificate(Exception):
    """The server gets no certificate. The message is for the log."""


class CertificateAndKey(NamedTuple):
    """A chain of certificates and its key (PEM)."""

    chain: bytes
    key: bytes


def begin(env: Mapping[str, str]) -> Future[CertificateAndKey] | None:
    """Begin to order on a thread of its own, if the environment says so. The result may be `NoCertificate`."""
    url = env.get(environment.CERTIFICATE, "").strip()
    if not url:
        return None
    result: Future[CertificateAndKey] = Future()
    server, credential = env.get(environment.SERVER, ""), env.get(environment.CREDENTIAL, "")

    def run() -> None:
        try:
            result.set_result(Order(url, server, credential).certificate())
        except Exception as error:  # noqa: BLE001 - whoever waits for the result gets it
            result.set_exception(error)

    Thread(target=run, name="certificate", daemon=True).start()
    return result


class Order:
    """Orders the certificate. `url` is the address of `certify_server`; the rest is as in the environment."""

    def __init__(self, url: str, server: str, credential: str, port: int = CHALLENGE_PORT) -> None:
        self._url = urlsplit(url)
        self._sent = {"server": server, "credential": credential}
        self._port = port

    def certificate(self) -> CertificateAndKey:
        """Return the certificate. It blocks; raises NoCertificate after the last try, or if none may be made."""
        for number in range(ORDERS):
            if number:
                time.sleep(BETWEEN_ORDERS)
            issued = self._try()
            if issued is not None:
                return issued
        raise NoCertificate(f"{ORDERS} orders of a certificate have failed")

    def _try(self) -> CertificateAndKey | None:
        """Place one order, and follow it to its end; None if it has failed."""
        deadline = time.monotonic() + ORDER_SECONDS
        order = self._ask(deadline)
        if order is None or "order" not in order:
            return None
        with _serving(self._port, order["token"], order["proof"]), tempfile.TemporaryDirectory() as folder:
            key, request = Path(folder, "key.pem"), Path(folder, "request.pem")
            names = ["-addext", f"subjectAltName=IP:{order['address']}"]
            command = [*_NEW_REQUEST.split(), *names, "-keyout", str(key), "-out", str(request)]
            subprocess.run(command, check=True, capture_output=True)  # noqa: S603 - the address is the function's
            pause, longest = PAUSES
            wanted = {"order": order["order"], "csr": request.read_text()}
            answer = self._ask(deadline, **wanted, answer=True)
            while answer is not None and "certificate" not in answer:
                if "unseen" in answer:  # if ECS's event was lost, it takes minutes until the sweep sends it again
                    deadline = time.monotonic() + ORDER_SECONDS
                time.sleep(pause)
                pause = min(longest, pause * 1.25)
                answer = self._ask(deadline, **wanted)
            return CertificateAndKey(answer["certificate"].encode(), key.read_bytes()) if answer else None

    def _ask(self, deadline: float, **more: str | bool) -> dict[str, str] | None:
        """Ask the function; None if the order has failed or takes too long. Raises NoCertificate if it says no."""
        while time.monotonic() < deadline:
            status, answer = self._post({**self._sent, **more})
            if status == 200:
                if "refused" in answer:
                    raise NoCertificate(f"the authority takes no orders now: {answer['refused']}")
                if "failed" in answer:
                    log.warning("an order of a certificate has failed: %s", answer["failed"])
                    return None
                return answer
            if status in (400, 403, 409):
                raise NoCertificate(str(answer.get("message", status)))
            time.sleep(BUSY)  # no answer, a busy function, or an error on our side
        log.warning("an order of a certificate takes too long")
        return None

    def _post(self, body: Mapping[str, str | bool]) -> tuple[int, dict[str, Any]]:
        """Send a request on a connection of its own, over IPv4; status 0 if there is no answer."""
        host, port = self._url.hostname or "", self._url.port
        connection = (
            http.client.HTTPSConnection(
                host, port, timeout=TIMEOUT, source_address=_IPV4, context=ssl.create_default_context()
            )
            if self._url.scheme == "https"
            else http.client.HTTPConnection(host, port, timeout=TIMEOUT, source_address=_IPV4)
        )
        try:
            connection.request("POST", self._url.path, json.dumps(body), {"Content-Type": "application/json"})
            answer = connection.getresponse()
            content = json.loads(answer.read(64 * 1024))
            return answer.status, content if isinstance(content, dict) else {}
        except (OSError, ValueError, http.client.HTTPException) as error:
            log.warning("no answer about the certificate: %s", type(error).__name__)
            return 0, {}
        finally:
            connection.close()


class _Server(ThreadingHTTPServer):
    def handle_error(self, request: object, client_address: object) -> None:
        """Log nothing: a scanner that hangs up would write its address and a traceback into the log."""


@contextmanager
def _serving(port: int, token: str, proof: str) -> Iterator[None]:
    """Answer the authority's question for the token until the block ends; without a token, nothing is asked."""
    if not token:
        yield
        return

    class Proof(BaseHTTPRequestHandler):
        timeout = 10.0

        def do_GET(self) -> None:
            body = proof.encode() if self.path == _PATH + token else b""
            self.send_response(200 if body else 404)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body)

        def log_message(self, format: str, *args: object) -> None:
            """Log nothing: anybody may send anything to this port."""

    with _Server(("0.0.0.0", port), Proof) as server:  # noqa: S104 - the authority asks from anywhere
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        try:
            yield
        finally:
            server.shutdown()
            thread.join()
