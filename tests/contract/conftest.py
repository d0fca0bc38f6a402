"""Every contract test runs once for each implementation of the ports."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from hippodrome.ports import Platform
from tests.contract.backends import Backend, local_backend, memory_backend, moto_backend


@pytest.fixture(params=["aws", "local", "memory"])
def backend(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Backend]:
    """A new installation."""
    if request.param == "aws":
        with moto_backend() as made:
            yield made
    elif request.param == "memory":
        with memory_backend() as made:
            yield made
    else:
        with local_backend(tmp_path) as made:
            yield made


@pytest.fixture
def platform(backend: Backend) -> Platform:
    return backend.platform
