"""Fixtures, hooks and settings of all tests."""

from __future__ import annotations

import io
import os
import signal
import sys
import time
from collections.abc import Iterator

import pytest

from testing import exploration

HUNT_TIMEOUT = 900  # seconds of a test that takes all its cases, where `make test` takes one of twelve

# A shell's background jobs inherit SIGINT as ignored, `make test` tells the commands of its tests that they are
# part of it and which Python it takes, and a shell may have a path for Python: all would change what the processes that
# tests start do.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
for _name in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS", "PYTHON", "PYTHONPATH"):
    os.environ.pop(_name, None)
os.environ["PATH"] = f"{os.path.dirname(sys.executable)}{os.pathsep}{os.environ['PATH']}"  # advice says `hippodrome …`
os.environ["MOTO_EC2_LOAD_DEFAULT_AMIS"] = "false"  # 1,000 images that no test looks at
exploration.load_profile()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """`make test` leaves out what is marked `hunt`; `make hunt` takes only what explores further there."""

    def selected(item: pytest.Item) -> bool:
        if not exploration.TIMES:
            return item.get_closest_marker("hunt") is None
        explores = any(item.get_closest_marker(name) for name in ("hunt", "explores"))
        return explores or bool(getattr(getattr(item, "obj", None), "is_hypothesis_test", False))

    config.hook.pytest_deselected(items=[item for item in items if not selected(item)])
    items[:] = [item for item in items if selected(item)]
    if exploration.TIMES:
        for item in items:
            if item.get_closest_marker("timeout") is None:
                item.add_marker(pytest.mark.timeout(HUNT_TIMEOUT))


_BEGUN = time.monotonic()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """A hunt with a time limit reports the tests that it cannot begin any more as skipped."""
    if exploration.TIMES and time.monotonic() - _BEGUN > exploration.SECONDS:
        pytest.skip(f"the hunt's {exploration.SECONDS:g} seconds are over: `make hunt` reaches it")


@pytest.fixture
def pages(monkeypatch: pytest.MonkeyPatch) -> int:
    """Let moto's S3 list `exploration.PAGE` keys at a time, so that a test sees several pages of few documents."""
    monkeypatch.setenv("MOTO_S3_DEFAULT_MAX_KEYS", str(exploration.PAGE))
    return exploration.PAGE


@pytest.fixture
def log() -> Iterator[io.StringIO]:
    """Everything the functions log during a test, as it would reach CloudWatch."""
    from hippodrome.control.log import logger

    handler = logger.registered_handler
    text = io.StringIO()
    before, handler.stream = handler.stream, text  # setStream would flush a stream that pytest may have closed
    yield text
    handler.stream = before
