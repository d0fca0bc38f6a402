"""The types of steps: what a page name in config.yml stands for, and what follows from that. Pure.

A step's type follows from its page: a reserved word such as `game`, or else the name of a step file. A new type is a
row in `RESERVED`, and one file in `hippodrome/participants/steps/` that shows it, registered in that package.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class StepType:
    """What the control plane has to know of a type of step."""

    name: str
    has_files: bool  # shown from files in the steps folder, perhaps one for each group
    on_server: bool  # takes place on the participant's server, whose trial writes the answer; else a form is posted
    done: str  # what a log says of a participant who has done the step


PAGE = StepType("page", has_files=True, on_server=False, done="answered")
GAME = StepType("game", has_files=False, on_server=True, done="played")

RESERVED = {"game": GAME}
"""By the page name that stands for it in config.yml. Every other page name is a step file's."""
TYPES = (PAGE, *RESERVED.values())


def type_of(page: str) -> StepType:
    """The type of a step with this page."""
    return RESERVED.get(page, PAGE)
