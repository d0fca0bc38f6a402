"""`make run TLS=1 NAMES=userId`: pages by https, and servers by names below localhost, as HIPPO's front end looks for them."""

from __future__ import annotations

import asyncio
import re
import socket
import ssl
import stat
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import httpx
import pytest
from cryptography import x509
from cryptography.x509.oid import ExtendedKeyUsageOID

from hippodrome.local.backend import authority
from hippodrome.local.backend.authority import Authority
from hippodrome.local.web import app as web_app
from hippodrome.local.web import server
from hippodrome.local.web.names import names_server
from testing.waiting import until
from tests.local.conftest import Local
from tests.local.web.test_relay import Game
from tests.trial.hippo_page import HippoPage, hippo_page, new_user_id

Make = Callable[..., Local]
FRONT_END = "http://testing.localhost:3000"


def hold(local: Make, *options: str, front_end: bool = True) -> Local:
    """Return a study whose page is HIPPO's front end, held with TLS."""
    one = local(frames=20)
    if front_end:
        config = one.folder / "config.yml"
        keys = f"plainClients: true\n  frontEnd: [{FRONT_END}]\n  subdomain: userId"
        config.write_text(config.read_text().replace("live: true", f"live: true\n  {keys}"))
    one.begin("--tls", *options)
    one.url = one.wait_for_text(r"(https://localhost:\d+)/next")[1]
    return one


def trusting(one: Local) -> ssl.SSLContext:
    return ssl.create_default_context(cafile=one.place / ".hippodrome" / "tls" / "authority.pem")


class FrontEnd:
    """The requests of HIPPO's front end to next_step, and its address of the server (src/main.js, src/utils/constants.js)."""

    def __init__(self, one: Local) -> None:
        self.user_id = new_user_id()
        self.trusted = trusting(one)
        self.port = int(one.wait_for_text(r"names below localhost, at port (\d+)")[1])
        self.api = one.url.replace("localhost", "api.localhost") + "/next"
        self.address = one.url.partition("//")[2]
        self.client = httpx.Client(
            verify=self.trusted, headers={"Accept": "application/json, text/plain, */*", "Origin": FRONT_END}
        )
        self.site = one.url

    def ask(self, method: str = "GET", answers: dict[str, str] | None = None) -> dict[str, Any]:
        asked = {"projectId": "quick", "userId": self.user_id}
        host = {"Host": self.api.partition("//")[2].partition("/")[0]}
        # The resolver of the tests' machine may know no names below localhost, so the address is localhost's own.
        answer = self.client.request(method, f"{self.site}/next", params=asked, json=answers, headers=host)
        assert answer.headers["access-control-allow-origin"] == FRONT_END
        found: dict[str, Any] = answer.json()
        return found

    def until_the_game(self) -> None:
        until(lambda: self.ask()["page"] == "show_game_page")

    def page(self) -> Any:
        address = f"wss://{self.user_id}.localhost:{self.port}/"
        return hippo_page(address, self.user_id, FRONT_END, trusted=self.trusted, host="127.0.0.1", project_id="quick")


async def play(page: HippoPage) -> None:
    await page.frames(1)
    await page.command("start")
    assert await page.closed() == 1000


def test_hippos_front_end_plays_a_whole_study_by_names_below_localhost(local: Make) -> None:
    one = hold(local, "--names", "userId", "--origin", FRONT_END)
    end = FrontEnd(one)
    assert "hello" in end.ask()["page"]
    end.ask("POST", {"word": "yes"})
    end.until_the_game()

    async def game() -> None:
        async with end.page() as page:
            await play(page)

    asyncio.run(game())
    until(lambda: "bye" in end.ask()["page"])
    assert "end" in end.ask("POST", {"word": "thanks"})["page"]
    answers = one.data / f"quick/users/{end.user_id}/answers"
    assert sorted(file.name for file in answers.iterdir()) == ["1.json", "2.json", "3.json"]
    assert end.user_id not in one.text(), "the terminal shows no whole id"
    assert one.end() == 0


def test_our_own_page_has_the_address_of_its_name_and_its_port(local: Make) -> None:
    one = hold(local, "--names", "userId", front_end=False)
    trusted = trusting(one)
    port = int(one.wait_for_text(r"names below localhost, at port (\d+)")[1])
    with httpx.Client(verify=trusted) as client:
        link = {"projectId": "quick", "userId": "Ada"}
        client.get(f"{one.url}/next", params=link)
        client.post(f"{one.url}/next", params=link, data={"word": "x"})
        state = poll(client, one, link)
        assert state["url"] == f"wss://ada.localhost:{port}/"
        page = client.get(f"{one.url}/next", params=link)
        assert f"wss://*.localhost:{port}" in page.headers["content-security-policy"]


def test_servers_of_a_run_with_other_addresses_are_replaced(local: Make) -> None:
    """A run is killed, and the next one has no TLS."""
    one = hold(local, front_end=False)
    link = {"projectId": "quick", "userId": "Ada"}
    with httpx.Client(verify=trusting(one)) as client:
        client.get(f"{one.url}/next", params=link)
        client.post(f"{one.url}/next", params=link, data={"word": "x"})
        poll(client, one, link)
    before = one.servers()
    one.kill()
    assert one.servers() == before
    one.run()
    with httpx.Client() as client:
        state = poll(client, one, link, attempt=2)
        assert state["url"].startswith("ws://127.0.0.1:")
    assert set(one.servers()).isdisjoint(before)


def poll(client: httpx.Client, one: Local, link: dict[str, str], attempt: int = 1) -> dict[str, Any]:
    """Return the server's state, once it is ready."""

    def ready() -> dict[str, Any] | None:
        state: dict[str, Any] = client.get(f"{one.url}/next", params={**link, "poll": "2"}).json()
        return state if (state["state"], state.get("attempt")) == ("ready", attempt) else None

    found = until(ready)
    assert found is not None
    return found


def test_a_name_that_no_server_has_is_refused_in_the_handshake(local: Make) -> None:
    one = hold(local, front_end=False)
    port = int(one.wait_for_text(r"names below localhost, at port (\d+)")[1])
    for name in ("nobody.localhost", "localhost", "study.example.org"):
        with (
            socket.create_connection(("127.0.0.1", port)) as plain,
            pytest.raises(ssl.SSLError, match=r"(?i)EOF|unrecognized"),
        ):
            trusting(one).wrap_socket(plain, server_hostname=name)


def test_only_names_of_this_machine_are_answered_and_only_its_own_pages_may_send(local: Make) -> None:
    one = hold(local, front_end=False)
    with httpx.Client(verify=trusting(one)) as client:
        port = one.url.rpartition(":")[2]
        for host, status in (("api.localhost", 200), ("study.localhost", 200), ("evil.localhost", 403), ("a.org", 403)):
            link = {"projectId": "quick", "userId": "P1"}
            answer = client.get(f"{one.url}/next", params=link, headers={"Host": f"{host}:{port}"})
            assert answer.status_code == status, host
        for origin, status in ((one.url, 303), (one.url.replace("https", "http"), 403), (FRONT_END, 403)):
            answer = client.post(f"{one.url}/next", params=link, data={"word": "x"}, headers={"Origin": origin})
            assert answer.status_code == status, origin


@pytest.mark.parametrize("options", [("--names", "userId"), ("--tls", "--names", "ids")])
def test_names_without_tls_or_of_another_kind_are_refused_in_a_sentence(local: Make, options: tuple[str, ...]) -> None:
    one = local()
    assert one.begin(*options).wait(60) == 2
    assert "--names is hash or userId, and needs --tls" in one.text()


# ---- the authority


@pytest.fixture
def made(tmp_path: Path) -> Authority:
    return Authority(tmp_path / "tls")


def test_the_authoritys_key_is_readable_by_its_owner_alone_and_stays(made: Authority, tmp_path: Path) -> None:
    key = tmp_path / "tls" / "authority.key"
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    before = made.certificate.read_bytes(), key.read_bytes()
    key.chmod(0o644)
    Authority(tmp_path / "tls")
    assert stat.S_IMODE(key.stat().st_mode) == 0o600
    assert (made.certificate.read_bytes(), key.read_bytes()) == before
    made.context("a.localhost")
    assert sorted(file.name for file in (tmp_path / "tls").iterdir()) == ["authority.key", "authority.pem"]


@pytest.mark.parametrize("harm", ["key", "certificate", "other key", "old"])
def test_an_unusable_authority_is_replaced(
    made: Authority, tmp_path: Path, harm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "tls"
    before = made.certificate.read_bytes()
    if harm == "key":
        (folder / "authority.key").write_text("no key")
    elif harm == "certificate":
        made.certificate.unlink()
    elif harm == "other key":
        Authority(tmp_path / "other")
        (folder / "authority.key").write_bytes((tmp_path / "other" / "authority.key").read_bytes())
    else:

        class Later(datetime):
            @classmethod
            def now(cls, tz: Any = None) -> datetime:
                return datetime.now(tz) + timedelta(days=authority.AUTHORITY_DAYS - authority.NAME_DAYS + 1)

        monkeypatch.setattr(authority, "datetime", Later)
    Authority(folder)
    assert made.certificate.read_bytes() != before


def handshake(made: Authority, name: str, *certificate_for: str) -> None:
    """A TLS handshake in memory of a client that trusts the authority."""
    trusted = ssl.create_default_context(cafile=made.certificate)
    ends = [(ssl.MemoryBIO(), ssl.MemoryBIO()) for _ in range(2)]
    server = made.context(*certificate_for).wrap_bio(*ends[0], server_side=True)
    client = trusted.wrap_bio(*ends[1], server_hostname=name)
    for _ in range(4):
        for side, (_, out), (into, _) in ((client, ends[1], ends[0]), (server, ends[0], ends[1])):
            try:
                side.do_handshake()
            except ssl.SSLWantReadError:
                pass
            finally:
                into.write(out.read())
    client.do_handshake()


def test_the_authority_is_trusted_only_for_names_below_localhost(made: Authority) -> None:
    handshake(made, "alice.localhost", "alice.localhost")
    handshake(made, "127.0.0.1", "localhost", "127.0.0.1")
    for name in ("bank.example.org", "localhost.example.org"):
        with pytest.raises(ssl.SSLError, match=r"(?i)permitted subtree"):
            handshake(made, name, name)
    with pytest.raises(ssl.SSLError, match=r"(?i)mismatch"):
        handshake(made, "bob.localhost", "alice.localhost")


def test_the_authoritys_certificate_has_critical_name_constraints(made: Authority) -> None:
    own = x509.load_pem_x509_certificate(made.certificate.read_bytes())
    limits = own.extensions.get_extension_for_class(x509.NameConstraints)
    assert limits.critical
    assert {str(each.value) for each in limits.value.permitted_subtrees or ()} == {"localhost", "127.0.0.0/8"}
    assert own.not_valid_after_utc < datetime.now(UTC) + timedelta(days=authority.AUTHORITY_DAYS, minutes=1)


# ---- the port of all names


HEAD = "GET /{path} HTTP/1.1\r\nHost: Game.localhost:5000\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n\r\n"


@pytest.fixture
def names(made: Authority) -> Iterator[tuple[int, ssl.SSLContext]]:
    """The port of names with one server, `game`."""
    game = Game()
    find = {"game.localhost": game.port}.get
    web = names_server(socket.create_server(("127.0.0.1", 0)), made, find)
    web.start()
    yield int(web.url.rpartition(":")[2]), ssl.create_default_context(cafile=made.certificate)
    web.close()
    game.close()


def test_a_name_leads_to_its_server_and_the_path_stays(names: tuple[int, ssl.SSLContext]) -> None:
    port, trusted = names
    for path in ("", "gym?x=1"):
        with (
            socket.create_connection(("127.0.0.1", port), timeout=20) as plain,
            trusted.wrap_socket(plain, server_hostname="Game.localhost") as client,
        ):
            client.sendall(HEAD.format(path=path).encode())
            assert client.recv(100) == b"hello"
            client.sendall(b"there")


def test_connections_without_tls_are_closed(names: tuple[int, ssl.SSLContext]) -> None:
    port, _ = names
    with socket.create_connection(("127.0.0.1", port), timeout=20) as client:
        client.sendall(b"GET / HTTP/1.1\r\n\r\n")
        assert re.fullmatch(rb"(\x15.*)?", client.recv(1024), re.DOTALL)


@pytest.fixture
def site(made: Authority) -> Iterator[tuple[int, httpx.Client]]:
    """A web server with TLS: its port, and a client."""
    app = web_app.App({}, lambda _: None)
    web = server.WebServer(app, server.listen(0), tls=made.context("localhost"))
    web.start()
    trusted = ssl.create_default_context(cafile=made.certificate)
    with httpx.Client(base_url=web.url, verify=trusted, timeout=20) as client:
        yield int(web.url.rpartition(":")[2]), client
    web.close()


def test_silent_connections_do_not_block_pages_with_tls(site: tuple[int, httpx.Client]) -> None:
    port, client = site
    silent = [socket.create_connection(("127.0.0.1", port), timeout=20) for _ in range(200)]
    try:
        assert client.get("/healthz").status_code == 200
    finally:
        for each in silent:
            each.close()


def test_the_authority_is_trusted_only_for_server_certificates(made: Authority) -> None:
    own = x509.load_pem_x509_certificate(made.certificate.read_bytes())
    uses = own.extensions.get_extension_for_class(x509.ExtendedKeyUsage)
    assert list(uses.value) == [ExtendedKeyUsageOID.SERVER_AUTH]
