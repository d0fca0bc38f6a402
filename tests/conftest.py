"""What all tests share."""

from __future__ import annotations

import functools
import io
from collections.abc import Iterator
from typing import Any

import botocore.loaders
import pytest

from tests import hunting

ONE_AFTER_ANOTHER = ("tests/browser/", "tests/certificate/", "tests/ministack/")


# Every session of botocore parses the models of the services again, which took half of the tests' time on moto.
# A loader only reads files of the installed package, so that one can serve all sessions of a process.
botocore.loaders.create_loader = functools.cache(botocore.loaders.create_loader)

hunting.load_profile()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """`make test` leaves out what is marked `hunt`; `make hunt` takes only what explores further there."""

    def wanted(item: pytest.Item) -> bool:
        if not hunting.TIMES:
            return item.get_closest_marker("hunt") is None
        explores = any(item.get_closest_marker(name) for name in ("hunt", "explores"))
        return explores or bool(getattr(getattr(item, "obj", None), "is_hypothesis_test", False))

    left_out = [item for item in items if not wanted(item)]
    items[:] = [item for item in items if wanted(item)]
    config.hook.pytest_deselected(items=left_out)


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
def pages(monkeypatch: pytest.MonkeyPatch) -> int:
    """Let moto's S3 list `hunting.PAGE` keys at a time, so that a test sees several pages of few documents."""
    monkeypatch.setenv("MOTO_S3_DEFAULT_MAX_KEYS", str(hunting.PAGE))
    return hunting.PAGE


@pytest.fixture
def log() -> Iterator[io.StringIO]:
    """Everything the functions log during a test, as it would reach CloudWatch."""
    from hippodrome.log import logger

    handler = logger.registered_handler
    text = io.StringIO()
    before = handler.setStream(text)  # type: ignore[attr-defined]
    yield text
    handler.setStream(before)  # type: ignore[attr-defined]
