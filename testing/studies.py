"""Small studies for tests."""

from __future__ import annotations

import msgspec

from hippodrome.control.model.design import Step
from hippodrome.control.model.project import MASTER_LIST, AwsSetup, Events, MasterList, Project, step_key
from hippodrome.control.model.records import to_json
from hippodrome.control.storage.secret import KEY, Secret
from testing.fake_platform import FakePlatform

INSTALLATION_SECRET = Secret("0" * 64)


def study(**changes: object) -> Project:
    """Return a project with five steps: consent (with two groups), questionnaire, game, survey, debrief.

    Its server starts at step 2 and stops at step 4. `changes` replaces fields. Its secret is derived from
    `INSTALLATION_SECRET`.
    """
    steps = [
        Step("1", "consent", 2),
        Step("2", "questionnaire"),
        Step("3", "game"),
        Step("4", "survey"),
        Step("finalStep", "debrief"),
    ]
    project = Project(
        id="maze",
        steps=steps,
        name="A maze",
        live=True,
        max_runtime=30,
        events=Events("2", "4"),
        aws_setup=AwsSetup(cpu=1, memory=2),
        trial={"game": "ALE/MsPacman-v5"},
        salt="salt",
    )
    project = msgspec.structs.replace(project, **changes)
    return msgspec.structs.replace(project, secret=INSTALLATION_SECRET.project_secret(project))


SECRET = study().secret


PAGES = {
    "consent-0": "<p>Do you agree?</p><button name='consent' value='yes'>I agree</button>",
    "consent-1": "<p>May we?</p><button name='consent' value='yes'>You may</button>",
    "questionnaire": "<label>Age <input name='age' type='number'></label><input type='checkbox' name='pet' value='cat'>",
    "survey": "<textarea name='words'></textarea>",
    "debrief": "<p>Thank you! Your code: {{ completion_code }}</p>",
}


def installed(project: Project | None = None) -> FakePlatform:
    """Return a platform in memory that holds the project (`study()` unless given), its pages, and the secret."""
    platform = FakePlatform()
    project = project or study()
    platform.documents.keep(KEY, to_json(INSTALLATION_SECRET))
    platform.documents.keep(MASTER_LIST, to_json(MasterList([project])))
    for file, source in PAGES.items():
        platform.documents.keep(step_key(project.id, file), source.encode())
    return platform
