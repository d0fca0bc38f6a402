"""An HTTP server on loopback that checks presigned requests as S3 does, and runs the function that signs them.

moto and ministack accept any signature. This server computes the signature of each request anew, refuses a request
whose signature differs or has expired, and asks the role of `sign_requests` in the template whether a signed request is
allowed.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import SimpleNamespace
from typing import Any
from unittest import mock
from urllib.parse import parse_qs, quote, unquote, urlsplit

from botocore.auth import S3SigV4QueryAuth
from botocore.awsrequest import AWSRequest
from botocore.credentials import ReadOnlyCredentials

from hippodrome.control.aws.signer import S3Signer
from hippodrome.control.model import server
from hippodrome.control.model.records import to_json
from hippodrome.control.model.server import Server
from hippodrome.control.ports import Conflict
from hippodrome.control.storage.secret import SecretCache
from hippodrome.functions import installed, sign_requests
from hippodrome.protocol import environment
from testing import aws_events
from testing import template as cfn
from testing.fake_platform import FakePlatform
from testing.iam.actions import Ask
from testing.iam.judge import Judge, evaluator

BUCKET, REGION = "the-bucket", "eu-central-1"
KEYS = ReadOnlyCredentials("ASIATESTING", "the role's secret", "the role's session")


class StrictS3(FakePlatform):
    """A platform whose documents can be read and written over HTTP, too. Trials ask for presigned requests at `url`."""

    def __init__(self) -> None:
        super().__init__()
        self.clock = datetime.now(UTC)
        self.lock = threading.RLock()
        self.requests: list[tuple[str, str, int]] = []  # method, path and status of all requests so far
        self.failing: list[int] = []  # the statuses that the next requests to the bucket get
        domain = {"RootDomain": self.settings.root_domain, "ServersHost": self.settings.servers_host}
        values = cfn.ReferenceValues(parameters=domain, known={"Bucket": BUCKET})
        self.judge = Judge(values) if evaluator() else None
        self._server = ThreadingHTTPServer(("127.0.0.1", 0), _handler(self))
        self.endpoint = f"http://127.0.0.1:{self._server.server_port}"
        self.url = f"{self.endpoint}/sign"
        meta = SimpleNamespace(endpoint_url=self.endpoint, region_name=REGION)
        self.signer = S3Signer(lambda: SimpleNamespace(meta=meta), lambda: KEYS, BUCKET)

    @contextmanager
    def serving(self) -> Iterator[StrictS3]:
        """Answer requests within the block."""
        installed.use(self)  # this platform has all that `sign_requests` needs
        thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        thread.start()
        try:
            yield self
        finally:
            self._server.shutdown()
            self._server.server_close()
            installed.use(None)

    def now(self) -> datetime:
        return datetime.now(UTC)

    def keep(self, record: Server) -> Server:
        """Write a server's record, and return it."""
        with self.lock:
            self.documents.put(server.key(record.label), to_json(record))
        return record

    def variables(self, record: Server) -> dict[str, str]:
        """Return the environment variables with which the server of this record asks for presigned requests."""
        with self.lock:
            credential = SecretCache(self.documents).get_or_create().credential(record.name, record.nonce)
        return {environment.STORE: self.url, environment.SERVER: record.name, environment.CREDENTIAL: credential}

    def answer(self, method: str, target: str, headers: Mapping[str, str], body: bytes) -> tuple[int, bytes]:
        """Answer one request to `target`, an address without scheme and host: its status and body."""
        path = urlsplit(target).path
        with self.lock:
            status, found = (
                self._sign(method, headers, body) if path == "/sign" else self._s3(method, target, headers, body)
            )
            self.requests.append((method, unquote(path), status))
        return status, found

    def _sign(self, method: str, headers: Mapping[str, str], body: bytes) -> tuple[int, bytes]:
        event = aws_events.load("http_post_json")
        event |= {"rawPath": "/sign", "rawQueryString": "", "body": body.decode("latin-1"), "isBase64Encoded": False}
        event["requestContext"]["http"] |= {"method": method, "path": "/sign"}
        answer = sign_requests.handler(event, None)
        return answer["statusCode"], answer["body"].encode()

    def _s3(self, method: str, target: str, headers: Mapping[str, str], body: bytes) -> tuple[int, bytes]:
        if self.failing:
            return self.failing.pop(0), b""
        bucket, _, key = unquote(urlsplit(target).path).removeprefix("/").partition("/")
        why = self._refusal(method, target, headers)
        if why or bucket != BUCKET or not self._may(method, key, headers):
            return 403, (why or "AccessDenied").encode()
        if method == "GET":
            document = self.documents.get(key)
            return (200, document.body) if document else (404, b"NoSuchKey")
        try:
            self.documents.create(key, body)
        except Conflict:
            return 412, b"PreconditionFailed"
        return 200, b""

    def _refusal(self, method: str, target: str, headers: Mapping[str, str]) -> str:
        """Return why the signature of this request is not valid now; an empty string if it is."""
        parts = urlsplit(target)
        query = {name: values[0] for name, values in parse_qs(parts.query, keep_blank_values=True).items()}
        try:
            signed = query["X-Amz-SignedHeaders"].split(";")
            since = datetime.strptime(query["X-Amz-Date"], "%Y%m%dT%H%M%SZ").replace(tzinfo=UTC)
            seconds, given = int(query["X-Amz-Expires"]), query["X-Amz-Signature"]
        except (KeyError, ValueError):
            return "AccessDenied"
        if not since - timedelta(minutes=15) <= self.now() < since + timedelta(seconds=seconds):
            return "Request has expired"
        if any(name != "host" and name not in headers for name in signed):
            return "SignatureDoesNotMatch"
        if any(name.startswith("x-amz-") and name not in signed for name in headers):
            return "There were headers present in the request which were not signed"
        request = AWSRequest(
            method=method,
            url=f"http://{headers['host']}{quote(unquote(parts.path), safe='/~')}",
            headers={name: headers[name] for name in signed if name != "host"},
        )
        with mock.patch("botocore.auth.get_current_datetime", return_value=since.replace(tzinfo=None)):
            S3SigV4QueryAuth(KEYS, "s3", REGION, expires=seconds).add_auth(request)
        expected = parse_qs(urlsplit(request.url).query)
        if expected["X-Amz-Signature"] != [given] or set(expected) != set(query):
            return "SignatureDoesNotMatch"
        return ""

    def _may(self, method: str, key: str, headers: Mapping[str, str]) -> bool:
        if self.judge is None:
            return True
        action = {"GET": "s3:GetObject", "PUT": "s3:PutObject"}.get(method, "s3:DeleteObject")
        context = {"s3:if-none-match": headers["if-none-match"]} if "if-none-match" in headers else {}
        return self.judge.may("sign_requests", Ask(action, f"arn:aws:s3:::{BUCKET}/{key}", context))


def _handler(world: StrictS3) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def _answer(self) -> None:
            body = self.rfile.read(int(self.headers.get("content-length") or 0))
            headers = {name.lower(): value for name, value in self.headers.items()}
            status, found = world.answer(self.command, self.path, headers, body)
            self.send_response(status)
            self.send_header("Content-Length", str(len(found)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(found)

        do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = _answer

        def log_message(self, *_: Any) -> None:
            pass

    return Handler
