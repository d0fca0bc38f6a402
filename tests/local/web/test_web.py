"""The web server: events of the shape that API Gateway has, and responses as it makes them."""

from __future__ import annotations

import base64
import json
import socket
import threading
from collections.abc import Callable, Collection, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest

from hippodrome.control.http import Request
from hippodrome.control.participants import forms
from hippodrome.local.web import access, connections, server
from hippodrome.local.web import app as web_app
from testing.waiting import until

Event = dict[str, Any]


class Site:
    """A web server whose functions answer with what `answer` returns, and keep their events."""

    def __init__(self, origins: Collection[str] = ()) -> None:
        self.events: list[tuple[str, Event]] = []
        self.said: list[str] = []
        self.answer: Callable[[Event], Any] = lambda event: {"statusCode": 200, "body": "fine"}
        names = ("next_step", "send_start_server_message", "send_stop_server_message")
        app = web_app.App({name: self._function(name) for name in names}, self.said.append, origins)
        self.server = server.WebServer(app, server.listen(0))
        self.server.start()
        self.http = httpx.Client(base_url=self.server.url, timeout=20)

    def _function(self, name: str) -> Callable[[Event, object], Any]:
        def handler(event: Event, context: object) -> Any:
            self.events.append((name, event))
            return self.answer(event)

        return handler

    def event(self, method: str, url: str, **options: Any) -> Event:
        self.events.clear()
        self.http.request(method, url, **options)
        [(_, event)] = self.events
        return event


@pytest.fixture
def site() -> Iterator[Site]:
    made = Site()
    yield made
    made.http.close()
    made.server.close()


def test_a_get_becomes_an_event_of_format_2(site: Site) -> None:
    event = site.event(
        "GET",
        "/next?projectId=p&userId=a%20b&x=1&x=2&y=",
        headers=[("Accept", "text/html"), ("X-Two", "1"), ("X-Two", "2")],
    )
    assert event["version"] == "2.0"
    assert event["routeKey"] == "GET /next"
    assert event["rawPath"] == "/next"
    assert event["rawQueryString"] == "projectId=p&userId=a%20b&x=1&x=2&y="
    assert event["queryStringParameters"] == {"projectId": "p", "userId": "a b", "x": "1,2", "y": ""}
    assert event["headers"]["accept"] == "text/html"
    assert event["headers"]["x-two"] == "1,2"
    assert "body" not in event
    assert event["isBase64Encoded"] is False
    assert event["requestContext"]["http"] == {"method": "GET", "path": "/next", "sourceIp": "127.0.0.1"}
    json.dumps(event)


@pytest.mark.parametrize(
    ("kind", "body", "text"),
    [
        ("application/json", b'{"a": "\xc3\xa9"}', True),
        ("text/plain; charset=utf-8", b"hello", True),
        ("application/x-www-form-urlencoded", b"a=1&b=%20", False),
        ("multipart/form-data; boundary=x", b"--x--\r\n", False),
        ("application/octet-stream", bytes(range(256)), False),
        ("application/json", b"\xff\xfe", False),
        ("", b"nothing said", False),
    ],
)
def test_bodies_are_sent_as_text_or_in_base64(site: Site, kind: str, body: bytes, text: bool) -> None:
    event = site.event("POST", "/next", content=body, headers={"content-type": kind})
    assert event["isBase64Encoded"] is not text
    assert (event["body"].encode() if text else base64.b64decode(event["body"])) == body
    assert Request.from_event(event).body == body


def test_each_route_has_its_function(site: Site) -> None:
    for method, path in [
        ("GET", "/next"), ("POST", "/next"), ("OPTIONS", "/next"), ("GET", "/steps/p/a.png"), ("GET", "/"),
        ("POST", "/start"), ("POST", "/stop"),
    ]:  # fmt: skip
        site.http.request(method, path)
    assert [name for name, _ in site.events] == ["next_step"] * 5 + [
        "send_start_server_message",
        "send_stop_server_message",
    ]
    picture = site.events[3][1]
    assert picture["routeKey"] == "GET /steps/{projectId}/{file}"
    assert picture["pathParameters"] == {"projectId": "p", "file": "a.png"}


@pytest.mark.parametrize(
    ("method", "path"), [("GET", "/nothing"), ("PUT", "/start"), ("PUT", "/next"), ("GET", "/nothing/next/")]
)
def test_other_requests_are_not_found(site: Site, method: str, path: str) -> None:
    answer = site.http.request(method, path)
    assert (answer.status_code, answer.json()) == (404, {"message": "Not Found"})
    assert site.events == []


def test_an_unknown_address_gets_an_error_page(site: Site) -> None:
    answer = site.http.get("/nothing", headers={"accept": "text/html,*/*"})
    assert (answer.status_code, answer.headers["content-type"]) == (404, "text/html; charset=utf-8")
    assert "Page not found" in answer.text
    assert site.events == []
    event = site.event("GET", "/next/?projectId=p")
    assert (event["rawPath"], event["requestContext"]["http"]["path"]) == ("/next", "/next")


def test_functions_get_the_decoded_path(site: Site) -> None:
    event = site.event("GET", "/steps/p/my%20picture.png")
    assert event["rawPath"] == "/steps/p/my picture.png"
    assert event["pathParameters"]["file"] == "my picture.png"


def test_a_response_keeps_status_headers_and_body(site: Site) -> None:
    site.answer = lambda event: {
        "statusCode": 303,
        "headers": {"Location": "/next?x=1", "Content-Type": "text/html; charset=utf-8", "X-N": 5},
        "body": "<p>é",
    }
    answer = site.http.get("/next")
    assert answer.status_code == 303
    assert answer.headers["location"] == "/next?x=1"
    assert answer.headers["x-n"] == "5"
    assert answer.text == "<p>é"


def test_a_response_in_base64(site: Site) -> None:
    raw = bytes(range(256))
    site.answer = lambda event: {
        "statusCode": 200,
        "headers": {"content-type": "image/png"},
        "body": base64.b64encode(raw).decode(),
        "isBase64Encoded": True,
    }
    answer = site.http.get("/steps/p/a.png")
    assert answer.content == raw
    assert answer.headers["content-type"] == "image/png"
    assert site.http.head("/steps/p/a.png").headers["content-length"] == "256"


def test_a_value_that_is_no_response_becomes_the_body(site: Site) -> None:
    site.answer = lambda event: {"hello": "you"}
    answer = site.http.get("/next")
    assert (answer.status_code, answer.json()) == (200, {"hello": "you"})
    assert answer.headers["content-type"] == "application/json"


@pytest.mark.parametrize("result", [lambda event: 1 / 0, lambda event: {"statusCode": "many"}, lambda event: {1, 2}])
def test_the_error_of_a_function_is_printed_and_not_sent_to_the_participant(
    site: Site, result: Callable[[Event], Any]
) -> None:
    site.answer = result
    answer = site.http.get("/next")
    assert (answer.status_code, answer.json()) == (500, {"message": "Internal Server Error"})
    assert "Traceback" in site.said[0]


def test_a_body_that_no_function_takes_is_refused(site: Site) -> None:
    assert forms.MAX_BODY < web_app.MAX_BODY, "a function must be able to say that a form is too long"
    assert site.http.post("/next", content=b"x" * web_app.MAX_BODY).status_code == 200
    site.events.clear()
    too_long = b"x" * (web_app.MAX_BODY + 1)
    assert site.http.post("/next", content=too_long).status_code == 413
    assert site.http.post("/next", content=iter([too_long])).status_code == 413, "also without Content-Length"
    assert site.events == []


def test_a_body_is_refused_for_its_length_before_it_comes(site: Site) -> None:
    with raw(site) as sender:
        sender.sendall(UNFINISHED)
        assert sender.recv(1024).startswith(b"HTTP/1.1 413 ")


def test_slow_functions_do_not_hold_up_each_other(site: Site) -> None:
    together = threading.Barrier(10)

    def slow(event: Event) -> Any:
        together.wait(20)  # raises unless ten requests are here at the same time
        return {"statusCode": 200}

    site.answer = slow
    with ThreadPoolExecutor(10) as pool:
        answers = list(pool.map(lambda _: httpx.get(f"{site.server.url}/next", timeout=30), range(10)))
    assert [answer.status_code for answer in answers] == [200] * 10


def test_only_this_machine_can_connect(site: Site) -> None:
    host, port = site.server.url.removeprefix("http://").split(":")
    assert host == "127.0.0.1"
    with socket.socket() as other:
        assert other.connect_ex(("127.0.0.2", int(port))) != 0


def test_a_taken_port_leads_to_the_next_free_one() -> None:
    with server.listen(0) as first, server.listen(first.getsockname()[1]) as second:
        assert first.getsockname()[1] < second.getsockname()[1] <= first.getsockname()[1] + server.PORTS_TRIED


def test_without_a_free_port_the_server_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "PORTS_TRIED", 0)
    with server.listen(0) as first:
        port = first.getsockname()[1]
        said = rf"The port {port} is in use or not allowed; choose another \(PORT=, --port\)"
        with pytest.raises(server.NoPort, match=said):
            server.listen(port)


def test_only_ports_that_were_tried_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(server, "_answers", lambda _port, _host: True)
    with pytest.raises(server.NoPort, match="The ports 65530 to 65535 are all in use or not allowed"):
        server.listen(65530)


@pytest.mark.parametrize("port", [-1, 65536, 80000])
def test_an_invalid_port_is_refused(port: int) -> None:
    said = rf"{port} is no port: a port is a number from 1 to 65535 \(PORT=, --port\)"
    with pytest.raises(server.NoPort, match=said):
        server.listen(port)


# Who may ask


@pytest.mark.parametrize(
    "host", ["rebound.example", "rebound.example:8000", "127.0.0.1.example", "", "[", "10.0.0.1:8000"]
)
def test_another_name_for_this_machine_gets_no_answer(site: Site, host: str) -> None:
    for method in ("GET", "POST"):
        answer = site.http.request(method, "/next?projectId=p", headers={"Host": host})
        assert answer.status_code in (400, 403)
    assert site.events == []


@pytest.mark.parametrize("host", ["127.0.0.1:1", "localhost", "LOCALHOST:9999", "[::1]:8000"])
def test_the_names_of_this_machine_are_answered_at_any_port(site: Site, host: str) -> None:
    assert site.http.get("/next?projectId=p", headers={"Host": host}).status_code == 200


FOREIGN: list[tuple[str, str, dict[str, str]]] = [
    ("POST", "/start", {"Origin": "https://evil.example"}),
    ("POST", "/next", {"Origin": "http://127.0.0.1:1"}),
    ("POST", "/next", {"Origin": "null"}),
    ("POST", "/next", {"Origin": "null", "Sec-Fetch-Site": "cross-site"}),
    ("POST", "/stop", {"Origin": "http://127.0.0.1"}),
    ("OPTIONS", "/start", {"Origin": "https://evil.example", "Access-Control-Request-Method": "POST"}),
    ("GET", "/next?projectId=p", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"}),
    ("GET", "/next?projectId=p", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "iframe"}),
    (
        "GET",
        "/next?projectId=p",
        {"Sec-Fetch-Site": "same-site", "Sec-Fetch-Dest": "empty", "Origin": "http://localhost:3"},
    ),
]


@pytest.mark.parametrize(("method", "path", "headers"), FOREIGN)
def test_requests_from_pages_of_other_sites_are_refused(
    site: Site, method: str, path: str, headers: dict[str, str]
) -> None:
    answer = site.http.request(method, path, headers=headers)
    assert answer.status_code == 403
    assert "other sites" in answer.text
    assert "access-control-allow-origin" not in answer.headers
    assert site.events == []


def test_our_own_pages_links_and_programs_are_answered(site: Site) -> None:
    own = site.server.url
    for method, path, headers in [
        ("POST", "/next", {"Origin": own, "Sec-Fetch-Site": "same-origin"}),
        ("POST", "/next", {"Origin": "null", "Sec-Fetch-Site": "same-origin"}),
        ("POST", "/start", {}),
        ("GET", "/next", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "document"}),  # a recruiter's link
        ("GET", "/next", {"Sec-Fetch-Site": "none", "Sec-Fetch-Dest": "document"}),
        ("GET", "/next", {"Sec-Fetch-Site": "same-origin", "Sec-Fetch-Dest": "empty"}),
        ("GET", "/steps/p/a.png", {"Sec-Fetch-Site": "cross-site", "Sec-Fetch-Dest": "image"}),
    ]:
        assert site.http.request(method, path, headers=headers).status_code == 200, (method, path, headers)


@pytest.mark.parametrize(
    ("given", "sent"),
    [
        ("http://localhost:3000/", "http://localhost:3000"),
        ("http://localhost:80", "http://localhost"),
        ("https://Front.example:443", "https://front.example"),
        ("http://localhost:443", "http://localhost:443"),
        ("http://[::1]:3000", "http://[::1]:3000"),
        ("localhost:3000", None),
        ("http://localhost:3000/page", None),
        ("http://localhost:x", None),
    ],
)
def test_an_origin_is_named_as_browsers_send_it(given: str, sent: str | None) -> None:
    assert access.origin_of(given) == sent


def test_answers_can_be_read_by_no_other_origin_than_those_that_were_named() -> None:
    front = "http://localhost:3000"
    for origins, allowed in (([], None), ([front], front)):
        site = Site(origins)
        site.answer = lambda event: {
            "statusCode": 200,
            "headers": {
                "Access-Control-Allow-Origin": "*",
                "Access-Control-Allow-Methods": "GET",
                "Referrer-Policy": "no-referrer",
            },
        }
        try:
            answers = [
                site.http.post("/next", headers={"Origin": front}),
                site.http.get(
                    "/next", headers={"Origin": front, "Sec-Fetch-Site": "same-site", "Sec-Fetch-Dest": "empty"}
                ),
            ]
            assert [answer.status_code for answer in answers] == [200 if allowed else 403] * 2
            assert {answer.headers.get("access-control-allow-origin") for answer in answers} == {allowed}
            own = site.http.get("/next")
            assert not any(name.startswith("access-control") for name in own.headers)
            assert own.headers["referrer-policy"] == "same-origin"  # so that our forms say where they come from
        finally:
            site.http.close()
            site.server.close()


# Slow and many connections


UNFINISHED = b"POST /next HTTP/1.1\r\nHost: localhost\r\nContent-Length: 10000000\r\n\r\n"


def raw(site: Site) -> socket.socket:
    host, port = site.server.url.removeprefix("http://").split(":")
    return socket.create_connection((host, int(port)), timeout=20)


def ends(connection: socket.socket) -> bool:
    """Return whether the server closes the connection within twenty seconds."""
    try:
        while connection.recv(65536):
            pass
    except TimeoutError:
        return False
    except OSError:
        pass
    return True


@pytest.mark.parametrize(
    "begin",
    [
        b"",
        b"GET /next HTTP/1.1\r\nHost: localhost\r\nX-",
        b"POST /next HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1000\r\n\r\nsome",
        b"GET /next HTTP/1.1\r\nHost: localhost\r\n\r\nGET /next",
    ],
)
def test_slow_senders_are_disconnected(site: Site, monkeypatch: pytest.MonkeyPatch, begin: bytes) -> None:
    monkeypatch.setattr(connections, "HEADER_SECONDS", 0.4)
    monkeypatch.setattr(connections, "REQUEST_SECONDS", 0.8)
    with raw(site) as slow:
        slow.sendall(begin)
        stop = threading.Event()

        def drip() -> None:
            while not stop.wait(0.1):
                try:
                    slow.sendall(b"a")
                except OSError:
                    return

        dripping = threading.Thread(target=drip)
        dripping.start()
        try:
            assert ends(slow)
        finally:
            stop.set()
            dripping.join()


@pytest.mark.parametrize("begin", [b"", UNFINISHED, UNFINISHED.replace(b"10000000", b"100000")])
def test_many_slow_connections_do_not_block_others(site: Site, monkeypatch: pytest.MonkeyPatch, begin: bytes) -> None:
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 8)
    slow = []
    try:
        for _ in range(12):
            slow.append(raw(site))
            slow[-1].sendall(begin)
        assert site.http.get("/next").status_code == 200
        assert ends(slow[0])
        assert len(site.server.connections) <= 8
    finally:
        for each in slow:
            each.close()


def test_an_unfinished_body_does_not_hold_up_the_end(capsys: pytest.CaptureFixture[str]) -> None:
    site = Site()
    with raw(site) as slow:
        slow.sendall(UNFINISHED.replace(b"10000000", b"100000"))
        until(lambda: site.server.connections)
        site.http.close()
        site.server.close()
        assert ends(slow)
    assert capsys.readouterr().err == ""


def test_one_address_of_another_machine_has_a_share_of_the_connections(
    site: Site, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "ADDRESS_CONNECTIONS", 3)
    monkeypatch.setattr(connections, "LOOPBACK", "127.0.0.1")
    host, port = site.server.url.removeprefix("http://").split(":")
    own = [raw(site) for _ in range(5)]
    others = [socket.create_connection((host, int(port)), 20, ("127.0.0.2", 0)) for _ in range(5)]
    try:
        assert [ends(other) for other in others[:2]] == [True] * 2
        until(lambda: len(site.server.connections) == 5 + 3)
    finally:
        for connection in (*own, *others):
            connection.close()
