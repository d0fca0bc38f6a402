"""Every contract test runs once for each implementation of the ports."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hippodrome.control.ports import Platform
from testing.moto_world import MotoWorld
from tests.contract.backends import Backend, MemoryBackend, MotoBackend, local_backend


@pytest.fixture(params=["aws", "local", "memory"])
def backend(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Backend]:
    """A new installation."""
    if request.param == "aws":
        with MotoWorld() as world:
            yield MotoBackend(world)
    elif request.param == "local":
        with local_backend(tmp_path) as made:
            yield made
    else:
        yield MemoryBackend()


@pytest.fixture
def platform(backend: Backend) -> Platform:
    return backend.platform
