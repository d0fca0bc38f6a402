"""What the bench measures in a browser is there; how much it is, is not judged here."""

from __future__ import annotations

from typing import Any

import pytest

from bench import seen

pytestmark = [pytest.mark.browser, pytest.mark.xdist_group("browser")]


@pytest.mark.parametrize("setting", [seen.ours, seen.bare], ids=["ours", "bare"])
def test_drawn_frames_and_effects_of_keys_are_timed(
    chromium: Any, monkeypatch: pytest.MonkeyPatch, setting: Any
) -> None:
    monkeypatch.setattr(seen, "SECONDS", 1.0)
    monkeypatch.setattr(seen, "PRESSES", 3)
    found = seen.look(chromium, setting, "scrolling texture, 600 x 400", (30,), 30)
    assert len(found.waits) == 6
    assert all(0 < wait < seen.PATIENCE for wait in found.waits)
    assert 0 < found.share[30] <= 1.1
    assert found.gaps[30] > 0
    assert found.cpu[30] >= 0
