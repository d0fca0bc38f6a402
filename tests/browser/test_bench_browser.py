"""The bench's measurements in a browser yield values of the right kind; their size is not judged here."""

from __future__ import annotations

from typing import Any

import pytest

from bench import pictures, scenes, seen

pytestmark = pytest.mark.browser


@pytest.fixture(autouse=True)
def patience(monkeypatch: pytest.MonkeyPatch) -> None:
    """A busy machine may take longer than the bench waits for a page: here, that is no failure."""
    monkeypatch.setattr(seen, "PATIENCE", 60_000)
    monkeypatch.setenv("STALLED_SECONDS", "60")


def test_the_bench_has_agents_for_every_kind_of_picture() -> None:
    assert list(seen.AGENTS) == list(seen.LEFT) == list(pictures.KINDS)


@pytest.mark.parametrize("picture", ["CartPole, 600 x 400", "scrolling texture, 600 x 400"])
@pytest.mark.parametrize(
    ("setting", "seconds"),
    [(seen.ours, 1.0), (seen.bare, 4.0)],  # longer, because `bare` first makes up for pictures that it was late with
    ids=["ours", "bare"],
)
def test_drawn_frames_and_effects_of_keys_are_timed(
    chromium: Any, monkeypatch: pytest.MonkeyPatch, setting: Any, seconds: float, picture: str
) -> None:
    monkeypatch.setattr(pictures, "FRAMES", 8)
    monkeypatch.setattr(seen, "SECONDS", seconds)
    monkeypatch.setattr(seen, "PRESSES", 3)
    found = seen.look(chromium, setting, picture, (15,), 15)
    assert len(found.waits) == 6
    assert all(0 < wait < seen.PATIENCE for wait in found.waits)
    assert found.share[15] > 0
    assert found.since_opened[15] <= 1.1, "each picture counts once"
    assert found.gaps[15] > 0
    assert found.cpu[15] >= 0


@pytest.mark.parametrize("objects", [True, False], ids=["objects", "frames"])
def test_scenes_and_effects_of_keys_are_timed(chromium: Any, monkeypatch: pytest.MonkeyPatch, objects: bool) -> None:
    monkeypatch.setattr(seen, "SECONDS", 1.0)
    monkeypatch.setattr(seen, "PRESSES", 3)
    found = scenes.look(chromium, objects=objects)
    assert len(found.seen.waits) == 6
    assert found.seen.share[scenes.RATE] > 0
    assert found.seen.since_opened[scenes.RATE] <= 1.1, "each picture counts once"
    assert 0 < found.bytes_a_tick < 100_000
    assert 0 < found.weight < scenes.MAX_WEIGHT
