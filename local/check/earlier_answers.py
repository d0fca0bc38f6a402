"""What participants may have answered before they see a page."""

from __future__ import annotations

from pathlib import Path
from random import Random
from typing import Any

from bots import form_filling
from hippodrome.config import Config
from hippodrome.participants import fragments
from local.check import spans


class EarlierAnswers:
    """The answers of a participant who sees a page: to every question, or only to the required ones."""

    def __init__(self, folder: Path, config: Config | None, name: str) -> None:
        self._folder = folder
        steps = list(config.steps) if config else []
        in_game = [file.name for page in (config.game_pages if config else ()) for file in page.files]
        place = next(
            (
                at
                for at, step in enumerate(steps)
                if name in [file.name for file in step.files] or (step.type.on_server and name in in_game)
            ),
            0,
        )
        self._steps = steps[:place]

    def answers(self, group: int | None) -> list[dict[str, dict[str, Any]]]:
        """By step: the most that may have been answered there, and the least."""
        most: dict[str, dict[str, Any]] = {}
        least: dict[str, dict[str, Any]] = {}
        for step in self._steps:
            if step.type.on_server:
                most[step.key] = least[step.key] = dict(_PLAYED)
                continue
            if not step.files:  # a type of step without a researcher's page: no fields to answer
                most[step.key] = least[step.key] = {}
                continue
            file = step.files[(group or 0) if step.variants else 0]
            page = spans.replace(source_of(self._folder / file.name), lambda jinja: spans.MARK, *spans.JINJA)
            most[step.key], least[step.key] = _answered(page)
        return [most, least]


_PLAYED = {"episodes": 1, "score": 1.5, "frames": 100, "seconds": 3.5, "trial": "t", "outcome": "finished"}


def _answered(page: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Answers to a page: to all its questions, and to those only that must be answered."""
    found = form_filling.forms(f"<form>{fragments.prepare(page).text}</form>")
    if not found:
        return {}, {}
    controls = found[0].controls
    filled = form_filling.gathered(form_filling.fill(found[0], Random(1)))  # noqa: S311 - nothing secret
    most = {control.name: "1" for control in controls if control.name} | filled
    boxes = {control.name for control in controls if control.kind in ("checkbox", "radio")}
    needed = {control.name for control in controls if control.required}
    least = {
        name: (value if name in needed else "") for name, value in most.items() if name in needed or name not in boxes
    }
    return most, least


def source_of(path: Path) -> str:
    """The text of a page; empty if it cannot be read, which the configuration's check says."""
    try:
        return path.read_bytes().decode("utf-8", "replace")
    except OSError:
        return ""
