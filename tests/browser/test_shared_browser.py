"""The one browser that all files of this folder share."""

from __future__ import annotations

import asyncio
from typing import Any

from tests.browser.conftest import SHARED_BROWSER


def test_all_files_share_one_browser(chromium: Any) -> None:
    assert chromium is SHARED_BROWSER.browser()


def test_a_browser_that_has_ended_is_started_again(chromium: Any) -> None:
    SHARED_BROWSER.browser().close()
    page = SHARED_BROWSER.browser().new_page()
    page.set_content("<h1>Here</h1>")
    assert page.inner_text("h1") == "Here"


def test_after_the_browser_ends_its_thread_can_run_another_event_loop(chromium: Any) -> None:
    SHARED_BROWSER.browser()
    SHARED_BROWSER.close()
    assert asyncio.run(asyncio.sleep(0, "run")) == "run"
