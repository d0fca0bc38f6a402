"""Checks what the pages must have if several participants play together (`project.players`)."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

from hippodrome.control.config import Config, Diagnostic, sessions
from hippodrome.control.config.folder import read_source
from hippodrome.control.config.step_files import StepFileError, open_folder
from hippodrome.control.model.matching import field_of
from hippodrome.local.check.earlier_answers import EarlierAnswers, source_of
from hippodrome.local.check.wording import short
from hippodrome.protocol.similar import did_you_mean


def check_sessions(folder: Path, config: Config) -> Iterator[Diagnostic]:
    """Yield mistakes in how participants find each other, and a remark on the page for those who find no other."""
    if not config.project.has_sessions or not config.game_steps:
        return
    try:
        pages = open_folder(folder).path
    except StepFileError:
        return
    unasked = _unasked(pages, folder, config)
    if unasked:
        yield unasked
    if config.project.after_patience == "unmatched":
        yield from _unmatched(pages, config)


def _unasked(pages: Path, folder: Path, config: Config) -> Diagnostic | None:
    """A mistake if no page before the game has the field by which people are matched. A script may make the field."""
    field = field_of(config.project.matching)
    if field is None:
        return None
    earlier = EarlierAnswers.before_the_game(pages, config)
    names, text = earlier.fields()
    if field in names or re.search(rf"""["'`]{re.escape(field)}["'`]""", text):
        return _too_alike(earlier, folder, config, field)
    there = f"; there are the fields {short(', '.join(names))}" if names else ", and none asks anything"
    message = f"no page before the game asks {short(field)}{did_you_mean(field, names) or there}"
    return read_source(folder).diagnostic(sessions.MATCHING, message)


def _too_alike(earlier: EarlierAnswers, folder: Path, config: Config, field: str) -> Diagnostic | None:
    """A mistake if players must answer differently, but the field has fewer answers than there are players."""
    choices, players = earlier.choices(field), config.project.players
    if "different" not in config.project.matching or choices is None or choices >= players:
        return None
    can = "one answer" if choices == 1 else f"{choices} different answers"
    message = (
        f"{short(field)} can have {can} only, and {players} players need different ones: no participant finds others"
    )
    return read_source(folder).diagnostic(sessions.MATCHING, message)


def _unmatched(pages: Path, config: Config) -> Iterator[Diagnostic]:
    """A remark if no page after the game tells participants who found no other from those who have played."""
    last = max(index for index, step in enumerate(config.steps) if step.type.on_server)
    after = [file for step in config.steps[last + 1 :] for file in step.files]
    if after and not any("unmatched" in source_of(file) for file in after):
        message = (
            "participants who find no other to play with come here too, without having played; "
            "{% if participant.unmatched %} … {% else %} … {% endif %} tells them apart"
        )
        yield Diagnostic(f"{pages.name}/{after[0].name}", None, "", message, remark=True)
