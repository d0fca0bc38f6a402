"""The options with which tests start Chromium: it opens no pages and processes of its own."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import psutil
import pytest

from testing.browser import OFF, html_page


@pytest.fixture
def devtools(chromium: Any) -> Iterator[Any]:
    session = chromium.new_browser_cdp_session()
    yield session
    session.detach()


def test_a_new_window_has_one_page_and_one_process(chromium: Any, devtools: Any) -> None:
    before, context = _renderers(devtools), chromium.new_context()
    with html_page("<h1>Here</h1>") as address:
        page = context.new_page()
        page.goto(address)
        assert page.inner_text("h1") == "Here"
        found = devtools.send("Target.getTargets", {"filter": [{}]})["targetInfos"]
        assert [each["url"] for each in found if each["type"] == "browser_ui"] == []
        assert len(_renderers(devtools) - before) == 1
    context.close()


def test_the_disabled_features_include_those_of_playwright(chromium: Any, devtools: Any) -> None:
    (browser,) = _processes(devtools, "browser")
    lists = [each for each in psutil.Process(browser).cmdline() if each.startswith("--disable-features=")]
    theirs, ours = (each.partition("=")[2].split(",") for each in lists)
    assert ours == [*theirs, *OFF]


def _renderers(devtools: Any) -> set[int]:
    return _processes(devtools, "renderer")


def _processes(devtools: Any, kind: str) -> set[int]:
    found = devtools.send("SystemInfo.getProcessInfo")["processInfo"]
    return {each["id"] for each in found if each["type"] == kind}
