"""A lobby for the tests of this folder."""

from __future__ import annotations

import pytest

from tests.control.lobby.waiting_room import WaitingRoom


@pytest.fixture
def room() -> WaitingRoom:
    """An empty lobby of a study for two players."""
    return WaitingRoom()
