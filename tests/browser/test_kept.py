"""The browser that the files of this folder share."""

from __future__ import annotations

import asyncio
from typing import Any

from tests.browser.conftest import KEPT


def test_all_files_have_one_browser(chromium: Any) -> None:
    assert chromium is KEPT.browser()


def test_a_browser_that_has_ended_is_started_again(chromium: Any) -> None:
    KEPT.browser().close()
    page = KEPT.browser().new_page()
    page.set_content("<h1>Here</h1>")
    assert page.inner_text("h1") == "Here"


def test_when_it_has_ended_its_thread_can_run_another_loop(chromium: Any) -> None:
    KEPT.browser()
    KEPT.close()
    assert asyncio.run(asyncio.sleep(0, "run")) == "run"
