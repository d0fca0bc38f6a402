"""Shows the game page in a real Chromium, with a trial server but without a control plane. Everything is on loopback."""

from __future__ import annotations

import contextlib
import json
import shutil
import threading
from collections.abc import Iterator, Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.participants import pages

NO_CHROMIUM = "there is no Chromium on this machine; to measure this row: apt-get install chromium"
# The features that Playwright 1.65 itself disables. Chromium takes only the last of two lists, so ours repeats them.
PLAYWRIGHT_OFF = (
    "AvoidUnnecessaryBeforeUnloadCheckSync",
    "DestroyProfileOnBrowserClose",
    "HttpsUpgrades",
    "HttpsFirstBalancedModeAutoEnable",
    "LensOverlay",
    "MediaRouter",
    "PaintHolding",
    "ThirdPartyStoragePartitioning",
    "AvoidCorsURLLoaderRestartOnRedirect",
    "TcpPortRandomizationWin",
    "OptimizationHints",
    "NetworkTimeServiceQuerying",
    "AimEnabled",
    "PreconnectToSearch",
    "msForceBrowserSignIn",
    "msEdgeUpdateLaunchServicesPreferredVersion",
)
# Two pages of the browser's own below the address bar, which took twice as long to load as the page of each new window;
# and a process that is started ahead for the next page.
OFF = ("WebUIOmniboxPopup", "WebUIOmniboxAimPopup", "SpareRendererForSitePerProcess")
ARGUMENTS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    f"--disable-features={','.join((*PLAYWRIGHT_OFF, *OFF))}",
)


class NoChromium(Exception):
    """There is no Chromium on this machine; the message says how to install it."""


def chromium_path() -> str:
    """Return the path of Chromium: where Debian installs it, or else from PATH. Raises NoChromium."""
    path = "/usr/bin/chromium" if Path("/usr/bin/chromium").exists() else shutil.which("chromium")
    if path is None:
        raise NoChromium(NO_CHROMIUM)
    return path


def headless_path() -> str:
    """Return the path of Chromium without windows, which shows the same pages for less, if Debian has installed it; else of Chromium.

    It has no cache of pages that one comes back to. Raises NoChromium.
    """
    path = Path("/usr/bin/chromium-headless-shell")
    return str(path) if path.exists() else chromium_path()


@contextlib.contextmanager
def chromium() -> Iterator[Any]:
    """Run Chromium without a window within the block, as a Browser of Playwright. Raises NoChromium."""
    path = chromium_path()
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(ARGUMENTS))
        try:
            yield browser
        finally:
            browser.close()


@contextlib.contextmanager
def game_page(
    url: str, *, user: str, token: str, step: str = "1", trial: Mapping[str, Any] | None = None, players: int = 1
) -> Iterator[str]:
    """Serve the game page for the trial server at `url` within the block; give the page's address.

    `trial` is the section of the project. With `players` more than 1, `user` is a member of a full session.
    """
    state = {"state": "ready", "seconds": 0, "attempt": 1, "url": url, "userId": user, "token": token}
    if players > 1:
        state |= {"session": True, "players": players, "members": players}
    game = Step(step, "game")
    project = Project(id="bench", name="Bench", steps=[game], researcher="Bench", trial=trial or {}, players=players)
    view = pages.GameView(project, game, user, state, "/?poll=1", "/", "", "ws://127.0.0.1:*")
    page = pages.game_page(view)
    with html_page(page.html, page.headers, {"/?poll=1": json.dumps(state)}) as address:
        yield address


@contextlib.contextmanager
def html_page(html: str, headers: dict[str, str] | None = None, answers: dict[str, str] | None = None) -> Iterator[str]:
    """Serve this page within the block; give its address. `answers` are JSON documents by the paths that have them."""

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, *_: Any) -> None:
            pass

        def do_GET(self) -> None:
            answer = (answers or {}).get(self.path)
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8" if answer is None else "application/json")
            for name, value in (headers or {}).items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write((html if answer is None else answer).encode())

    web = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    threading.Thread(target=web.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{web.server_port}/"
    finally:
        web.shutdown()
        web.server_close()
