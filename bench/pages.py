"""Measures the size of the pages, and how many requests one machine answers on its step pages."""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import os
import re
import signal
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Awaitable, Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlencode, urlsplit

from bench.study_on_moto import ANSWERS, ROOT, MeasuredBrowser, MeasuredStudy, on_moto, warm
from bench.table import Row, each, row
from hippodrome.model import ids
from testing.aws_events import FORM
from testing.visitors import body_of, hidden, sent

PEOPLE = 200  # participants at once
SECONDS = 120  # after so many seconds the measurement fails
GAME_PAGE = 40 * 1024  # bytes, compressed
GAME_PAGE_BOUND = "ours: the size of the game page over the network"


def rows() -> Iterator[Row]:
    """Measure everything, one row after another; about a minute."""
    yield from each([weights, crowd])


# Sizes


def weights() -> Iterator[Row]:
    """Measure the example project's pages as `next_step` answers them."""
    with on_moto() as study:
        warm(study)
        pages = dict(_walk(study))
    sizes = {name: len(gzip.compress(body)) for name, (body, _) in pages.items()}
    plain = {name: len(body) for name, (body, _) in pages.items()}
    lengths = {name: length for name, (_, length) in pages.items()}
    heaviest = max((name for name in pages if name != "game"), key=lambda name: sizes[name])
    own = len(gzip.compress((ROOT / "steps" / f"{heaviest}.html").read_bytes()))
    detail = {
        name: f"{sizes[name]:,} bytes by gzip, {plain[name]:,} plain, {lengths[name]:,} as the function sends it"
        for name in pages
    }
    yield row(
        f"step page ({heaviest}, the heaviest), gzip, against its own file alone",
        sizes[heaviest],
        "bytes",
        yardstick=own,
        detail=detail,
    )
    yield row(
        "game page, gzip, against the same uncompressed",
        sizes["game"],
        "bytes",
        yardstick=plain["game"],
        at_most=GAME_PAGE,
        judge="value",
        bound=GAME_PAGE_BOUND,
    )
    yield row(
        "game page, as sent to a browser that accepts gzip, against the same uncompressed",
        lengths["game"],
        "bytes",
        yardstick=plain["game"],
        at_most=GAME_PAGE,
        judge="value",
        bound=GAME_PAGE_BOUND,
    )


def _walk(study: MeasuredStudy) -> Iterator[tuple[str, tuple[bytes, int]]]:
    """Yield every page of the study: its name, its body, and how many bytes go over the network for it."""
    browser = MeasuredBrowser(study, "P1")
    for step in study.steps:
        answer = browser.open()
        page = body_of(answer)
        group = f"-{ids.group(study.id, browser.user, step['variants'])}" if step["variants"] else ""
        yield f"{step['page']}{group}", (page, len(sent(answer)))
        if step["page"] == "game":
            study.play(browser.user, step["key"])
        elif step["key"] in ANSWERS:
            browser.post(page.decode(), ANSWERS[step["key"]])


# A crowd


class Exchange(NamedTuple):
    """The answer to one request."""

    status: int
    headers: Mapping[str, str]
    body: bytes


class KeptConnection:
    """A client with one kept connection. It does plain HTTP/1.1, so it leaves more of the machine to the server."""

    def __init__(self, address: str) -> None:
        url = urlsplit(address)
        self._host, self._port = str(url.hostname), int(url.port or 80)
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, method: str, target: str, body: bytes = b"") -> Exchange:
        """Send a request; return the whole answer."""
        if self._streams is None:
            self._streams = await asyncio.open_connection(self._host, self._port)
        reader, writer = self._streams
        lines = [f"{method} {target} HTTP/1.1", f"Host: {self._host}:{self._port}", "Accept: text/html"]
        if method == "POST":
            lines += [f"Content-Type: {FORM}", f"Content-Length: {len(body)}"]
        writer.write("\r\n".join([*lines, "", ""]).encode() + body)
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").split("\r\n")
        headers = {name.lower(): value.strip() for name, _, value in (line.partition(":") for line in head[1:])}
        content = await reader.readexactly(int(headers.get("content-length", "0")))
        if headers.get("connection", "").lower() == "close":
            self.close()
        return Exchange(int(head[0].split()[1]), headers, content)

    def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


Walk = Callable[[int, Callable[..., Awaitable[Exchange]]], Awaitable[None]]


class PageCrowd(NamedTuple):
    """The seconds that a crowd took, and that each of its requests took."""

    seconds: float
    waits: list[float]

    @property
    def rate(self) -> float:
        """The requests per second."""
        return len(self.waits) / self.seconds

    @property
    def p99(self) -> float:
        """The 99th percentile of a request's time, in seconds."""
        return statistics.quantiles(self.waits, n=100)[-1]


async def send_crowd(address: str, people: int, walk: Walk) -> PageCrowd:
    """Let `people` participants walk at once, each on their own connection. Raises TimeoutError after SECONDS."""
    waits: list[float] = []

    async def person(number: int) -> None:
        connection = KeptConnection(address)

        async def ask(method: str, target: str, body: bytes = b"") -> Exchange:
            begun = time.perf_counter()
            answer = await connection.ask(method, target, body)
            waits.append(time.perf_counter() - begun)
            return answer

        try:
            await walk(number, ask)
        finally:
            connection.close()

    begun = time.perf_counter()
    async with asyncio.timeout(SECONDS):
        await asyncio.gather(*(person(number) for number in range(people)))
    return PageCrowd(time.perf_counter() - begun, waits)


async def through_the_study(number: int, ask: Callable[..., Awaitable[Exchange]]) -> None:
    """Go through the study as a browser does, to the last page. Raises RuntimeError for an unexpected status."""
    target = f"/next?projectId=crowd&userId=P{number}"
    fields: Mapping[str, object]
    for fields in [*ANSWERS.values(), {}]:
        found = await ask("GET", target)
        page = found.body.decode()
        if found.status != 200:
            raise RuntimeError(f"a page was answered with {found.status}: {page[:200]}")
        if not fields:
            if "hippodrome-ticket" in page:
                raise RuntimeError("a participant did not come to the end")
            return
        posted = await ask("POST", target, urlencode({**hidden(page), **fields}).encode())
        if posted.status != 303:
            raise RuntimeError(f"a form was answered with {posted.status}")


async def hello(number: int, ask: Callable[..., Awaitable[Exchange]]) -> None:
    """Send as many requests as a participant does, for the server of `HELLO`."""
    for _ in ANSWERS:
        await ask("GET", f"/?{number}")
        await ask("POST", f"/?{number}", b"x=1")
    await ask("GET", f"/?{number}")


HELLO = """
import asyncio, socket, uvicorn
async def app(scope, receive, send):
    while (await receive()).get("more_body"):
        pass
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"5")]})
    await send({"type": "http.response.body", "body": b"hello"})
listener = socket.create_server(("127.0.0.1", 0), backlog=1024)
print(f"http://127.0.0.1:{listener.getsockname()[1]}/", flush=True)
config = uvicorn.Config(app, lifespan="off", access_log=False, log_level="error", ws="none")
asyncio.run(uvicorn.Server(config).serve([listener]))
"""


@contextlib.contextmanager
def serving(command: list[str], cwd: Path) -> Iterator[str]:
    """Run a server in a process of its own within the block; give the first address that it prints."""
    env = {**os.environ, "PYTHONUNBUFFERED": "1", "COLUMNS": "200", "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(command, cwd=cwd, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    try:
        assert process.stdout is not None
        output = ""
        while not (address := re.search(r"http://127\.0\.0\.1:\d+/", output)):
            line = process.stdout.readline()
            if not line:
                raise RuntimeError(f"the server did not start: {output}")
            output += line
        threading.Thread(target=process.stdout.read, daemon=True).start()  # so that the pipe never fills
        yield address[0]
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(15)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def project_without_game(folder: Path) -> None:
    """Write a project with the example project's pages but without its game."""
    (folder / "steps").mkdir()
    for file in (ROOT / "steps").glob("*.html"):
        (folder / "steps" / file.name).write_bytes(file.read_bytes())
    (folder / "config.yml").write_text(
        "project:\n  id: crowd\n  live: true\n  steps:\n"
        "    1: consent\n    2: questionnaire\n    3: survey\n    finalStep: debrief\n"
    )


def crowd() -> Iterator[Row]:
    """Measure many participants at once on the step pages of `python -m local`, beside a server that answers hello."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        project_without_game(folder)
        command = [sys.executable, "-m", "local", ".", "--port", "0"]
        with serving(command, folder) as address:
            asyncio.run(send_crowd(address, 1, lambda _, ask: through_the_study(-1, ask)))
            ours = asyncio.run(send_crowd(address, PEOPLE, through_the_study))
        stored = len(list(folder.glob("data/crowd/users/*/answers/*.json")))
        with serving([sys.executable, "-c", HELLO], folder) as address:
            asyncio.run(send_crowd(address, 1, hello))
            theirs = asyncio.run(send_crowd(address, PEOPLE, hello))
    if len(ours.waits) != len(theirs.waits) or stored != (PEOPLE + 1) * len(ANSWERS):
        raise RuntimeError(f"{stored} answers are stored after {len(ours.waits)} requests")
    detail = {
        "requests": f"{len(ours.waits)} in {ours.seconds:.2f} s; hello: {len(theirs.waits)} in {theirs.seconds:.2f} s",
        "the client": "one process beside the server; all participants begin at the same moment and never pause",
        "answers stored": f"{stored}, every one of them",
    }
    name = f"{PEOPLE} participants at once, local step pages"
    yield row(f"{name}, against hello", ours.rate, "requests/s", yardstick=theirs.rate, detail=detail)
    for kind, mine, yardstick in (
        ("p50", statistics.median(ours.waits), statistics.median(theirs.waits)),
        ("p99", ours.p99, theirs.p99),
    ):
        yield row(f"{name}, {kind} of a request, against hello", 1000 * mine, "ms", yardstick=1000 * yardstick)
