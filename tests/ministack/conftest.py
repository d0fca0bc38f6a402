"""One account on ministack for all tests of this folder; they run in one worker, one after another."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.ministack.world import World, find_venv


@pytest.fixture(scope="session")
def world(tmp_path_factory: pytest.TempPathFactory) -> Iterator[World]:
    """The account, with a hosted zone for example.org and nothing else."""
    venv = find_venv()
    if venv is None:
        why = "ministack is not installed: `make test` makes .venv-ministack, or set MINISTACK_VENV to an environment with it"
        if os.environ.get("REQUIRE_MINISTACK"):
            pytest.fail(why)
        pytest.skip(why)
    with World(venv, tmp_path_factory.mktemp("ministack")) as made:
        yield made
