"""`make test` always tries the same examples of each property."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from testing import exploration


def played() -> list[str]:
    """Return the examples of one property."""
    found: list[str] = []

    @given(st.lists(st.text()))
    def look(texts: list[str]) -> None:
        found.extend(texts)

    look()
    return found


@pytest.mark.skipif(exploration.TIMES > 0, reason="the hunt plays other examples each time")
def test_examples_do_not_depend_on_what_the_process_has_loaded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = played()
    file = tmp_path / "loaded_later.py"
    file.write_text("".join(f'A{number} = "constant {number}"\n' for number in range(500)))
    spec = importlib.util.spec_from_file_location("loaded_later", file)
    assert spec is not None
    monkeypatch.setitem(sys.modules, "loaded_later", importlib.util.module_from_spec(spec))
    assert len(before) > 100
    assert played() == before
