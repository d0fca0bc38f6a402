"""The way from a browser to its game at a lab's one port."""

from __future__ import annotations

import contextlib
import socket
import threading
from collections.abc import Iterator

import pytest

from hippodrome.local.web import app as web_app
from hippodrome.local.web import connections, relay, server
from testing.waiting import until

HEAD = "GET /game/{name}/{rest} HTTP/1.1\r\nHost: lab.example:8000\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"


class Game:
    """A server that notes what each connection sends, and sends `answer` again and again until it may stop."""

    def __init__(self) -> None:
        self.received: list[bytes] = []
        self.sent = 0
        self.answer = b"hello"
        self.endless = False
        self.closed = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        threading.Thread(target=self._serve, daemon=True).start()

    def close(self) -> None:
        self._listener.close()

    def _serve(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                accepted, _ = self._listener.accept()
                threading.Thread(target=self._talk, args=[accepted], daemon=True).start()

    def _talk(self, accepted: socket.socket) -> None:
        with accepted, contextlib.suppress(OSError):
            self.received.append(accepted.recv(65_536))
            accepted.sendall(self.answer)
            while self.endless:
                self.sent += accepted.send(bytes(65_536))
            while data := accepted.recv(65_536):
                self.received.append(data)
        self.closed += 1


@pytest.fixture
def game() -> Iterator[Game]:
    made = Game()
    yield made
    made.close()


@pytest.fixture
def site(game: Game) -> Iterator[server.WebServer]:
    """A web server that leads /game/s1/ to the game, and /game/gone/ to a port where nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        nobody = free.getsockname()[1]
    app = web_app.App({}, lambda _: None, any_name=True)
    ports = {"s1": game.port, "gone": nobody}
    made = server.WebServer(app, server.listen(0), route=relay.by_path(ports.get))
    made.start()
    yield made
    made.close()


def connect(site: server.WebServer, name: str = "s1", rest: str = "") -> socket.socket:
    client = socket.create_connection(("127.0.0.1", int(site.url.rpartition(":")[2])), 10)
    client.sendall(HEAD.format(name=name, rest=rest).encode())
    return client


def test_bytes_are_copied_as_they_are_both_ways(site: server.WebServer, game: Game) -> None:
    with connect(site, rest="gym?token=t") as client:
        assert client.recv(100) == b"hello"
        assert game.received[0].splitlines()[0] == b"GET /gym?token=t HTTP/1.1"
        assert b"host: lab.example:8000" in game.received[0].lower()
        client.sendall(b"\x81\x00 frames of any kind")
        until(lambda: b"".join(game.received).endswith(b"\x81\x00 frames of any kind"))
    until(lambda: game.closed == 1)


@pytest.mark.parametrize(("name", "status"), [("s2", 404), ("gone", 502), ("s1%2f", 404), ("", 404), ("../s1", 404)])
def test_what_leads_to_no_game_is_refused(site: server.WebServer, game: Game, name: str, status: int) -> None:
    with connect(site, name) as client:
        answer = client.makefile("rb").read()
    assert answer.startswith(f"HTTP/1.1 {status} ".encode())
    assert game.received == []


def test_the_game_notices_that_its_browser_reads_slowly(site: server.WebServer, game: Game) -> None:
    game.endless = True
    with connect(site):
        last = -1
        while game.sent != last:
            last = game.sent
            threading.Event().wait(0.5)
        assert game.sent < 16 * 1024 * 1024, "what waits lies in the system's buffers, not in this process"
    until(lambda: game.closed == 1)


def test_games_leave_half_of_the_connections_to_pages(
    site: server.WebServer, game: Game, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "MAX_CONNECTIONS", 4)
    with contextlib.ExitStack() as stack:
        first = [stack.enter_context(connect(site)) for _ in range(2)]
        assert [client.recv(100) for client in first] == [b"hello"] * 2
        third = stack.enter_context(connect(site))
        assert third.recv(100).startswith(b"HTTP/1.1 503 ")
        with socket.create_connection(("127.0.0.1", int(site.url.rpartition(":")[2])), 10) as page:
            page.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
            assert page.recv(100).startswith(b"HTTP/1.1 200 ")
    until(lambda: not site.connections)


def test_a_game_outlives_the_time_that_a_page_has_for_its_headers(
    site: server.WebServer, game: Game, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(connections, "HEADER_SECONDS", 0.3)
    with connect(site) as client:
        assert client.recv(100) == b"hello"
        threading.Event().wait(0.8)
        client.sendall(b"still there")
        until(lambda: game.received[-1] == b"still there")


def test_when_the_web_server_ends_games_lose_their_browsers(site: server.WebServer, game: Game) -> None:
    with connect(site) as client:
        assert client.recv(100) == b"hello"
        site.close()
        assert client.recv(100) == b""
    until(lambda: game.closed == 1)


def test_without_games_no_upgrade_is_made() -> None:
    made = server.WebServer(web_app.App({}, lambda _: None), server.listen(0))
    made.start()
    try:
        with connect(made) as client:
            assert client.recv(100).startswith(b"HTTP/1.1 4")
    finally:
        made.close()
