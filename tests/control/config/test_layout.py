"""The files of a project folder are found beside config.yml, and in the places of a clone of HIPPO Gym."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from hippodrome.control.config import ConfigErrors, layout, read_project, remarks
from tests.control.config.folder import SMALL

APPS = ("App", "src/hippogym_app")


def put(file: Path, text: str = "") -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text)
    return file


@pytest.fixture
def clone(folder: Path) -> Path:
    """A project folder without an agent."""
    put(folder / "config.yml", SMALL)
    return folder


@pytest.mark.parametrize("app", ["", *APPS])
def test_the_agent_is_found(clone: Path, app: str) -> None:
    agent = put(clone / app / "agent.py")
    found = layout.find(clone)
    assert (found.agent, found.agent_folder, found.label(agent)) == (agent, clone / app, f"{app}/agent.py".lstrip("/"))
    assert layout.agent_folder(clone) == clone / app
    assert read_project(clone).remarks == ()


def test_without_an_agent_the_project_is_its_own_folder(clone: Path) -> None:
    assert (layout.find(clone).agent, layout.find(clone).agent_folder) == (None, clone)
    assert read_project(clone).project.id == "small"


@pytest.mark.parametrize("name", ["steps", "StepFiles", "Steps"])
@pytest.mark.parametrize("place", ["", *APPS])
def test_the_pages_are_found(clone: Path, name: str, place: str) -> None:
    (clone / place).mkdir(parents=True, exist_ok=True)
    (clone / "steps").rename(clone / place / name)
    assert layout.find(clone).pages == clone / place / name
    assert read_project(clone).steps[0].files == (clone / place / name / "consent.html",)


@pytest.mark.parametrize("app", APPS)
def test_the_configuration_may_lie_beside_the_agent(clone: Path, app: str) -> None:
    put(clone / app / "agent.py")
    (clone / "config.yml").rename(clone / app / "config.yml")
    assert layout.has_config(clone)
    assert read_project(clone).project.id == "small"
    put(clone / app / "config.yml", SMALL + "  maxEpisodes: many\n")
    with pytest.raises(ConfigErrors, match=rf"^{app}/config\.yml:9: trial\.maxEpisodes: must be"):
        read_project(clone)


def test_the_configuration_of_the_folder_itself_counts_before_that_beside_the_agent(clone: Path) -> None:
    put(clone / "App/config.yml", SMALL.replace("small", "other"))
    assert read_project(clone).project.id == "small"


@pytest.mark.parametrize("place", ["", "App"])
def test_requirements_are_found(clone: Path, place: str) -> None:
    put(clone / "App/agent.py")
    assert layout.find(clone).requirements is None
    file = put(clone / place / "requirements.txt")
    assert layout.find(clone).requirements == file


def test_an_agent_that_is_not_used_gets_a_remark(clone: Path) -> None:
    put(clone / "agent.py")
    put(clone / "App/agent.py")
    assert [str(remark) for remark in read_project(clone).remarks] == [
        "App/agent.py: remark: not used, since there is an agent.py beside config.yml too; keep one of them"
    ]


# An agent that exists is never left out without a message


def refused(project: Path) -> str:
    with pytest.raises(ConfigErrors) as caught:
        read_project(project)
    return str(caught.value)


@pytest.mark.parametrize("app", APPS)
def test_an_agent_in_a_folder_of_its_own_is_refused(clone: Path, app: str) -> None:
    put(clone / app / "agents/agent.py")
    assert refused(clone) == (
        f"{app}/agents/agent.py: not found by servers there; put it into {app}/ itself, with the modules that it imports"
    )


@pytest.mark.parametrize(
    "line", ["from optionAgent import OptionAgent", "import optionAgent", "from App.optionAgent import A"]
)
def test_a_trial_that_takes_another_agent_is_refused(clone: Path, line: str) -> None:
    put(clone / "App/agent.py")
    put(clone / "App/optionAgent.py")
    put(clone / "App/trial.py", f"import json, numpy\n{line}  # the agent\n")
    assert refused(clone) == (
        "App/trial.py: takes the agent from optionAgent.py, and Hippodrome from agent.py: give the file that name, and its "
        "class the name Agent"
    )


@pytest.mark.parametrize(
    "text",
    [
        "from agent import Agent\n",
        "import agent\nfrom optionAgent import OptionAgent\n",
        "from agents_of_others import Agent\n",
        "import numpy\n",
        "def (",
    ],
)
def test_a_trial_that_takes_this_agent_or_none_is_no_mistake(clone: Path, text: str) -> None:
    put(clone / "App/agent.py")
    put(clone / "App/optionAgent.py")
    put(clone / "App/trial.py", text)
    assert read_project(clone).remarks == ()


@pytest.mark.parametrize("program", ["trial.py", "communicator.py"])
def test_an_app_folder_without_agent_is_refused(clone: Path, program: str) -> None:
    put(clone / "App" / program)
    put(clone / "App/optionAgent.py")
    assert refused(clone) == (
        "App: there is no agent.py beside HIPPO Gym's own programs; the game would be played without agent"
    )


@pytest.mark.parametrize("program", ["study.py", "examples/grid.py", "src/hippogym/trial.py", "agent.py"])
@pytest.mark.parametrize("imports", ["from hippogym import HippoGym", "import hippogym.ui_elements"])
def test_a_study_of_version_2_is_refused(clone: Path, program: str, imports: str) -> None:
    put(clone / program, imports)
    assert refused(clone) == (
        f"{program}: this is for HIPPO Gym's version 2, whose studies are programs and have no agent of our form; "
        "write an agent.py beside config.yml (docs/hippo.md#version-2)"
    )


def test_an_agent_beside_programs_of_version_2_plays(clone: Path) -> None:
    put(clone / "agent.py")
    put(clone / "study.py", "import hippogym")
    assert read_project(clone).remarks == ()


def test_an_agent_in_a_file_of_another_name_gets_a_remark(clone: Path) -> None:
    put(clone / "my_agent.py", "class Agent:\n    pass\n")
    (remark,) = read_project(clone).remarks
    assert str(remark) == (
        "my_agent.py: remark: its class Agent does not play, since Hippodrome takes the agent from agent.py: rename the file"
    )


def test_without_an_agent_and_without_a_game_nothing_could_be_played(clone: Path) -> None:
    put(
        clone / "config.yml", "project: {id: small, steps: {1: consent, 2: game, finalStep: thanks}}\ntrial:\n  game:\n"
    )
    assert refused(clone) == (
        "config.yml:3: trial.game: is empty, and there is no agent.py: name an environment, or write an agent.py"
    )
    put(clone / "agent.py")
    assert read_project(clone).trial.game == "none"


def test_a_study_without_a_game_needs_no_agent(clone: Path) -> None:
    put(clone / "App/trial.py")
    put(clone / "config.yml", "project: {id: paper, steps: {1: consent, 2: thanks}}")
    assert read_project(clone).project.id == "paper"


# Folders that are no project folders


def test_the_message_for_the_app_folder_names_the_folder_above(clone: Path) -> None:
    put(clone / "App/agent.py")
    assert refused(clone / "App") == (
        f"config.yml: there is no such file in {clone / 'App'}; name the folder {clone}, which has it"
    )


def test_a_missing_folder_has_no_files(clone: Path) -> None:
    shutil.rmtree(clone)
    assert (layout.agent_folder(clone), layout.pages_folder(clone), layout.has_config(clone)) == (clone, None, False)
    with pytest.raises(ConfigErrors, match="there is no such folder"):
        layout.find(clone)


@pytest.mark.skipif(os.geteuid() == 0, reason="the administrator may read everything")
def test_a_folder_of_pages_that_cannot_be_read_gets_a_message(clone: Path) -> None:
    (clone / "steps").chmod(0)
    try:
        assert "the folder steps cannot be read" in refused(clone)
    finally:
        (clone / "steps").chmod(0o700)


def remarks_on_recordings(clone: Path, config: str) -> list[str]:
    (clone / "config.yml").write_text(config)
    found = remarks.remarks_on(clone, read_project(clone))
    return [str(remark) for remark in found if "recordObservations" in str(remark)]


def test_in_a_clone_recordings_without_observations_get_a_remark(clone: Path) -> None:
    put(clone / "App" / "agent.py")
    assert remarks_on_recordings(clone, SMALL) == [
        "config.yml:7: remark: trial: recordObservations is not given: recordings hold no observations, which HIPPO Gym "
        "saved; write recordObservations: true to have them, or false"
    ]


@pytest.mark.parametrize("key", ["recordObservations: true", "recordObservations: false", "s3upload: false"])
def test_recordings_get_no_remark_if_the_configuration_says_what_they_hold(clone: Path, key: str) -> None:
    put(clone / "App" / "agent.py")
    assert remarks_on_recordings(clone, f"{SMALL.rstrip()}\n  {key}\n") == []


def test_recordings_get_no_remark_in_a_project_that_was_written_for_hippodrome(clone: Path) -> None:
    put(clone / "agent.py")
    assert remarks_on_recordings(clone, SMALL) == []
