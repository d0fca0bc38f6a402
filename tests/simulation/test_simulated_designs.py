"""Studies with a design on a simulated AWS, with a fault at any call.

Nobody is assigned twice or differently, or counted twice; nobody is asked after an end, or stuck; no server runs on for
those who have ended; and what was stored when a page came never changes (`testing/simulation/design_checks.py`).
"""

from __future__ import annotations

import json
from typing import Any

import pytest

from hippodrome.control.model import balance
from hippodrome.control.model.participant import end_key
from hippodrome.control.participants import path
from testing.exploration import sample_of_each
from testing.simulation import faults
from tests.simulation.explored import assert_no_fault_does_harm

SEED = 7
NAMED = {journey.name: journey for journey in faults.JOURNEYS_OF_DESIGNS}


@pytest.mark.parametrize("name", NAMED)
def test_everybody_reaches_their_end(name: str) -> None:
    journey = NAMED[name]
    world, outcome = faults.run(journey, SEED)
    assert outcome.well, outcome
    ends = [end_of(world.platform.documents.kept, visit) for visit in (outcome.visit, *outcome.others)]
    assert ends == [*journey.ends, *[None] * (len(ends) - len(journey.ends))], outcome


def end_of(documents: Any, visit: faults.SimulatedVisit) -> str | None:
    """The end that a participant has reached; None for the last step."""
    found = documents.get(end_key("study", visit.user))
    return json.loads(found[0])["end"] if found else None if visit.finished is not None else visit.reason


@pytest.mark.explores
@pytest.mark.timeout(600)
@pytest.mark.parametrize("name", NAMED)
def test_a_fault_at_any_call_harms_nobody(name: str) -> None:
    assert_no_fault_does_harm(NAMED[name], SEED, tried=24)


# The exploration notices damage


def harm(name: str) -> str:
    """What is wrong after some faults of the journey."""
    points = sample_of_each(faults.points(NAMED[name], SEED), 20, lambda point: point.fault)
    return " ".join(sentence for point in points for sentence in faults.run(NAMED[name], SEED, point)[1].wrong)


def test_it_notices_who_is_drawn_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    draw = balance.Cells.draw
    monkeypatch.setattr(balance.Cells, "draw", lambda cells, *rest: draw(cells.without(rest[1]), *rest))
    assert "drawn" in harm("games are repeated, in two tabs")


def test_it_notices_a_server_that_runs_on_after_an_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(path, "publish_stop", lambda *_: None)
    assert "ran on after the end" in harm("somebody is tired of the games")
