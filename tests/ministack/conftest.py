"""One account on ministack for all tests of this folder; they run in one worker, one after another."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.ministack.world import World, find_venv

_worlds: list[World] = []


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """The account, with a hosted zone and nothing else."""
    venv = find_venv()
    if venv is None:
        why = "ministack is not installed: `make test` makes .venv-ministack, or set MINISTACK_VENV to an environment with it"
        if os.environ.get("REQUIRE_MINISTACK"):
            pytest.fail(why)
        pytest.skip(why)
    with World(venv, tmp_path_factory.mktemp("ministack")) as made:
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
