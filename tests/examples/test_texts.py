"""What participants read before the game of each example."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import yaml

CONFIGS = sorted((Path(__file__).resolve().parents[2] / "examples").glob("*/config.yml"))
EXAMPLES = [path.parent for path in CONFIGS if "\n  game: talk" not in path.read_text(encoding="utf-8")]
"""The examples with buttons and a score."""


def page_before_the_game(folder: Path, config: Any) -> str:
    """The text of the second page, which explains the game."""
    steps = config["project"]["steps"]
    page = steps[1] if isinstance(steps, list) else steps[2]
    return (folder / "steps" / f"{page}.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("folder", EXAMPLES, ids=lambda folder: folder.name)
def test_the_page_before_the_game_names_the_buttons_by_their_labels(folder: Path) -> None:
    """A participant on a phone has buttons, and no keys."""
    config = yaml.safe_load((folder / "config.yml").read_text(encoding="utf-8"))
    read = page_before_the_game(folder, config)
    assert "button" in read
    assert [label for label in config["trial"].get("labels", {}).values() if label not in read] == []


@pytest.mark.parametrize("folder", EXAMPLES, ids=lambda folder: folder.name)
def test_the_page_before_the_game_mentions_the_score(folder: Path) -> None:
    config = yaml.safe_load((folder / "config.yml").read_text(encoding="utf-8"))
    read = page_before_the_game(folder, config)
    assert "score" in read.lower()
