"""A study is registered again with any number of players: all participants get to the end, and no server is left."""

from __future__ import annotations

import pytest

from testing.exploration import sample
from tests.simulation.registered_again import World

NOTHING: list[str] = []
FOUND = {43, 85, 264}
"""Seeds that have found mistakes: two tabs, one made for one player and one for several; a list older than the lobby."""


@pytest.mark.explores
@pytest.mark.parametrize("seed", sorted({*sample(range(1_000), 25), *FOUND}))
def test_all_participants_get_to_the_end_and_no_server_is_left(seed: int) -> None:
    world = World(seed)
    world.happens(steps=(20, 60, 150)[seed % 3])
    world.end()
    members = world.members()
    assert len(members) == len(set(members)), "somebody plays in two sessions"
    assert world.left_over() == NOTHING
