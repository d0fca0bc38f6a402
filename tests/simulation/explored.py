"""Faults at the calls of a journey, with and without the mechanisms that repair them."""

from __future__ import annotations

import pytest

from testing.exploration import sample_of_each
from testing.simulation import faults
from testing.simulation.faults import SimulatedJourney
from testing.simulation.world import SimulatedWorld

MANY = 5_000  # points; a journey of a day has more, mostly in the sweeps of a night


def assert_no_fault_does_harm(journey: SimulatedJourney, seed: int, tried: int | None = None) -> None:
    """Run the journey with each kind of fault at one of `tried` calls: each run must end well.

    Without a number, at one of 300 calls, and of more than 600 calls at two.
    """
    points = faults.points(journey, seed)
    assert len(points) > 100
    if len(points) > MANY:
        points = points[::29]  # 29: no number of kinds of faults divides it
    tried = tried or max(300, len(points) // len(faults.FAULTS) // 2)
    outcomes = [
        faults.run(journey, seed, point)[1] for point in sample_of_each(points, tried, lambda point: point.fault)
    ]
    assert all("crash" in outcome.story or "reply lost" in outcome.story for outcome in outcomes)
    bad = [outcome for outcome in outcomes if not outcome.well]
    assert not bad, f"{len(bad)} of {len(outcomes)}; the first: {bad[0]}"


def assert_faults_do_harm_without_repair(journey: SimulatedJourney, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that the exploration notices damage: the same faults, without the sweep and without a second delivery."""
    monkeypatch.setattr(SimulatedWorld, "_sweep", lambda world: None)
    monkeypatch.setattr(SimulatedWorld, "RECEIVES", 1)
    assert any(not outcome.well for outcome in faults.explore(journey, seed))
