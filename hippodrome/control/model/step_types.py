"""The types of steps, and the page names of config.yml that stand for them. Pure.

A step's type follows from its page: a reserved word such as `game`, or else the name of a step file. A new type is a
row in `RESERVED`, and one file in `hippodrome/control/participants/steps/` that shows it, registered in that package.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StepType:
    """A type of step."""

    name: str
    has_files: bool  # whether it is shown from files in the steps folder: one, or one for each group
    on_server: bool  # whether it is played on a server, whose trial stores the answer; otherwise a form is posted


PAGE = StepType("page", has_files=True, on_server=False)
GAME = StepType("game", has_files=False, on_server=True)

RESERVED = {"game": GAME}
"""The types with a reserved page name, by that name in config.yml. Every other page name names a step file."""
NAMES = " or ".join(RESERVED)
"""The reserved page names, as messages to people list them."""


def type_of(page: str) -> StepType:
    """Return the type of a step with this page."""
    return RESERVED.get(page, PAGE)
