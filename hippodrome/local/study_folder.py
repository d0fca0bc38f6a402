"""The folder that commands on this machine are given: it must hold a study."""

from __future__ import annotations

from pathlib import Path

from hippodrome.console.problem import Problem
from hippodrome.control.config import ConfigErrors, layout


def must_hold_study(folder: Path) -> None:
    """Raise `Problem` if the folder has no config.yml. Otherwise `run` and `try` would make a mistyped folder."""
    if layout.has_config(folder):
        return
    why, elsewhere = "it has no config.yml", ""
    try:
        layout.find(folder)
    except ConfigErrors as errors:
        message = errors.diagnostics[0].message
        if folder.is_dir():
            elsewhere = message.partition("; ")[2]  # the folder App of a clone of HIPPO Gym was named
        else:
            why = message
    raise Problem(
        f"There is no study in {'this folder' if folder == Path() else folder}: {why}.",
        f"{elsewhere[:1].upper()}{elsewhere[1:]}."
        if elsewhere
        else "Name a study's folder, or make one: `hippodrome new` lists the templates.",
    )
