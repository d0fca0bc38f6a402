"""Fixtures, hooks and settings of all tests."""

from __future__ import annotations

import gc
import io
import os
import shutil
import signal
import socketserver
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from _pytest.unraisableexception import gc_collect_iterations_key
from werkzeug.serving import BaseWSGIServer

from testing import exploration
from tests import files_in_memory, forked_workers

TESTS = Path(__file__).resolve().parent
HUNT_TIMEOUT = 900  # seconds of a test that takes all its cases, where `make test` takes one of twelve
_STUDIES = ("examples", "german_study", "gridworld_browser", "teaching")
ONE_AFTER_ANOTHER = (
    ("tests/browser/test_together_browser.py",),
    ("tests/browser/test_study.py", *(f"tests/browser/test_{name}.py" for name in _STUDIES)),
    ("tests/browser/test_two_players_browser.py", "tests/browser/test_two_participants.py"),
    ("tests/browser/",),
    ("tests/ministack/test_installation.py", "tests/ministack/test_world.py"),
    ("tests/trial/gym/",),
    ("tests/ministack/test_first_hour.py",),
    ("tests/certificate/",),
    ("tests/deploy/code/test_build.py",),
    ("tests/bench/test_bench.py",),
    ("tests/infra/test_enforcement.py",),
)
"""Files and folders whose tests share something costly: one worker runs them. The longest are the first that begin.

Of two places that fit a test, the longer one counts.
"""
WAITING = (
    "tests/browser/",
    "tests/ministack/",
    "tests/trial/gym/",
    "tests/certificate/",
    "tests/trial/test_",
    "tests/trial/wire/",
    "tests/e2e/",
    "tests/examples/",
    "tests/trial/interactive_gym/",
    "tests/local/",
)
"""Tests that wait for processes most of the time, in the order in which they begin. They run beside the others, which compute."""
_PLACES = sorted(
    ((place, number) for number, places in enumerate(ONE_AFTER_ANOTHER) for place in places),
    key=lambda entry: -len(entry[0]),
)


gc.disable()  # until all is imported; see `pytest_collection_finish`
# A shell's background jobs inherit SIGINT as ignored, `make test` tells the commands of its tests that they are
# part of it and which Python it takes, and a shell may have a path for Python: all would change what the processes that
# tests start do.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)
for _name in ("MAKEFLAGS", "MAKELEVEL", "MFLAGS", "PYTHON", "PYTHONPATH"):
    os.environ.pop(_name, None)
exploration.load_profile()
# A server of http.server or Werkzeug that is shut down sees that when it looks next: by default twice a second.
for _server in (socketserver.BaseServer, BaseWSGIServer):
    _server.serve_forever.__defaults__ = (0.02,)


def _group(nodeid: str) -> int | None:
    return next((number for place, number in _PLACES if nodeid.startswith(place)), None)


def _turn(item: pytest.Item) -> int:
    """The rank of a test: groups that take long begin first; the many short tests fill the other workers."""
    group = _group(item.nodeid)
    return len(ONE_AFTER_ANOTHER) if group is None else group


def _in_order(items: Sequence[pytest.Item]) -> list[pytest.Item]:
    """Groups first, then tests that wait: they are not the last ones, when the machine has no more to do beside them."""
    return sorted(items, key=lambda item: (_turn(item), _waiting(item.nodeid), item.path))


def _waiting(nodeid: str) -> int:
    return next((number for number, place in enumerate(WAITING) if nodeid.startswith(place)), len(WAITING))


def _computes(nodeid: str) -> bool:
    return not nodeid.startswith(WAITING)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """`make test` leaves out what is marked `hunt`; `make hunt` takes only what explores further there."""

    def wanted(item: pytest.Item) -> bool:
        if not exploration.TIMES:
            return item.get_closest_marker("hunt") is None
        explores = any(item.get_closest_marker(name) for name in ("hunt", "explores"))
        return explores or bool(getattr(getattr(item, "obj", None), "is_hypothesis_test", False))

    left_out = [item for item in items if not wanted(item)]
    items[:] = _in_order([item for item in items if wanted(item)])
    config.hook.pytest_deselected(items=left_out)
    if exploration.TIMES:
        for item in items:
            if item.get_closest_marker("timeout") is None:
                item.add_marker(pytest.mark.timeout(HUNT_TIMEOUT))


def pytest_make_parametrize_id(config: pytest.Config, val: object, argname: str) -> str | None:
    """What is packed tells the time of packing: workers that began in different seconds would not agree on the tests."""
    if isinstance(val, bytes) and val.startswith(b"\x1f\x8b"):
        raise ValueError(f"the values of {argname} are packed: give them ids")
    return None


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Each of `ONE_AFTER_ANOTHER` is one worker's, whole; of the others a worker gets a few at a time.

    The marks `xdist_group` in them say the same, but pytest-xdist 3.8 does not see them with pytest 9.2, and says nothing
    (pytest-xdist, issue 1386).
    """
    gc.enable()  # this process collects no tests
    if config.getoption("dist") != "loadgroup":
        return None
    from tests.scheduling import InUnits

    return InUnits(config, log, _group, _computes)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes(config: pytest.Config, specs: Sequence[Any]) -> None:
    """Before the workers start, decide where their temporary files are and how they start."""
    if folder := files_in_memory.use():
        config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    forked_workers.pytest_xdist_setupnodes(config, specs)


def pytest_collection_finish(session: pytest.Session) -> None:
    """What is imported by now stays: the garbage collector need not look through it again and again (8 % of the time).

    Nor once before: what little garbage there is costs less than the half second in each worker.
    """
    gc.freeze()
    gc.enable()
    gc.set_threshold(10_000, 20, 20)


def pytest_configure(config: pytest.Config) -> None:
    """Prepare a process that runs tests; not the one that gives them to workers, which does without botocore and moto.

    Nor look for garbage when all is over: pytest would five times, and nobody reads what it finds then.
    """
    config.stash[gc_collect_iterations_key] = 0
    if hasattr(config, "workerinput") or config.getoption("dist", "no") == "no":
        from testing import memoized_aws

        memoized_aws.keep()


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish() -> None:
    """Python itself looks for garbage twice at its end, which takes each worker seconds. It need not look through what is left."""
    gc.freeze()


_BEGUN = time.monotonic()


def pytest_runtest_setup(item: pytest.Item) -> None:
    """A hunt with a time limit leaves out what it cannot begin any more, and says so."""
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
    from hippodrome.log import logger

    handler = logger.registered_handler
    text = io.StringIO()
    before, handler.stream = handler.stream, text  # setStream would flush a stream that pytest may have closed
    yield text
    handler.stream = before
