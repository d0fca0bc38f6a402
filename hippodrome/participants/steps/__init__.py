"""How each type of step (`hippodrome/model/step_types.py`) is shown, and what a form does there: one file per type."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from hippodrome.http import Response
from hippodrome.model.project import Project, Step
from hippodrome.participants.forms import PostedForm
from hippodrome.participants.steps.game import GameStep
from hippodrome.participants.steps.page import PageStep
from hippodrome.participants.steps.services import StepServices
from hippodrome.participants.steps.visit import Visit


class StepHandler(Protocol):
    """One type of step."""

    def show(self, visit: Visit) -> Response:
        """Return the response to a GET. Raises `PageError` if the step cannot be shown."""

    def post(self, project: Project, user_id: str, step: Step, form: PostedForm) -> None:
        """Handle a form that the participant may send at this step."""


HANDLERS: Mapping[str, Callable[[StepServices], StepHandler]] = {"page": PageStep, "game": GameStep}
"""By the name of the step's type."""
