"""One account on ministack for all tests of this folder; they run in one worker, one after another."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from testing.ministack.world import MinistackWorld, find_venv, fits

_worlds: list[MinistackWorld] = []


def emulated() -> Path:
    """Where ministack is installed. Skips the test if it is not."""
    venv = find_venv()
    why = ""
    if venv is None:
        why = "ministack is not installed: `make test` makes .venv-ministack, or set MINISTACK_VENV to where it is"
    elif not fits(venv):
        why = f"the Python of {venv} is of another version than that of the tests, with which the functions are packed"
    if why:
        if os.environ.get("REQUIRE_MINISTACK"):
            pytest.fail(why)
        pytest.skip(why)
    assert venv
    return venv


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[MinistackWorld]:
    """The account, with a hosted zone and nothing else."""
    with MinistackWorld(emulated(), tmp_path_factory.mktemp("ministack")) as made:
        _worlds.append(made)
        yield made
        _worlds.clear()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """A failed test tells what the emulator complained about."""
    outcome = yield
    report = outcome.get_result()  # type: ignore[attr-defined]
    made = _worlds[-1] if _worlds else None
    if report.failed and made is not None:
        try:
            report.sections.append(("ministack", made.complaints()))
        except Exception as error:  # noqa: BLE001 - whatever it is, the test's own failure is to be shown
            report.sections.append(("ministack", f"cannot be asked any more: {error!r}"))
