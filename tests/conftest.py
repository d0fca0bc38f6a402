"""What all tests share."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import pytest

ONE_AFTER_ANOTHER = ("tests/browser/", "tests/certificate/", "tests/ministack/")


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Folders whose tests share something costly are one worker's, whole.

    The marks `xdist_group` in them say the same, but pytest-xdist 3.8 does not see them with pytest 9.2, and says nothing
    (pytest-xdist, issue 1386).
    """
    if config.getoption("dist") != "loadgroup":
        return None
    from xdist.scheduler import LoadGroupScheduling

    class ByFolder(LoadGroupScheduling):
        def _split_scope(self, nodeid: str) -> str:
            found = [folder for folder in ONE_AFTER_ANOTHER if nodeid.startswith(folder)]
            return found[0] if found else super()._split_scope(nodeid)

    return ByFolder(config, log)


@pytest.fixture
def log() -> Iterator[io.StringIO]:
    """Everything the functions log during a test, as it would reach CloudWatch."""
    from hippodrome.log import logger

    handler = logger.registered_handler
    text = io.StringIO()
    before = handler.setStream(text)  # type: ignore[attr-defined]
    yield text
    handler.setStream(before)  # type: ignore[attr-defined]
