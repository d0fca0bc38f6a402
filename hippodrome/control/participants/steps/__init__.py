"""Shows each type of step (`control/model/step_types.py`), and handles the forms sent there: one file per type."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from hippodrome.control.http import Response
from hippodrome.control.model.design import Step
from hippodrome.control.model.project import Project
from hippodrome.control.participants.forms import PostedForm
from hippodrome.control.participants.steps.game import GameStep
from hippodrome.control.participants.steps.page import PageStep
from hippodrome.control.participants.steps.services import StepServices
from hippodrome.control.participants.steps.visit import Visit


class StepHandler(Protocol):
    """Handles the requests at steps of one type."""

    def show(self, visit: Visit) -> Response:
        """Return the response to a GET. Raises `PageError` if the step cannot be shown."""

    def post(self, project: Project, user_id: str, step: Step, form: PostedForm) -> None:
        """Handle a form that the participant may send at this step."""


HANDLERS: Mapping[str, Callable[[StepServices], StepHandler]] = {"page": PageStep, "game": GameStep}
"""The handler of each type of step, by the type's name."""
