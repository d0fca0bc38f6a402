"""A config.yml that HIPPO Gym accepts is accepted here, with a remark on what each key does.

The files have the form of HIPPO's template and documentation, and of studies that were held with it, in words of our own.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hippodrome.control.config import Config, parse_registration, read_project
from hippodrome.control.config.__main__ import main
from hippodrome.control.config.hippo import CLOSING_PAGE, adapt
from hippodrome.protocol.values import Plain
from tests.control.config.folder import HIPPO, SMALL, mistakes, read, small


def remarks(config: Config) -> list[str]:
    """Return the remarks, without the file's name and line."""
    return [re.sub(r"^config\.yml:\d+: remark: ", "", str(remark)) for remark in config.remarks]


def game(steps: str = "1: consent\n2: game\n3: thanks\n", **sections: str) -> str:
    return small(steps=steps, **sections)


TEMPLATE = """\
project:
  useAWS: false # set true for AWS
  awsSetup:
    bucket:
    region:
    rootDomain:
    cpu: 2
    memory: 10
  events:
    startServerStep:
    stopServerStep:
  id: # letters
  live: True
  maxRuntime: 60
  name:
  researcher:
  ssl:
    fullchain: SSL/fullchain.pem
    privkey: SSL/privkey.pem
    sslBucket:
  steps:
    1:
    2:
    3:
    finalStep:
  teamMembers:
trial:
  game: CartPole-v1
  maxEpisodes: 20
  actionSpace:
  ui:
    left: True
"""


# The unchanged template


def test_the_empty_template_is_a_study_of_the_game_and_a_closing_page(tmp_path: Path) -> None:
    project = tmp_path / "Lunar study (2)"
    project.mkdir()
    (project / "config.yml").write_text(TEMPLATE)
    found = read_project(project)
    assert found.project.id == "Lunar-study-2"
    assert [(step.key, step.page) for step in found.steps] == [("1", "game"), ("finalStep", CLOSING_PAGE)]
    assert found.steps[1].files[0].name == f"{CLOSING_PAGE}.html"
    assert "Thank you" in found.steps[1].files[0].read_text()
    assert parse_registration(found.registration())["events"] == {"startServerStep": "1", "stopServerStep": "finalStep"}
    assert [str(remark) for remark in found.remarks] == [
        'config.yml:12: remark: project.id: is empty; the project is called "Lunar-study-2" in links and folders here',
        "config.yml:21: remark: project.steps: no step has a page: participants play the game and then see a page that "
        "says that it is over; name pages to have others shown",
    ]


def test_a_missing_id_is_a_mistake_if_the_folders_name_is_no_id_either(tmp_path: Path) -> None:
    project = tmp_path / "…"
    project.mkdir()
    expected = mistakes(project, TEMPLATE)
    assert expected == [
        "config.yml:12: project.id: missing; give the project an id of letters, digits, dashes and underscores"
    ]


def test_a_study_for_aws_needs_an_id(folder: Path) -> None:
    text = SMALL.replace("id: small", "id:\n  useAWS: true\n  awsSetup: {cpu: 1, memory: 2}")
    expected = "config.yml:2: project.id: missing; give the project an id of letters, digits, dashes and underscores"
    assert mistakes(folder, text) == [expected]


def test_an_empty_size_on_aws_is_that_of_hippo(folder: Path) -> None:
    text = game(project="useAWS: true\nawsSetup:\n  cpu:\n  memory:\n")
    found = read(folder, text)
    assert (found.project.aws_setup.cpu, found.project.aws_setup.memory) == (2, 10)
    assert remarks(found) == [
        "project.awsSetup.cpu: is empty: each server has 2 vCPUs, as with HIPPO Gym",
        "project.awsSetup.memory: is empty: each server has 10 GB, as with HIPPO Gym",
    ]


@pytest.mark.parametrize("ssl", ["{sslBucket: , fullchain: a.pem, privkey: s3://x}", "{fullchain: a.pem}", "{}"])
def test_a_certificate_is_accepted_and_not_registered(folder: Path, ssl: str) -> None:
    found = read(folder, game(project=f"useAWS: true\nawsSetup: {{cpu: 1, memory: 2}}\nssl: {ssl}\n"))
    assert "ssl" not in found.registration()


def test_an_empty_live_means_an_open_study_and_gets_a_remark(folder: Path) -> None:
    found = read(folder, game(project="live:\n"))
    assert found.project.live
    assert remarks(found) == ["project.live: is empty: the study is open; HIPPO Gym took that for closed"]


# Ids


@pytest.mark.parametrize(
    ("written", "better"),
    [("my study", "my-study"), ("_pilot", "pilot"), ("a.b/c", "a-b-c"), ("Übung 1", "bung-1"), ('"__a__"', "a")],
)
def test_an_id_that_fits_no_address_is_replaced(folder: Path, written: str, better: str) -> None:
    found = read(folder, SMALL.replace("id: small", f"id: {written}"))
    assert found.project.id == better
    (expected,) = remarks(found)
    shown = written.strip('"')
    assert expected == (
        f'project.id: "{shown}" cannot stand in addresses and folders on AWS; the project is called "{better}" '
        "in links and folders here"
    )


# Steps


def test_a_page_may_be_written_with_its_folder(folder: Path) -> None:
    found = read(folder, game("1: StepFiles/consent.html\n2: game\n3: .\\thanks.html\n"))
    assert [step.page for step in found.steps] == ["consent", "game", "thanks"]
    assert remarks(found) == [
        'project.steps.1: "consent.html" is looked for in the folder of the pages itself',
        'project.steps.3: "thanks.html" is looked for in the folder of the pages itself',
    ]


def test_steps_without_a_page_are_left_out_and_events_are_renumbered(folder: Path) -> None:
    steps = "1: consent\n2:\n3: survey\n4:\n5: game\n6:\nfinalStep: thanks\n"
    found = read(folder, game(steps, project="events:\n  startServerStep: 3\n  stopServerStep: 6\n"))
    assert [(step.key, step.page) for step in found.steps] == [
        ("1", "consent"),
        ("2", "survey"),
        ("3", "game"),
        ("finalStep", "thanks"),
    ]
    assert (found.events.start_server_step, found.events.stop_server_step) == ("2", "finalStep")
    assert remarks(found) == [
        "project.steps.2: has no page: participants go on to the next step",
        "project.steps.3: counts as step 2, since one before it has no page",
        "project.steps.4: has no page: participants go on to the next step",
        "project.steps.6: has no page: participants go on to the next step",
    ]


def test_a_named_game_without_a_game_step_gets_a_remark(folder: Path) -> None:
    found = read(folder, game("1: consent\n2:\n3: thanks\n"))
    assert found.game_steps == ()
    assert remarks(found)[0] == (
        "project.steps.2: has no page: participants go on to the next step; no step is game, so no participant plays: if this one "
        "is to be, write game"
    )


def test_a_mistake_in_a_renumbered_step_has_the_line_and_number_of_the_file(folder: Path) -> None:
    text = game("1: consent\n2:\n3: surveey\n4: game\n5: thanks\n")
    assert mistakes(folder, text) == [
        "config.yml:6: project.steps.3: there is no surveey.html in steps/; did you mean survey?"
    ]


def test_a_study_with_a_final_step_only_has_one_page(folder: Path) -> None:
    found = read(folder, "project: {id: a, steps: {1: , finalStep: thanks}}")
    assert [(step.key, step.page) for step in found.steps] == [("1", "thanks")]
    assert remarks(found) == ["project.steps.finalStep: the study has this page only"]


def test_steps_that_hippo_never_shows_are_not_shown(folder: Path) -> None:
    found = read(folder, game("0: consent\n1: consent\n2: game\n3: thanks\nspare: survey\n"))
    assert [step.key for step in found.steps] == ["1", "2", "3"]
    assert remarks(found) == [
        "project.steps.0: never shown, as in HIPPO Gym",
        "project.steps.spare: never shown, as in HIPPO Gym; steps are called 1, 2, 3 … and finalStep",
    ]


def test_a_stop_step_beyond_the_end_is_the_last_step(folder: Path) -> None:
    found = read(folder, game(project="events: {startServerStep: 1, stopServerStep: '12'}\n"))
    assert found.events.stop_server_step == "3"
    assert remarks(found) == [
        "project.events.stopServerStep: there is no step 12: the server stops at the last step; with HIPPO Gym it ran "
        "until maxRuntime"
    ]


@pytest.mark.parametrize("stop", ["4", "finalStep", "3"])
def test_a_stop_step_that_exists_gets_no_remark(folder: Path, stop: str) -> None:
    found = read(folder, game(project=f"events: {{stopServerStep: {stop}}}\n"))
    assert (found.events.stop_server_step, remarks(found)) == ("3", [])


# Spellings, and keys that HIPPO's own programs add


def test_the_key_step_is_read_as_steps(folder: Path) -> None:
    found = read(folder, SMALL.replace("steps:", "step:"))
    assert [step.page for step in found.steps] == ["consent", "game", "thanks"]
    assert [str(remark) for remark in found.remarks] == ["config.yml:3: remark: project.step: read as steps"]


def test_a_mistake_under_another_spelling_has_its_line(folder: Path) -> None:
    text = SMALL.replace("steps:", "step:").replace("3: thanks", "3: thx")
    assert mistakes(folder, text) == ["config.yml:6: project.step.3: there is no thx.html in steps/"]


def test_team_members_are_team_members(folder: Path) -> None:
    found = read(folder, game(project="team_members: Ada\n"))
    assert (found.project.team_members, remarks(found)) == (("Ada",), ["project.team_members: read as teamMembers"])


def test_keys_that_updateproject_wrote_are_accepted(folder: Path) -> None:
    text = game(
        project="ecsTask: small\nbucket: lab\nawsSetup: {containerName: a, repository: a, repositoryUri: x/a}\n",
        trial="projectId: small\nbucket: lab\nui: [left, right, good]\n",
    )
    found = read(folder, text)
    shown = found.trial.document()["ui"]
    assert [name for name, there in shown.items() if there] == ["left", "right", "good"]
    assert [line.partition(";")[0] for line in remarks(found)] == [
        f"{key}: no effect"
        for key in (
            "project.ecsTask",
            "project.bucket",
            "project.awsSetup.containerName",
            "project.awsSetup.repository",
            "project.awsSetup.repositoryUri",
            "trial.projectId",
            "trial.bucket",
        )
    ]
    assert found.trial.options == {}


# The agent's own keys


def test_unknown_keys_reach_the_agent_as_options(folder: Path) -> None:
    own = "modality: demo\nrows: 6\nblocked: [{x: 1, y: 2}]\nname: maze\noptions: {level: 2}\n"
    found = read(folder, game(project="name: A maze\n", trial=own))
    assert found.trial.options == {
        "level": 2,
        "modality": "demo",
        "rows": 6,
        "blocked": [{"x": 1, "y": 2}],
        "name": "maze",
    }
    assert [str(remark) for remark in found.remarks] == [
        f"config.yml:{line}: remark: trial.{key}: no key of Hippodrome's: the agent gets it as one of its own "
        "(docs/agent.md)"
        for line, key in ((10, "modality"), (11, "rows"), (12, "blocked"), (13, "name"))
    ]


def test_a_list_of_instructions_reaches_the_agent_as_in_hippo(folder: Path) -> None:
    """Ours is the name of a page."""
    found = read(folder, game(trial="instructions:\n- Mark it\n- Click on it\n"))
    assert (found.trial.options, found.trial.instructions) == ({"instructions": ["Mark it", "Click on it"]}, None)
    assert remarks(found) == [
        "trial.instructions: a list is for the agent, as in HIPPO Gym; to show a page before the game, name a file of "
        "steps/"
    ]
    (folder / "steps/rules.html").write_text("<p>Go</p>")
    found = read(folder, game(trial="instructions: rules\n"))
    assert (found.trial.options, found.trial.instructions) == ({}, "rules")


def test_an_option_overrides_a_key_of_its_name(folder: Path) -> None:
    found = read(folder, game(trial="level: 1\noptions: {level: 2}\n"))
    assert found.trial.options == {"level": 2}
    assert remarks(found) == ["trial.level: no effect: trial.options.level is there too"]


def test_the_agents_own_keys_have_the_limits_of_options(folder: Path) -> None:
    (expected,) = mistakes(folder, game(trial=f"text: {'a' * 5000}\n"))
    assert expected.startswith("config.yml:7: trial.options: must be at most 4096 characters long")


def test_a_projects_own_control_gets_no_remark(folder: Path) -> None:
    found = read(folder, game(trial="ui: {left: true, undo: true, redo: false, hue: , height: 6}\n"))
    assert (found.trial.ui.left, found.trial.ui.own) == (True, ("undo",))
    assert remarks(found) == ["trial.ui.height: no effect: neither true nor false"]


@pytest.mark.parametrize("known", ["", ", left: true"])
def test_a_control_whose_name_is_similar_to_a_known_one_is_a_mistake(folder: Path, known: str) -> None:
    assert mistakes(folder, game(trial=f"ui: {{lft: true{known}}}\n")) == [
        "config.yml:9: trial.ui.lft: unknown key; did you mean left?"
    ]


def test_an_agent_that_needs_no_game_is_given_none(folder: Path) -> None:
    (folder / "agent.py").touch()
    found = read(folder, SMALL.replace("game: CartPole-v1", "game:"))
    assert (found.trial.game, remarks(found)) == (
        "none",
        ['trial.game: is empty: start() of the agent is given "none"'],
    )


@pytest.mark.parametrize(
    ("project", "trial", "where"),
    [
        ("epsiodes: 3\n", "", "project.epsiodes"),
        ("events: {begin: 1}\n", "", "project.events.begin"),
        ("awsSetup: {subnet: a}\n", "", "project.awsSetup.subnet"),
    ],
)
def test_other_unknown_keys_have_no_effect_as_in_hippo(folder: Path, project: str, trial: str, where: str) -> None:
    found = read(folder, game(project=project, trial=trial))
    assert remarks(found) == [f"{where}: no effect: Hippodrome has no such key"]


@pytest.mark.parametrize(
    ("where", "more"),
    [
        ("project.groups", {"project": "groups: 2\n"}),
        ("project.between_subjects", {"project": "between_subjects: {help: [yes, no]}\n"}),
        ("trial.treatment", {"trial": "treatment: a\n"}),
    ],
)
def test_a_key_for_conditions_says_how_they_are_made(folder: Path, where: str, more: dict[str, str]) -> None:
    sections = {name: text for name, text in more.items() if name}
    (remark,) = remarks(read(folder, game(**sections) + more.get("", "")))
    assert remark.startswith(f"{where}: ")
    assert "conditions between people go under project.conditions" in remark


def test_an_unknown_section_has_no_effect(folder: Path) -> None:
    assert remarks(read(folder, SMALL + "notes: [a]\n")) == ["notes: no effect: Hippodrome has no such key"]


@pytest.mark.parametrize("slip", ["maxEpisods", "maxepisodes", "actionspace", "startngFrameRate", "maxruntime"])
def test_a_likely_typing_error_stays_a_mistake(folder: Path, slip: str) -> None:
    (expected,) = mistakes(folder, game(trial=f"{slip}: 5\n"))
    assert f"trial.{slip}: unknown key; did you mean " in expected


def test_keys_after_a_typing_error_are_adapted_all_the_same() -> None:
    trial = {"maxEpisods": 5, "rows": 6, "ui": {"undo": "yes", "lft": "yes", "height": 6}}
    assert adapt({"trial": trial}).values["trial"] == {
        "maxEpisods": 5,
        "ui": {"undo": "yes", "lft": "yes"},
        "options": {"rows": 6},
    }


def test_a_key_similar_to_one_that_is_given_is_an_option(folder: Path) -> None:
    found = read(folder, game(trial="maxEpisodes: 3\nmaxEpisode: 4\n"))
    assert (found.trial.max_episodes, found.trial.options) == (3, {"maxEpisode": 4})


# Actions and rates


def test_actions_of_equal_names_keep_their_numbers(folder: Path) -> None:
    found = read(folder, game(trial="actionSpace: [noop, left, Left, 3, 3]\n"))
    assert found.trial.action_space == ("noop", "left", "Left 2", "3", "3 4")
    assert remarks(found) == [
        'trial.actionSpace item 3: the name is item 2 already, so no key leads to this action; it is called "Left 2" here',
        'trial.actionSpace item 5: the name is item 4 already, so no key leads to this action; it is called "3 4" here',
    ]


@pytest.mark.parametrize("rates", [("40", "30", "20"), ("1", "240", "60"), ("10", "1", "60")])
def test_bounds_of_a_rate_that_may_not_change_do_not_matter(folder: Path, rates: tuple[str, str, str]) -> None:
    low, start, high = rates
    found = read(folder, game(trial=f"minFrameRate: {low}\nstartingFrameRate: {start}\nmaxFrameRate: {high}\n"))
    assert found.trial.starting_frame_rate == int(start)
    assert found.trial.min_frame_rate <= int(start) <= found.trial.max_frame_rate
    assert remarks(found) == [
        "trial.minFrameRate: no effect, since allowFrameRateChange is not true",
        "trial.maxFrameRate: no effect, since allowFrameRateChange is not true",
    ]


# Remarks in general


def test_a_project_in_our_form_has_no_remark(folder: Path) -> None:
    assert remarks(read(folder, SMALL)) == remarks(read(folder, HIPPO)) == []


def test_strict_makes_remarks_mistakes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    read(folder, game(trial="rows: 6\n"))
    assert main(["check", str(folder)]) == 0
    assert main(["check", "--strict", str(folder)]) == 1
    assert "config.yml:9: remark: trial.rows:" in capsys.readouterr().out
    read(folder, SMALL)
    assert main(["check", "--strict", str(folder)]) == 0


# Values, without a file


STUDY = {"1": "consent", "2": "game", "3": "thanks"}


def steps_of(steps: Any, **project: Any) -> Any:
    return adapt({"project": {"steps": steps, **project}}).values["project"]["steps"]


def project_of(**project: Any) -> Any:
    return adapt({"project": project}).values["project"]


def trial_of(**trial: Any) -> Any:
    return adapt({"trial": trial}).values["trial"]


def paths(document: dict[str, Any]) -> list[str]:
    """Return the paths of the remarks on a document."""
    return [".".join(map(str, remark.path)) for remark in adapt(document).remarks]


@pytest.mark.parametrize(
    ("given", "found"),
    [
        (Plain(1.5, "1.5"), "1-5"),
        (Plain(12, "12"), Plain(12, "12")),
        (Plain(True, "yes"), Plain(True, "yes")),
        ("X study", "X-study"),  # no letter at the beginning is taken away
        ("", ""),
        (None, None),
        (["a"], ["a"]),
        ("…", "…"),
    ],
)
def test_an_id_is_replaced_only_if_it_is_a_text_of_which_an_id_can_be_made(given: Any, found: Any) -> None:
    assert project_of(id=given) == {"id": found}
    if given:
        assert project_of(id=given, useAWS=True) == {"id": found, "useAWS": True}


def test_the_folders_name_takes_the_place_of_an_empty_id_but_not_on_aws() -> None:
    assert adapt({"project": {"id": ""}}, "my study").values == {"project": {"id": "my-study"}}
    assert adapt({"project": {}}, "my study").values == {"project": {}}
    on_aws = {"project": {"id": "", "useAWS": "yes"}}
    assert adapt(on_aws, "my study").values == on_aws


@pytest.mark.parametrize(
    "steps",
    [
        STUDY,
        {},
        {"0": "spare", "1": ["consent"]},  # a mistake that the check reports
        {"1": "https://example.org/a.html", "2": "pages/", "3": "thanks"},
        {"1": "consent", "2": "thanks", "1000": "survey"},
        {"1": "consent", "2": "thanks", "Final_Step": "survey"},
        {"1": "consent", "3": None, "spare": "survey"},  # a number is missing
        {"1": "consent", "3": None, "finalStep": "thanks"},
    ],
)
def test_steps_that_are_right_or_that_the_check_reports_stay(steps: dict[str, Any]) -> None:
    assert steps_of(steps) == steps
    assert list(steps_of(steps)) == list(steps)
    assert paths({"project": {"steps": steps}}) == []


@pytest.mark.parametrize(
    ("given", "found", "remarked"),
    [
        ({"1": None, "2": "pages/a"}, {"1": "a"}, ["2", "1", "2"]),
        ({"1": "a", "2": "", "1000": "c"}, {"1": "a"}, ["2"]),
        ({"1": "a", "2": "b", "spare": "c", "1000": "d"}, {"1": "a", "2": "b", "1000": "d"}, ["spare"]),
        ({"spare": "x", "finalStep": "b"}, {"1": "b"}, ["spare", "finalStep"]),
        ({"0": "x", "00": "y", "1": "a", "2": "b"}, {"1": "a", "2": "b"}, ["0", "00"]),
    ],
)
def test_steps_that_are_not_shown_are_left_out_with_remarks(
    given: dict[str, Any], found: dict[str, Any], remarked: list[str]
) -> None:
    assert steps_of(given) == found
    assert paths({"project": {"steps": given}}) == [f"project.steps.{key}" for key in remarked]


def test_more_than_nine_steps_are_numbered_in_their_order() -> None:
    given = {str(number): f"page{number}" for number in range(1, 12)}
    assert list(steps_of({**given, "2": None}).items()) == [
        (str(at), f"page{number}") for at, number in enumerate([1, *range(3, 12)], 1)
    ]


def test_a_step_that_is_moved_is_found_in_the_file_under_its_own_key() -> None:
    found = adapt({"project": {"step": {"1": "a", "2": None, "3": "b"}}})
    assert found.values == {"project": {"steps": {"1": "a", "2": "b"}}}
    assert [found.origin(("project", "steps", key)) for key in ("1", "2")] == [
        ("project", "step", "1"),
        ("project", "step", "3"),
    ]
    only = adapt({"project": {"steps": {"finalStep": "b"}}})
    assert only.origin(("project", "steps", "1")) == ("project", "steps", "finalStep")
    assert only.origin(("project", "name")) == ("project", "name")


def test_another_spelling_of_a_key_that_is_given_too_stays_a_mistake() -> None:
    both = {"project": {"step": {"1": "a"}, "steps": STUDY}}
    assert adapt(both).values == both
    assert paths(both) == []


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ({"startServerStep": 1, "stopServerStep": 3}, {"startServerStep": 1, "stopServerStep": "2"}),
        ({"startServerStep": 2, "stopServerStep": 4}, {"startServerStep": "2", "stopServerStep": "finalStep"}),
        ({"startServerStep": 9, "stopServerStep": None}, {"startServerStep": 9, "stopServerStep": None}),
    ],
)
def test_events_follow_their_steps(given: dict[str, Any], found: dict[str, Any]) -> None:
    steps = {"1": "consent", "2": None, "3": "thanks", "4": "", "finalStep": "bye"}
    assert project_of(steps=steps, events=given)["events"] == found


@pytest.mark.parametrize(
    ("stop", "found"),
    [(3, 3), (4, 4), (5, "finalStep"), ("500", "finalStep"), (501, 501), ("x", "x"), (-1, -1)],
)
def test_a_stop_step_beyond_the_end_counts_as_the_last_step_as_far_as_steps_can_be_numbered(
    stop: Any, found: Any
) -> None:
    for steps in (STUDY, {**STUDY, "1000": "survey"}):
        assert project_of(steps=steps, events={"stopServerStep": stop})["events"] == {"stopServerStep": found}
    assert project_of(events={"stopServerStep": stop})["events"] == {"stopServerStep": stop}


@pytest.mark.parametrize(
    "trial",
    [
        {"game": ""},  # no step plays it
        {"ui": [["left"]]},
        {"actionSpace": "noop"},
        {"actionSpace": [None, "left", "left"]},
        {"actionSpace": ["", ""]},
        {"minFrameRate": "x", "maxFrameRate": 20},
        {"maxFrameRate": "x", "minFrameRate": 40},
        {"startingFrameRate": "x", "minFrameRate": 100},
        {"startingFrameRate": 241},
        {"startingFrameRate": 0},
        {"minFrameRate": 30},
        {"maxFrameRate": 30},
        {"maxFrameRate": 20, "allowFrameRateChange": "yes"},
        {"maxFrameRate": 20, "allowFramRateChange": "yes"},
        {"allowFrameRateChange": False, "allowFramRateChange": False},
        {"options": 3},
    ],
)
def test_values_of_the_trial_that_are_right_or_that_the_check_reports_stay(trial: dict[str, Any]) -> None:
    assert trial_of(**trial) == trial
    assert paths({"trial": trial}) == []


def test_bounds_that_are_not_given_follow_the_rate_without_a_remark() -> None:
    assert trial_of(startingFrameRate=100) == {"startingFrameRate": 100, "minFrameRate": 1, "maxFrameRate": 100}
    assert paths({"trial": {"startingFrameRate": 100}}) == []
    assert trial_of(startingFrameRate=100, maxFrameRate=20)["maxFrameRate"] == 100


@pytest.mark.parametrize(
    "document",
    [
        {"project": {"maxEpisodes": 3}, "trial": {"maxEpisodes": 2}},
        {"trial": {"maxEpisodes": 2}, "trail": {"maxEpisodes": 3}},
        {"trial": {"maxepisodes": 2}},
    ],
)
def test_a_key_in_the_wrong_place_and_a_misspelt_section_stay_mistakes(document: dict[str, Any]) -> None:
    assert adapt(document).values == document


_NAMES = """project trial id steps step events ui options game actionSpace ssl awsSetup useAWS live 0 1 2 9 finalStep rows
startServerStep stopServerStep cpu minFrameRate maxFrameRate startingFrameRate left up"""
_KEYS = st.sampled_from(_NAMES.split())
_VALUES = st.recursive(
    st.one_of(
        st.none(),
        st.sampled_from(["", "game", "a/b", "true", "_x"]),
        st.integers(-2, 600).map(lambda number: Plain(number, str(number))),
        st.booleans().map(lambda value: Plain(value, str(value))),
    ),
    lambda inner: st.one_of(st.lists(inner, max_size=3), st.dictionaries(_KEYS, inner, max_size=5)),
    max_leaves=20,
)


@given(st.dictionaries(_KEYS, _VALUES, max_size=4))
def test_any_document_is_adapted_and_not_changed(document: dict[str, Any]) -> None:
    before = repr(document)
    once = adapt(document, "name")
    assert repr(document) == before
    assert adapt(once.values, "name").values == once.values
