"""Fixtures: one server of environments for all tests that leave it as it is, and its clients."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from testing.gym_server import GymServerProcess, TextClient, gym_server

HERE = Path(__file__).parent


@pytest.fixture(scope="session")
def server() -> Iterator[GymServerProcess]:
    """A server with the environments of `odd_environments.py`, and limits that a test can reach."""
    limits = ("--seconds", "2", "--processes", "4", "--megabytes", "300")
    with gym_server("--import", "odd_environments", *limits, cwd=HERE) as found:
        yield found


@pytest.fixture
def client(server: GymServerProcess) -> Iterator[TextClient]:
    """A client as Gymie's: it names no subprotocol and no form."""
    with TextClient(server.url) as found:
        yield found


@pytest.fixture
def asking(server: GymServerProcess) -> Iterator[TextClient]:
    """A client that asks for Gymnasium's form; errors are answers, and the connection stays."""
    with TextClient(server.url + "?form=gymnasium") as found:
        yield found
