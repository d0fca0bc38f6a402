"""A type of step is a row in the model and a file that shows it: each row has a file, and nothing else is needed."""

from __future__ import annotations

from pathlib import Path

import pytest

from hippodrome.control import http
from hippodrome.control.config import read_project
from hippodrome.control.http import Response
from hippodrome.control.model import step_types
from hippodrome.control.model.design import Step
from hippodrome.control.model.step_types import PAGE, RESERVED, StepType
from hippodrome.control.participants import steps
from hippodrome.control.participants.forms import PostedForm
from hippodrome.control.participants.path import Stop
from hippodrome.control.participants.steps.page import PageStep
from hippodrome.control.participants.visit import Visit
from hippodrome.functions import installed as place
from hippodrome.local.check.command import check_project
from testing.studies import installed, study
from tests.control.participants.test_journey import Browser

FOLDER = Path(steps.__file__).parent


def test_every_type_has_a_handler_in_a_file_of_its_name() -> None:
    assert set(steps.HANDLERS) == {kind.name for kind in (PAGE, *RESERVED.values())}
    for name, handler in steps.HANDLERS.items():
        assert handler.__module__ == f"hippodrome.control.participants.steps.{name}"
    assert {path.stem for path in FOLDER.glob("*.py")} == {*steps.HANDLERS, "shared_game", "__init__"}


class BreakStep(PageStep):
    """A type without a file of the researcher's: it shows a sentence, and any form leads to the next step."""

    def show(self, stop: Stop) -> Response:
        return http.html(200, f"<p>Take a break, {stop.visit.user_id}.</p>", {})

    def post(self, visit: Visit, step: Step, form: PostedForm) -> None:
        super().post(visit, step, PostedForm({"rested": "yes"}))


@pytest.fixture
def with_breaks(monkeypatch: pytest.MonkeyPatch) -> None:
    """The step type `break`, registered as every type is."""
    monkeypatch.setitem(step_types.RESERVED, "break", StepType("break", has_files=False, on_server=False))
    monkeypatch.setitem(steps.HANDLERS, "break", BreakStep)  # type: ignore[arg-type]


@pytest.mark.usefixtures("with_breaks")
def test_a_new_type_is_shown_and_answered_like_any_other() -> None:
    project = study(steps=[Step("1", "break"), Step("2", "questionnaire"), Step("finalStep", "debrief")])
    platform = installed(project)
    try:
        browser = Browser(platform)
        assert browser.get() == "<p>Take a break, alice.</p>"
        browser.post(**{"hippodrome-step": "1"})
        assert "Age" in browser.get()
    finally:
        place.use(None)
    assert b'"rested"' in platform.documents.kept["maze/users/alice/answers/1.json"][0]


def write_study(folder: Path) -> Path:
    """Write a break, a page that mentions an earlier answer, and the end."""
    (folder / "steps").mkdir()
    (folder / "steps" / "more.html").write_text('<label>Why? <input name="why"></label>{{ answers["1"] }}')
    (folder / "steps" / "thanks.html").write_text("<p>Thank you.</p>")
    steps = "    1: break\n    2: more\n    3: break\n    finalStep: thanks\n"
    (folder / "config.yml").write_text(f"project:\n  id: rest\n  steps:\n{steps}")
    return folder


@pytest.mark.usefixtures("with_breaks")
def test_make_check_knows_a_type_without_files(tmp_path: Path) -> None:
    folder = write_study(tmp_path)
    assert [str(one) for one in check_project(folder, read_project(folder)) if not one.remark] == []


@pytest.mark.usefixtures("with_breaks")
def test_a_new_type_needs_no_step_file(tmp_path: Path) -> None:
    (tmp_path / "steps").mkdir()
    (tmp_path / "steps" / "thanks.html").write_text("<p>Thank you.</p>")
    (tmp_path / "config.yml").write_text("project:\n  id: rest\n  steps:\n    1: break\n    finalStep: thanks\n")
    found = read_project(tmp_path)
    assert [(step.page, len(step.files), step.type.name) for step in found.steps] == [
        ("break", 0, "break"),
        ("thanks", 1, "page"),
    ]
