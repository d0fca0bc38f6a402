"""Reading a researcher's folder: accepted files, several mistakes at once, and the command `check`."""

from __future__ import annotations

import textwrap
from pathlib import Path

import pytest

from hippodrome.control.config import ConfigErrors, read_project
from hippodrome.control.config.__main__ import main
from tests.control.config.folder import HIPPO, SMALL, mistakes, only_mistake, read, small

# Accepted folders


def test_pages_in_the_game_are_found_with_their_groups(folder: Path) -> None:
    found = read(folder, small(trial="instructions: briefing\nbetweenEpisodes: survey.html\n"))
    assert [(page.key, page.page, page.variants) for page in found.game_pages] == [
        ("instructions", "briefing", 3),
        ("betweenEpisodes", "survey", 0),
    ]
    assert found.game_pages[1].files == (folder / "steps" / "survey.html",)
    assert found.registration()["gamePages"] == {"instructions": 3, "betweenEpisodes": 0}
    assert found.groups == 3


def test_a_missing_page_in_the_game_is_named(folder: Path) -> None:
    text = small(trial="instructions: brief\n")
    assert only_mistake(folder, text) == "trial.instructions: there is no brief.html in steps/; did you mean briefing?"


def test_a_missing_policy_file_is_named_with_the_existing_ones(folder: Path) -> None:
    (folder / "policies/small").mkdir(parents=True)
    (folder / "policies/small/partner.onnx").touch()
    text = small(trial="players: {left: human, right: policies/partner.onnx}\n")
    assert only_mistake(folder, text) == (
        "trial.players.right: there is no file policies/partner.onnx beside agent.py; there are "
        "policies/small/partner.onnx"
    )
    text = small(trial="players: {left: human, right: 'sample:policies/small/partner.onnx'}\n")
    assert read(folder, text).trial.players == {"left": "human", "right": "sample:policies/small/partner.onnx"}


def test_a_group_that_is_named_twice_is_refused(folder: Path) -> None:
    text = small(trial="players: {0: {left: human}, '00': {left: random, right: human}}\n")
    assert only_mistake(folder, text) == "trial.players: must name each group once, but names group 0 also as 00"


def test_a_study_without_a_game_needs_no_pages_of_one(folder: Path) -> None:
    text = "project: {id: paper, steps: {1: consent, 2: survey}}\ntrial: {instructions: nowhere}"
    assert read(folder, text).game_pages == ()


def test_a_hippo_project_is_read(folder: Path) -> None:
    found = read(folder, HIPPO)
    assert found.project.id == "paddle-feedback-2"
    assert found.project.researcher == "Mio Sørensen"
    assert found.project.team_members == ()
    assert found.project.aws_setup.root_domain == "play.paddle.example"
    assert (found.project.aws_setup.cpu, found.project.aws_setup.memory) == (1, 4)
    assert found.project.max_runtime == 45
    assert found.trial.action_space == ("noop", "fire", "right", "left")
    assert found.trial.allow_frame_rate_change is True
    assert (found.trial.ui.left, found.trial.ui.up, found.trial.ui.pause, found.trial.ui.fps_up) == (
        True,
        False,
        False,
        False,
    )


def test_steps_come_in_order_with_their_files(folder: Path) -> None:
    steps = read(folder, HIPPO).steps
    assert [(step.key, step.page, step.variants) for step in steps] == [
        ("1", "consent", 0),
        ("2", "briefing", 3),
        ("3", "game", 0),
        ("4", "survey", 0),
        ("finalStep", "thanks", 0),
    ]
    assert [step.type.on_server for step in steps] == [False, False, True, False, False]
    assert steps[1].files == tuple(folder / "steps" / f"briefing-{k}.html" for k in range(3))
    assert steps[2].files == ()


def test_keys_that_are_not_given_have_their_defaults(folder: Path) -> None:
    found = read(folder, SMALL).registration()
    assert found == {
        "id": "small",
        "name": "small",
        "researcher": "",
        "contact": "",
        "teamMembers": [],
        "live": True,
        "maxRuntime": 60,
        "useAWS": False,
        "awsSetup": None,
        "events": {"startServerStep": "2", "stopServerStep": "3"},
        "steps": [
            {"key": "1", "page": "consent", "variants": 0},
            {"key": "2", "page": "game", "variants": 0},
            {"key": "3", "page": "thanks", "variants": 0},
        ],
        "cluster": "installation",
        "subdomain": "hash",
        "plainClients": False,
        "frontEnd": [],
        "allowedHosts": [],
        "recordHeaders": ["user-agent", "accept-language"],
        "maxParticipants": None,
        "maxServers": None,
        "maxServerHours": None,
        "warmServers": 0,
        "signedLinks": False,
        "players": 1,
        "matching": "arrival",
        "patience": 300,
        "seats": "lot",
        "afterPatience": "unmatched",
        "gamePages": {},
        "texts": {},
        "trial": {
            "actionBufferLifespan": 1,
            "maxEpisodes": 20,
            "until": None,
            "answers": [],
            "betweenEpisodes": 3,
            "instructions": None,
            "resetFreeze": 0,
            "maxSteps": 0,
            "episodeSeconds": 0,
            "keys": {},
            "labels": {},
            "input": "held",
            "game": "CartPole-v1",
            "dataFile": "episode",
            "s3upload": True,
            "actionSpace": [],
            "allowFrameRateChange": False,
            "frameRateStepSize": 5,
            "minFrameRate": 1,
            "maxFrameRate": 90,
            "startingFrameRate": 30,
            "ui": {
                **dict.fromkeys(("left", "right", "up", "down", "start", "pause"), True),
                **dict.fromkeys(("stop", "reset", "trainOffline", "trainOnline", "good", "bad"), False),
                **dict.fromkeys(("fpsSet", "fpsUp", "fpsDown"), False),
            },
            "recordObservations": False,
            "lossless": False,
            "callbackSeconds": 0.5,
            "gym": "none",
            "scene": None,
            "players": {},
            "frameSkip": 1,
            "policyActions": None,
            "policySeconds": 10,
            "seed": None,
            "pace": "realtime",
            "turnSeconds": 0,
            "turnEnds": "idle",
            "idleAction": None,
            "options": {},
        },
    }


def test_hippos_names_of_file_and_folder_are_accepted(folder: Path) -> None:
    (folder / "steps").rename(folder / "StepFiles")
    (folder / "config.yaml").write_text(SMALL)
    assert read_project(folder).steps[0].files == (folder / "StepFiles" / "consent.html",)


def test_a_study_without_a_game_needs_no_trial_and_no_server(folder: Path) -> None:
    found = read(folder, "project: {id: paper, steps: {1: consent, 2: survey}}")
    assert (found.events.start_server_step, found.events.stop_server_step) == (None, None)
    assert found.registration()["trial"]["game"] is None


def test_warm_servers_without_a_game_are_refused(folder: Path) -> None:
    text = "project: {id: paper, steps: {1: consent, 2: survey}, warmServers: 2}"
    expected = "project.warmServers: must be 0: no step of this study starts a server, so no participant would take one"
    assert only_mistake(folder, text) == expected
    text = "project: {id: paper, steps: {1: consent, 2: survey}, warmServers: 2, events: {startServerStep: 1}}"
    assert read(folder, text).project.warm_servers == 2


def test_while_its_steps_are_wrong_a_study_gets_no_message_about_warm_servers(folder: Path) -> None:
    text = "project: {id: paper, steps: {1: consent, two: game, 3: survey}, warmServers: 2}"
    assert not any("warmServers" in line for line in mistakes(folder, text))


def test_a_project_that_is_not_live_is_a_project(folder: Path) -> None:
    assert read(folder, small(project="live: false\n")).project.live is False


def test_numbers_may_be_written_as_text(folder: Path) -> None:
    text = small(
        project='maxRuntime: "30"\nawsSetup: {cpu: 2 vCPU, memory: "8 GB"}\nevents: {startServerStep: "2"}\n',
        trial='maxEpisodes: "7"\nstartingFrameRate: 25.0\n',
    )
    found = read(folder, text)
    assert (found.project.max_runtime, found.project.aws_setup.cpu, found.project.aws_setup.memory) == (30, 2, 8)
    assert (found.trial.max_episodes, found.trial.starting_frame_rate) == (7, 25)
    assert found.events.start_server_step == "2"


@pytest.mark.parametrize(
    ("written", "meant"), [("yes", True), ("True", True), ('"no"', False), ("'False'", False), ("on", True)]
)
def test_true_and_false_may_be_written_in_several_ways(folder: Path, written: str, meant: bool) -> None:
    assert read(folder, small(project=f"live: {written}\n")).project.live is meant


@pytest.mark.parametrize("written", ["007", "2024", "1e5", "0x10"])
def test_an_id_that_looks_like_a_number_stays_as_written(folder: Path, written: str) -> None:
    assert read(folder, SMALL.replace("id: small", f"id: {written}")).project.id == written


def test_a_date_as_a_name_stays_as_written(folder: Path) -> None:
    assert read(folder, small(project="name: 2031-05-01\n")).project.name == "2031-05-01"


def test_the_team_is_a_name_or_a_list(folder: Path) -> None:
    assert read(folder, small(project="teamMembers: Ada\n")).project.team_members == ("Ada",)
    assert read(folder, small(project="teamMembers: [Ada, 'Bo, the second']\n")).project.team_members == (
        "Ada",
        "Bo, the second",
    )


def test_empty_keys_count_as_not_given(folder: Path) -> None:
    text = small(project='useAWS:\nname: ""\nssl:\n  sslBucket:\nevents:\n', trial="actionSpace:\nui:\nmaxEpisodes: \n")
    assert read(folder, text).registration() == read(folder, SMALL).registration()


def test_a_ui_section_shows_only_what_it_names(folder: Path) -> None:
    ui = read(folder, small(trial="ui: {good: true, bad: true}\n")).registration()["trial"]["ui"]
    assert [name for name, shown in ui.items() if shown] == ["good", "bad"]


def test_aws_keys_may_stay_incomplete_without_aws(folder: Path) -> None:
    found = read(folder, small(project="awsSetup: {bucket: lab, memory: 30}\n"))
    assert found.registration()["awsSetup"] is None


def test_anchors_are_understood(folder: Path) -> None:
    found = read(folder, "project: {id: a, steps: {1: &page consent, 2: *page}}")
    assert [step.page for step in found.steps] == ["consent", "consent"]


def test_a_byte_order_mark_and_windows_line_ends_do_no_harm(folder: Path) -> None:
    (folder / "config.yml").write_bytes(b"\xef\xbb\xbf" + SMALL.replace("\n", "\r\n").encode())
    assert read_project(folder).project.id == "small"


def test_yaml_tags_are_refused_and_run_nothing(folder: Path) -> None:
    (line,) = mistakes(folder, small(project=f"name: !!python/object/apply:os.mkdir [{folder}/made]\n"))
    assert (
        line
        == "config.yml:7: project.name: tags (! and !!) are not allowed; write the plain value, in quotes if it has a !"
    )
    assert not (folder / "made").exists()


# The agent's own options


def test_options_are_whatever_the_agent_needs(folder: Path) -> None:
    text = """\
        options:
          fingerprint: prints/a.png
          instructions: Find the minutiae; "both" hands
          minMinutiae: 12
          rates: [0.5, .25, 1.0e-3, -7]
          hints: {early: yes, late: no, never: }
          version: 007
          day: 2031-05-01
    """
    found = read(folder, small(trial=textwrap.dedent(text)))
    assert found.registration()["trial"]["options"] == {
        "fingerprint": "prints/a.png",
        "instructions": 'Find the minutiae; "both" hands',
        "minMinutiae": 12,
        "rates": [0.5, 0.25, 0.001, -7],
        "hints": {"early": True, "late": False, "never": None},
        "version": 7,
        "day": "2031-05-01",
    }


def test_empty_options_are_none(folder: Path) -> None:
    for text in ("options:\n", "options: {}\n"):
        assert read(folder, small(trial=text)).trial.options == {}


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("[a, b]", "must be a map: indented lines such as \"difficulty: 3\" below it, not a list"),
        ("fast", "must be a map: indented lines such as \"difficulty: 3\" below it, not \"fast\""),
        (f"{{a: {'x' * 4090}}}", "must be at most 4096 characters long when written as JSON, not 4098"),
        (f"{{a: {'é' * 700}}}", "must be at most 4096 characters long when written as JSON, not 4208"),
        ("{a: [[[[[[[[1]]]]]]]]}", "must be nested no more than 8 deep"),
    ],
)  # fmt: skip
def test_wrong_options_get_a_message(folder: Path, options: str, expected: str) -> None:
    assert only_mistake(folder, small(trial=f"options: {options}\n")) == f"trial.options: {expected}"


def test_options_may_be_as_large_and_as_deep_as_the_limits(folder: Path) -> None:
    for options in (f"{{a: {'x' * 4088}}}", "{a: [[[[[[[1]]]]]]]}"):
        assert read(folder, small(trial=f"options: {options}\n")).trial.options


# All at once, with their lines


def test_all_mistakes_are_named_at_once_in_the_order_of_lines(folder: Path) -> None:
    text = """\
        project:
          useAWS: true
          awsSetup:
            bucket: paddle.lab
            region: europe
            rootDomain: play.paddle.example
            cpu: 2
            memory: 40
          id: paddle_study
          maxRuntme: 30
          steps:
            1: consnt
            2: game
            4: thanks
          events:
            startServerStep: 9
          actionSpace: [up]
        trial:
          maxEpisodes: many
          minFrameRate: 50
          allowFrameRateChange: yes
          actionSpace:
            - up
            - down
            - no
    """
    assert mistakes(folder, text) == [
        'config.yml:5: project.awsSetup.region: must be an AWS region such as ca-central-1, not "europe"',
        "config.yml:8: project.awsSetup.memory: 40 GB do not go with cpu 2; choose 4 to 16",
        "config.yml:10: project.maxRuntme: unknown key; did you mean maxRuntime?",
        "config.yml:12: project.steps.1: there is no consnt.html in steps/; did you mean consent?",
        "config.yml:14: project.steps.4: step 3 is missing before it; number the steps 1, 2, 3 … without gaps",
        "config.yml:16: project.events.startServerStep: there is no step 9; the steps are 1 to 4",
        "config.yml:17: project.actionSpace: unknown key; it belongs under trial (check the indentation)",
        "config.yml:18: trial.game: missing; a project with a game step needs the name of its environment",
        'config.yml:19: trial.maxEpisodes: must be a whole number from 1 to 1000000, not "many"',
        "config.yml:20: trial.minFrameRate: must be at most startingFrameRate, which is 30 by default, not 50; "
        "set startingFrameRate too",
        'config.yml:25: trial.actionSpace item 3: must be the name of an action; YAML reads no as true or false, so write "no" in quotes',
    ]  # fmt: skip


def test_a_message_names_the_place_of_the_mistake(folder: Path) -> None:
    (folder / "config.yml").write_text(small(trial="maxEpisodes: many\n"))
    with pytest.raises(ConfigErrors) as caught:
        read_project(folder)
    (problem,) = caught.value.diagnostics
    assert (problem.file, problem.line, problem.where) == ("config.yml", 9, "trial.maxEpisodes")
    assert problem.message == 'must be a whole number from 1 to 1000000, not "many"'
    assert str(problem) == f"config.yml:9: trial.maxEpisodes: {problem.message}"


def test_a_message_is_short_and_has_no_invisible_characters(folder: Path) -> None:
    line = only_mistake(folder, small(project=f'live: "\\e[31m\\u202e{"x" * 500}"\n'))
    assert line.isprintable()
    assert len(line) < 120


# The command line


def test_check_reports_a_project_without_mistakes(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "config.yml").write_text(HIPPO, encoding="utf-8")
    assert main(["check", str(folder)]) == 0
    assert capsys.readouterr().out == (
        "config.yml is fine: 5 steps, step 3 is the game (ALE/Pong-v5), briefing in 3 groups, "
        "a server from step 2 to step 4, at most 45 minutes\n"
    )


def test_check_prints_the_number_of_warm_servers(folder: Path) -> None:
    summary = read(folder, small(project="warmServers: 4\n")).summary()
    assert summary.endswith("a server from step 2 to step 3, at most 60 minutes, 4 kept warm")


def test_check_prints_mistakes_and_fails(
    folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    (folder / "config.yml").write_text(small(project="live: perhaps\nmaxRuntime: 0\n"))
    monkeypatch.chdir(folder)
    assert main(["check"]) == 1
    assert capsys.readouterr().out == (
        'config.yml:7: project.live: must be true or false, not "perhaps"\n'
        "config.yml:8: project.maxRuntime: must be a whole number from 1 to 1440, not 0\n"
    )
