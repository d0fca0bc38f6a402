"""Bots open only the site and servers of one installation, wherever a page, a redirect or a server's state leads."""

from __future__ import annotations

import asyncio
import json
import ssl
from pathlib import Path
from random import Random

import pytest

from hippodrome.bots.addresses import THIS_MACHINE, AddressRefused, AllowedAddresses, OneSite
from hippodrome.bots.bot import Bot
from testing.certificates import authority

SITE = "study.example.org"
SERVER = "s" + "a" * 20 + "-1"
LINK = f"https://{SITE}/next?projectId=rehearsal-1"
ONE_SITE = OneSite(
    f"https://{SITE}", ["wss://*.servers.example.org:443", "wss://*.servers.example.org:5000"], "rehearsal-1"
)

# Addresses


@pytest.mark.parametrize("port", ["", ":443"])
def test_the_pages_of_the_project_are_allowed(port: str) -> None:
    address = f"https://{SITE}{port}/next?projectId=rehearsal-1&userId=ada&signature=0"
    assert ONE_SITE.page(address) == address


@pytest.mark.parametrize(
    "address",
    [
        f"http://{SITE}/next?projectId=rehearsal-1",
        f"https://{SITE}:8443/next?projectId=rehearsal-1",
        "https://example.org/next?projectId=rehearsal-1",
        f"https://{SITE}.evil.org/next?projectId=rehearsal-1",
        f"https://evil.org/{SITE}/next?projectId=rehearsal-1",
        f"https://{SITE}@evil.org/next?projectId=rehearsal-1",
        f"https://evil.org\\@{SITE}/next?projectId=rehearsal-1",
        f"https://ada:word@{SITE}/next?projectId=rehearsal-1",
        f"https://{SITE}:99999/next?projectId=rehearsal-1",
        "https:///next?projectId=rehearsal-1",
        f"https://{SITE}/next?projectId=maze",
        f"https://{SITE}/next?projectId=rehearsal-1&projectId=maze",
        f"https://{SITE}/next",
        f"https://{SITE}/start?projectId=rehearsal-1",
        "http://127.0.0.1:8000/next?projectId=rehearsal-1",
        "",
    ],
)
def test_other_pages_are_refused(address: str) -> None:
    with pytest.raises(AddressRefused):
        ONE_SITE.page(address)


@pytest.mark.parametrize(
    "address", [f"wss://{SERVER}.servers.example.org/", f"wss://{SERVER}.servers.example.org:5000/"]
)
def test_servers_by_their_own_names_are_allowed(address: str) -> None:
    assert ONE_SITE.server(address) == address


@pytest.mark.parametrize(
    "address",
    [
        f"ws://{SERVER}.servers.example.org:5000/",
        f"wss://{SERVER}.servers.example.org:8443/",
        f"wss://{SERVER}.example.org/",
        f"wss://{SERVER}.servers.example.com/",
        f"wss://{SERVER}.more.servers.example.org/",
        f"wss://{SERVER}.evil.org/?.servers.example.org",
        f"wss://{SERVER}.servers.example.org@evil.org/",
        "wss://ada.servers.example.org/",
        "wss://servers.example.org/",
        f"wss://{SITE}/",
        "wss://203.0.113.7/",
        "wss://127.0.0.1:5000/",
    ],
)
def test_other_servers_are_refused(address: str) -> None:
    with pytest.raises(AddressRefused):
        ONE_SITE.server(address)


@pytest.mark.parametrize(
    "address", ["https://127.0.0.1", "http://127.0.0.1.example.org/", "http://localhost@example.org"]
)
def test_on_one_machine_only_its_own_addresses_are_allowed(address: str) -> None:
    with pytest.raises(AddressRefused):
        THIS_MACHINE.page(address)
    with pytest.raises(AddressRefused):
        THIS_MACHINE.server(address.replace("http", "ws"))


def test_a_refused_address_is_named_without_its_token() -> None:
    with pytest.raises(AddressRefused) as refused:
        ONE_SITE.server("wss://evil.org/?token=secret")
    assert "secret" not in str(refused.value)
    assert "wss://evil.org" in str(refused.value)


# A bot that is led astray


class Site:
    """A site on loopback, over TLS, with responses that a test sets.

    `dialled`: the addresses to which bots connected. After a bot has tried to play, all pages are gone.
    """

    def __init__(self, folder: Path) -> None:
        made = authority()
        issued = made.issue(SITE, "*.servers.example.org")
        (folder / "cert.pem").write_bytes(issued.certificate + issued.key)
        self._own = ssl.create_default_context(ssl.Purpose.CLIENT_AUTH)
        self._own.load_cert_chain(folder / "cert.pem")
        self._theirs = ssl.create_default_context(cadata=made.certificate.decode())
        self.answers: dict[str, str] = {}  # by method: the whole answer
        self.dialled: list[str] = []

    def answer(self, method: str, body: str, status: str = "200 OK", **headers: str) -> None:
        lines = [f"{name}: {value}" for name, value in headers.items()]
        head = "\r\n".join([f"HTTP/1.1 {status}", f"Content-Length: {len(body.encode())}", *lines])
        self.answers[method] = f"{head}\r\n\r\n{body}"

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode()
        kind = "SOCKET" if "upgrade: websocket" in head.lower() else head.split()[0]
        writer.write(self.answers[kind].encode())
        if kind == "SOCKET":
            self.answer("GET", "", "404 Not Found")
        await writer.drain()
        writer.close()

    def walk(self, patience: float = 2) -> list[str]:
        """Send a bot through the study, and return its errors and troubles."""

        async def held() -> list[str]:
            server = await asyncio.start_server(self._serve, "127.0.0.1", 0, ssl=self._own)
            port = server.sockets[0].getsockname()[1]

            def connect(host: str, asked: int) -> tuple[str, int]:
                self.dialled.append(f"{host}:{asked}")
                return "127.0.0.1", port

            allowed: AllowedAddresses = OneSite(
                ONE_SITE.site, ONE_SITE.servers, ONE_SITE.project_id, tls=self._theirs, connect=connect
            )
            bot = Bot(LINK, "bot-1", Random(1), patience=patience, allowed=allowed, play=1)
            async with server:
                report = await bot.run()
            return [*report.errors, *report.troubles]

        return asyncio.run(held())


@pytest.fixture
def site(tmp_path: Path) -> Site:
    return Site(tmp_path)


def form(action: str) -> str:
    return f'<body data-step="1"><form method="post" action="{action}"><button>Go on</button></form></body>'


def game(**data: str) -> str:
    told = {"state": {"state": "queued"}, "step": "3", "poll": f"{LINK}&poll=3", **data}
    return f'<body data-step="3"><script type="application/json" id="data">{json.dumps(told)}</script></body>'


def ready(url: str) -> dict[str, object]:
    return {"state": "ready", "url": url, "token": "secret"}


EVIL = "evil.org"


@pytest.mark.parametrize(
    "action", [f"https://{EVIL}/next?projectId=rehearsal-1", f"//{EVIL}/next", f"http://{SITE}/next"]
)
def test_a_form_that_leads_elsewhere_is_not_sent(site: Site, action: str) -> None:
    site.answer("GET", form(action))
    errors = site.walk()
    assert "bots only go to" in errors[0]
    assert site.dialled == [f"{SITE}:443"]


def test_a_form_of_the_site_is_sent_and_the_redirect_elsewhere_is_not_followed(site: Site) -> None:
    site.answer("GET", form(LINK))
    site.answer("POST", "", "303 See Other", Location=f"https://{EVIL}/next?projectId=rehearsal-1")
    errors = site.walk()
    assert f"not to https://{EVIL}" in errors[0]
    assert site.dialled == [f"{SITE}:443"] * 2


def test_a_redirect_into_another_study_of_the_site_is_not_followed(site: Site) -> None:
    site.answer("GET", form(LINK))
    site.answer("POST", "", "303 See Other", Location=f"https://{SITE}/next?projectId=maze&userId=ada")
    assert "their own project" in site.walk()[0]
    assert site.dialled == [f"{SITE}:443"] * 2


def test_a_page_that_is_moved_elsewhere_is_not_followed(site: Site) -> None:
    site.answer("GET", "", "302 Found", Location=f"https://{EVIL}/")
    assert "no page of a study" in site.walk()[0]
    assert site.dialled == [f"{SITE}:443"]


def test_a_waiting_page_that_polls_elsewhere_is_refused(site: Site) -> None:
    site.answer("GET", game(poll=f"https://{EVIL}/next?projectId=rehearsal-1"))
    assert f"not to https://{EVIL}" in site.walk()[0]
    assert site.dialled == [f"{SITE}:443"]


@pytest.mark.parametrize("url", [f"wss://{SERVER}.{EVIL}/", f"wss://{SITE}/", f"wss://{EVIL}/"])
def test_a_server_elsewhere_gets_no_token(site: Site, url: str) -> None:
    site.answer("GET", game(state=ready(url)))
    assert "bots only go to servers" in site.walk()[0]
    assert site.dialled == [f"{SITE}:443"]


def test_a_server_that_redirects_is_not_followed(site: Site) -> None:
    site.answer("GET", game(state=ready(f"wss://{SERVER}.servers.example.org/")))
    site.answer("SOCKET", "", "307 Temporary Redirect", Location=f"wss://{EVIL}/")
    errors = site.walk(patience=60)  # it needs none of it: after its first try the page is gone
    assert any("HTTP 307" in error for error in errors), errors
    assert set(site.dialled) == {f"{SITE}:443", f"{SERVER}.servers.example.org:443"}


def test_a_site_with_an_untrusted_certificate_gets_no_request(site: Site) -> None:
    site.answer("GET", form(LINK))
    site._theirs = ssl.create_default_context()
    assert "CERTIFICATE_VERIFY_FAILED" in site.walk()[0]
