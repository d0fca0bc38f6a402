"""Shows each type of step (`control/model/step_types.py`), and handles the forms sent there: one file per type."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

from hippodrome.control.http import Response
from hippodrome.control.model.design import Step
from hippodrome.control.participants.forms import PostedForm
from hippodrome.control.participants.path import Stop
from hippodrome.control.participants.services import Services
from hippodrome.control.participants.steps.game import GameStep
from hippodrome.control.participants.steps.page import PageStep
from hippodrome.control.participants.visit import Visit


class StepHandler(Protocol):
    """Handles the requests at steps of one type."""

    def show(self, stop: Stop) -> Response:
        """Return the response to a GET. Raises `PageError` if the step cannot be shown."""

    def post(self, visit: Visit, step: Step, form: PostedForm) -> None:
        """Handle a form that the participant may send at this step."""


HANDLERS: Mapping[str, Callable[[Services], StepHandler]] = {"page": PageStep, "game": GameStep}
"""The handler of each type of step, by the type's name."""
